"""Metrics and image losses of images that leave them nothing to divide by."""

import math

import pytest
import torch

from pipeline.metrics import PSNR_CAP, Lpips, interior, psnr, ssim, ssim_loss
from pipeline.metrics.face_identity import identity_cosine
from pipeline.metrics.ssim import plain_ssim_loss
from stages.train import losses

GENERATOR = torch.Generator().manual_seed(0)
NOISE = torch.rand(24, 20, 3, generator=GENERATOR)
PAIRS = {
    "identical": (NOISE, NOISE.clone()),
    "both black": (torch.zeros(24, 20, 3), torch.zeros(24, 20, 3)),
    "both white": (torch.ones(24, 20, 3), torch.ones(24, 20, 3)),
    "both grey": (torch.full((24, 20, 3), 0.5), torch.full((24, 20, 3), 0.5)),
    "black and white": (torch.zeros(24, 20, 3), torch.ones(24, 20, 3)),
    "black and noise": (torch.zeros(24, 20, 3), NOISE),
    "one pixel differs": (NOISE, NOISE + torch.eye(24, 20)[..., None] * 1e-7),
    "flat, one rounding apart": (torch.full((24, 20, 3), 0.7), torch.full((24, 20, 3), 0.7 + 6e-8)),
    "out of range": (3 * NOISE - 1, NOISE),
}
SMALL = [(1, 1), (1, 11), (2, 2), (5, 5), (6, 6), (10, 30), (11, 11)]


@pytest.mark.parametrize("pair", PAIRS)
def test_every_pair_has_finite_scores_and_slopes(pair):
    image, truth = PAIRS[pair]
    assert math.isfinite(psnr(image, truth)) and psnr(image, truth) <= PSNR_CAP
    assert -1.0001 <= ssim(image, truth) <= 1 + 1e-9
    for loss in (losses.l1, ssim_loss, plain_ssim_loss):
        leaf = image.clone().requires_grad_()
        value = loss(leaf, truth).mean()
        value.backward()
        assert value.isfinite() and leaf.grad.isfinite().all(), loss.__name__


@pytest.mark.parametrize("pair", ["identical", "both black", "both white", "both grey"])
def test_identical_images_score_best_and_pull_nowhere(pair):
    image, truth = PAIRS[pair]
    assert psnr(image, truth) == PSNR_CAP and ssim(image, truth) == pytest.approx(1, abs=1e-9)
    leaf = image.clone().requires_grad_()
    value = ssim_loss(leaf, truth)
    value.backward()
    # A tap of float32's window rounds: the loss of a flat image is off by 3e-5, its slope by nothing.
    assert abs(float(value.detach())) < 1e-4 and leaf.grad.abs().max() < 1e-6


@pytest.mark.parametrize("pair", PAIRS)
def test_the_score_is_that_of_double_precision_where_single_is_not_enough(pair):
    """Flat images: float32's variances are rounding. ``ssim`` scores in float64, the loss need not."""
    from torchmetrics.functional.image import structural_similarity_index_measure  # takes 3 s

    image, truth = PAIRS[pair]
    batches = [one.double().permute(2, 0, 1)[None] for one in (image, truth)]
    exact = float(structural_similarity_index_measure(*batches, data_range=1.0))
    assert ssim(image, truth) == pytest.approx(exact, abs=1e-9)
    assert float(ssim_loss(image, truth)) == pytest.approx(1 - exact, abs=5e-3)


@pytest.mark.parametrize("size", SMALL)
def test_crops_smaller_than_the_window_have_scores_and_slopes(size):
    image, truth = torch.rand(*size, 3, generator=GENERATOR), torch.rand(*size, 3, generator=GENERATOR)
    assert -1 <= ssim(image, truth) < 1
    leaf = image.clone().requires_grad_()
    value = ssim_loss(leaf, truth)
    value.backward()
    assert leaf.grad.isfinite().all()
    assert float(value) == pytest.approx(1 - ssim(image, truth), abs=1e-4)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_image_that_is_not_finite_shows_in_the_losses(value):
    """The kernels' fast arithmetic must not hide it."""
    image = NOISE.clone()
    image[5, 7, 1] = value
    for loss in (losses.l1, ssim_loss, plain_ssim_loss):
        assert not loss(image, NOISE).mean().isfinite(), loss.__name__


def test_nobody_inside_the_mask():
    empty = torch.zeros(24, 20, dtype=torch.uint8).numpy()
    assert not interior(empty).any()
    assert math.isnan(psnr(NOISE, NOISE, interior(empty)))  # not defined: written nowhere, left out of means


def test_a_crop_of_an_empty_mask_and_of_a_small_view_lies_inside():
    for height, width in ((24, 20), (5, 200), (1, 1)):
        for share in (0.0, 0.999999):
            rows, columns = losses.person_crop(torch.zeros(height, width), 16, share)
            assert 0 <= rows.start < rows.stop <= height and 0 <= columns.start < columns.stop <= width


def test_embeddings_without_length_are_refused():
    with pytest.raises(ValueError, match="no direction"):
        identity_cosine([0.0, 0.0], [1.0, 0.0])


@pytest.mark.assets
@pytest.mark.parametrize("pair", PAIRS)
def test_lpips_of_every_pair_is_finite_with_finite_slopes(assets_folder, pair):
    folder = assets_folder / "lpips"
    if not folder.is_dir():
        pytest.skip("the LPIPS weights are not here")
    network = Lpips(folder)
    image, truth = PAIRS[pair]
    leaf = image.clone().requires_grad_()
    value = network(leaf, truth)
    value.sum().backward()
    assert value.isfinite().all() and float(value.detach()) >= 0 and leaf.grad.isfinite().all()
