import math
import pickle

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from pipeline.errors import UserError
from pipeline.metrics import PSNR_CAP, Lpips, interior, psnr, ssim


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(40, 52, 3, generator=generator)
    return image, (image + 0.2 * torch.randn(40, 52, 3, generator=generator)).clamp(0, 1)


def pattern(height, width):
    """Two images that anyone can make again, for values that another implementation gave."""
    y, x = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    first = [(torch.sin(x / 5) + 1) / 2, (torch.cos(y / 7) + 1) / 2, ((x + y) % 16) / 15]
    second = [(torch.sin(x / 5 + 0.6) + 1) / 2, (torch.cos(y / 9) + 1) / 2, ((x - y) % 16) / 15]
    return torch.stack(first, -1), torch.stack(second, -1)


# PSNR and SSIM


def test_psnr_by_hand():
    assert psnr(torch.zeros(4, 5, 3), torch.full((4, 5, 3), 0.1)) == pytest.approx(20.0, abs=1e-5)


def test_psnr_agrees_with_skimage(pair):
    image, truth = pair
    expected = peak_signal_noise_ratio(truth.double().numpy(), image.double().numpy(), data_range=1)
    assert psnr(image, truth) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    "image", [torch.zeros(20, 20, 3), torch.full((20, 20, 3), 0.7)], ids=["black", "grey"]
)
def test_identical_images_have_finite_perfect_scores(image):
    assert psnr(image, image.clone()) == PSNR_CAP
    assert ssim(image, image.clone()) == pytest.approx(1.0)


def test_eight_bit_images_stay_below_the_cap():
    other = torch.zeros(1000, 1000, 3)
    other[0, 0, 0] = 1 / 255
    assert 90 < psnr(torch.zeros(1000, 1000, 3), other) <= PSNR_CAP
    assert psnr(torch.zeros(100, 100, 3), other[:100, :100]) < PSNR_CAP


def test_psnr_inside_a_mask_ignores_the_rest():
    truth = torch.zeros(6, 6, 3)
    image = torch.ones(6, 6, 3)
    mask = torch.zeros(6, 6, dtype=torch.bool)
    mask[2:4, 2:4] = True
    image[mask] = 0.01
    assert psnr(image, truth, mask) == pytest.approx(40.0, abs=1e-4)
    assert math.isnan(psnr(image, truth, torch.zeros_like(mask)))


def test_images_of_different_size_are_refused():
    for metric in (psnr, ssim):
        with pytest.raises(ValueError, match="two images"):
            metric(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))


# The protocol


def test_interior_is_three_pixels_inside_and_open_at_the_border():
    mask = np.zeros((30, 20), np.uint8)
    mask[10:, 4:16] = 128  # reaches the lower border
    expected = torch.zeros(30, 20, dtype=torch.bool)
    expected[13:, 7:13] = True
    assert torch.equal(interior(mask), expected)


def test_half_transparent_pixels_are_outside():
    assert not interior(np.full((9, 9), 127, np.uint8), erosion=0).any()
    assert interior(np.full((9, 9), 128, np.uint8), erosion=0).all()


# LPIPS


def arrays(seed=0, shapes=((11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256))):
    """AlexNet's arrays in the checkpoint's layout, with random numbers."""
    random = np.random.default_rng(seed)
    network, checkpoint = {}, {}
    for index, (side, inputs, outputs) in enumerate(shapes):
        kernel = random.normal(0, 1 / math.sqrt(side * side * inputs), (side, side, inputs, outputs))
        network[f"Conv_{index}"] = {
            "kernel": kernel.astype(np.float32),
            "bias": np.zeros(outputs, np.float32),
        }
        head = random.uniform(0, 1, (1, 1, outputs, 1)).astype(np.float32)
        checkpoint[f"NetLinLayer_{index}"] = {"Conv_0": {"kernel": head}}
    return {"AlexNet_0": network, **checkpoint}


def write(folder, content, name="alexnet.ckpt"):
    (folder / name).write_bytes(pickle.dumps(content, protocol=3))


@pytest.fixture(scope="module")
def random_lpips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lpips")
    write(folder, arrays())
    return Lpips(folder, "alex")


