"""MimicMotion with tiny random weights: shapes, tiles, blending, determinism, loading. No real weights."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from pipeline.errors import UserError

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

from stages.auxiliary.mimicmotion import PoseNet, load_model, tile_weights, tiles  # noqa: E402
from stages.auxiliary.mimicmotion.denoising import Sampling, decoded, denoise, to_tensor  # noqa: E402


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder as load_model reads it, of networks of a few thousand numbers each."""
    from diffusers import (
        AutoencoderKLTemporalDecoder,
        EulerDiscreteScheduler,
        UNetSpatioTemporalConditionModel,
    )
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights")
    unet = UNetSpatioTemporalConditionModel(
        sample_size=8,
        block_out_channels=(32, 64),
        down_block_types=("CrossAttnDownBlockSpatioTemporal", "DownBlockSpatioTemporal"),
        up_block_types=("UpBlockSpatioTemporal", "CrossAttnUpBlockSpatioTemporal"),
        layers_per_block=1,
        cross_attention_dim=16,
        num_attention_heads=2,
        addition_time_embed_dim=8,
        projection_class_embeddings_input_dim=24,
    )
    unet.save_pretrained(folder / "unet")
    AutoencoderKLTemporalDecoder(
        block_out_channels=(32, 32, 32, 32), down_block_types=("DownEncoderBlock2D",) * 4
    ).save_pretrained(folder / "vae")
    config = CLIPVisionConfig(
        hidden_size=16, intermediate_size=16, projection_dim=16, num_hidden_layers=1, num_attention_heads=2,
        image_size=224, patch_size=112,
    )  # fmt: skip
    CLIPVisionModelWithProjection(config).save_pretrained(folder / "image_encoder")
    EulerDiscreteScheduler(prediction_type="v_prediction", use_karras_sigmas=True).save_pretrained(
        folder / "scheduler"
    )
    pose_net = PoseNet(32)
    torch.nn.init.normal_(pose_net.final_proj.weight, std=0.5)
    entries = {f"pose_net.{name}": entry for name, entry in pose_net.state_dict().items()}
    save_file(entries, folder / "mimicmotion.safetensors")
    return folder


@pytest.fixture(scope="module")
def model(weights):
    return load_model(weights, torch.device("cpu"), torch.float32)


def skeletons(count, size=64):
    rng = np.random.default_rng(1)
    return [rng.integers(0, 255, (size, size, 3), dtype=np.uint8) for _ in range(count)]


def test_the_pose_net_divides_by_eight_and_starts_by_adding_nothing():
    net = PoseNet()
    added = net(torch.rand(2, 3, 64, 48) * 2 - 1)
    assert added.shape == (2, 320, 8, 6) and not added.any()
    assert sum(isinstance(layer, torch.nn.Conv2d) for layer in net.conv_layers) == 8


@pytest.mark.parametrize(("frames", "size", "overlap"), [(501, 72, 6), (73, 72, 6), (20, 8, 1), (21, 8, 6)])
def test_tiles_cover_every_frame_and_overlap(frames, size, overlap):
    found = tiles(frames, size, overlap)
    assert sorted({frame for tile in found for frame in tile}) == list(range(frames))
    for tile in found:
        assert len(tile) == size and tile[0] == 0 and tile[1:] == list(range(tile[1], tile[1] + size - 1))
    for before, after in zip(found, found[1:], strict=False):
        assert len(set(before) & set(after)) >= overlap


def test_a_short_video_is_one_tile():
    assert tiles(5, 72, 6) == [[0, 1, 2, 3, 4]]


def test_an_overlap_without_a_way_forward_is_refused():
    with pytest.raises(ValueError, match="no way forward"):
        tiles(100, 8, 7)


def test_weights_are_a_triangle():
    weights = tile_weights(6)
    assert torch.allclose(weights, torch.tensor([1, 3, 5, 5, 3, 1]) / 6)


def test_predictions_without_pose_ignore_the_hook_and_with_it_change(model):
    sample, times = torch.randn(1, 3, 8, 8, 8), torch.tensor([[6.0, 127.0, 0.0]])
    plain = model.predict(sample, torch.tensor(1.0), torch.zeros(1, 1, 16), times, None)
    posed = model.predict(sample, torch.tensor(1.0), torch.zeros(1, 1, 16), times, torch.ones(3, 32, 8, 8))
    again = model.predict(sample, torch.tensor(1.0), torch.zeros(1, 1, 16), times, None)
    assert plain.shape == (1, 3, 4, 8, 8)
    assert torch.equal(plain, again), "the hook outlived its call"
    assert (plain - posed).abs().max() > 1e-4


def test_a_video_has_a_picture_for_every_pose_and_is_deterministic(model):
    reference, sampling = to_tensor(skeletons(1)[0]), Sampling(2, 2.0, 5, 2, 42)
    latents = denoise(model, reference, skeletons(9), sampling)
    assert latents.shape == (9, 4, 8, 8) and torch.isfinite(latents).all()
    assert torch.equal(latents, denoise(model, reference, skeletons(9), sampling))
    other = denoise(model, reference, skeletons(9), Sampling(2, 2.0, 5, 2, 43))
    assert not torch.equal(latents, other)
    pictures = list(decoded(model, latents[1:]))
    assert len(pictures) == 8 and pictures[0].shape == (64, 64, 3) and pictures[0].dtype == np.uint8


def test_blending_is_the_weighted_mean_of_the_tiles(model, monkeypatch):
    """With a prediction that says only which tile it came from, the blend can be worked out by hand."""
    calls = []

    def guided(model, noisy, *rest):
        calls.append(len(noisy))
        return torch.full_like(noisy, float(len(calls)))

    seen = []
    monkeypatch.setattr("stages.auxiliary.mimicmotion.denoising.guided_noise", guided)
    step = type(model.scheduler).step
    monkeypatch.setattr(
        type(model.scheduler), "step", lambda self, mean, *rest: seen.append(mean) or step(self, mean, *rest)
    )
    denoise(model, to_tensor(skeletons(1)[0]), skeletons(9), Sampling(1, 2.0, 6, 2, 0))
    order, weights = tiles(9, 6, 2), tile_weights(6)
    assert len(order) == len(calls) == 2
    for frame in range(9):
        shares = [(weights[tile.index(frame)], k + 1) for k, tile in enumerate(order) if frame in tile]
        expected = sum(w * value for w, value in shares) / sum(w for w, _ in shares)
        assert torch.allclose(seen[0][frame], torch.full((4, 8, 8), float(expected)), atol=1e-6)


def test_a_missing_part_is_named(weights, tmp_path):
    with pytest.raises(UserError, match="unet is missing"):
        load_model(tmp_path, torch.device("cpu"), torch.float32)


def test_weights_of_another_network_are_refused(weights, tmp_path):
    for part in ("unet", "vae", "image_encoder", "scheduler"):
        (tmp_path / part).symlink_to(weights / part)
    save_file({"pose_net.scale": torch.ones(1)}, tmp_path / "mimicmotion.safetensors")
    with pytest.raises(UserError, match="cannot be read as MimicMotion"):
        load_model(tmp_path, torch.device("cpu"), torch.float32)