def test_lpips_is_a_distance(random_lpips):
    image, other = pattern(40, 56)
    assert float(random_lpips(image, image)) == 0
    assert float(random_lpips(image, other)) > 0.01
    assert float(random_lpips(image, other)) == pytest.approx(float(random_lpips(other, image)))


def test_lpips_of_a_batch_is_that_of_each_pair(random_lpips):
    first, second = pattern(40, 40)
    together = random_lpips(torch.stack([first, second]), torch.stack([second, second]))
    assert together.shape == (2,)
    assert float(together[0]) == pytest.approx(float(random_lpips(first, second)), rel=1e-5)
    assert float(together[1]) == 0


@pytest.mark.parametrize("size", [(1, 1), (30, 31), (31, 31)])
def test_lpips_takes_small_images(random_lpips, size):
    image = torch.rand(*size, 3, generator=torch.Generator().manual_seed(0))
    assert math.isfinite(float(random_lpips(image, 1 - image)))
    assert float(random_lpips(image, image)) == 0


def test_lpips_has_finite_gradients_on_black(random_lpips):
    image = torch.zeros(40, 40, 3, requires_grad=True)
    random_lpips(image, torch.zeros(40, 40, 3)).sum().backward()
    assert torch.isfinite(image.grad).all()


class Hostile:
    """Runs a command when it is unpickled by a loader that trusts its input."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        import os

        return os.system, (f"touch {self.trace}",)


def test_a_hostile_checkpoint_is_refused_and_not_run(tmp_path):
    trace = tmp_path / "was-run"
    for content in (Hostile(trace), {"AlexNet_0": {"Conv_0": Hostile(trace)}}, {"AlexNet_0": print}):
        write(tmp_path, content)
        with pytest.raises(UserError, match=r"alexnet\.ckpt is damaged"):
            Lpips(tmp_path, "alex")
    assert not trace.exists()


def without_a_bias(content):
    del content["AlexNet_0"]["Conv_2"]["bias"]


def with_a_nan(content):
    content["AlexNet_0"]["Conv_1"]["kernel"][0, 0, 0, 0] = np.nan


def with_another_shape(content):
    content["AlexNet_0"]["Conv_1"] = content["AlexNet_0"]["Conv_2"]


def with_text(content):
    content["NetLinLayer_3"]["Conv_0"]["kernel"] = "text"


def without_a_network(content):
    content["AlexNet_0"] = 3


@pytest.mark.parametrize(
    "damage", [without_a_bias, with_a_nan, with_another_shape, with_text, without_a_network, dict.clear]
)
def test_a_checkpoint_of_something_else_is_damaged(tmp_path, damage):
    content = arrays()
    damage(content)
    write(tmp_path, content)
    with pytest.raises(UserError, match=r"alexnet\.ckpt is damaged"):
        Lpips(tmp_path, "alex")


def test_a_checkpoint_that_is_no_table_is_damaged(tmp_path):
    write(tmp_path, [1, 2])
    with pytest.raises(UserError, match=r"alexnet\.ckpt is damaged"):
        Lpips(tmp_path, "alex")


def test_a_truncated_or_missing_checkpoint_names_the_file(tmp_path):
    write(tmp_path, arrays())
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"alexnet\.ckpt is damaged"):
        Lpips(tmp_path, "alex")
    with pytest.raises(UserError, match=r"vgg16\.ckpt cannot be read"):
        Lpips(tmp_path, "vgg")


@pytest.mark.assets
@pytest.mark.parametrize(
    ("network", "size", "expected"),
    [
        ("alex", (64, 64), 0.206416),
        ("alex", (48, 80), 0.220241),
        ("vgg", (64, 64), 0.516020),
        ("vgg", (48, 80), 0.450353),
    ],
)
def test_lpips_agrees_with_the_authors_package(assets_folder, network, size, expected):
    # Expected: the package lpips 0.1.4 (its code and its v0.1 heads) on the same backbones.
    folder = assets_folder / "lpips"
    if not folder.is_dir():
        pytest.skip("the LPIPS weights are not here")
    assert float(Lpips(folder, network)(*pattern(*size))) == pytest.approx(expected, abs=2e-6)
