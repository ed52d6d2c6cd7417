"""Structural similarity: the score and the loss, against other implementations and each other."""

import numba
import pytest
import torch
from skimage.metrics import structural_similarity

from pipeline.metrics.ssim import gaussian_window, plain_ssim_loss, rounded_gaussian_window, ssim, ssim_loss
from pipeline.numba_kernels import threads


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(40, 52, 3, generator=generator)
    return image, (image + 0.2 * torch.randn(40, 52, 3, generator=generator)).clamp(0, 1)


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def test_ssim_agrees_with_skimage(pair):
    # On a black margin as wide as the window, because the two mirror the border differently.
    pair = [torch.nn.functional.pad(one, (0, 0, 11, 11, 11, 11)) for one in pair]
    image, truth = (one.double().numpy() for one in pair)
    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    everywhere = structural_similarity(image, truth, data_range=1, channel_axis=-1, full=True, **gaussian)[1]
    assert ssim(*pair) == pytest.approx(everywhere.mean(), abs=1e-9)


@pytest.mark.parametrize("flat", [False, True])
def test_ssim_is_torchmetrics_in_float64(pair, flat):
    from torchmetrics.functional.image import structural_similarity_index_measure  # takes 3 s

    image, truth = pair
    if flat:
        image[:20], truth[:, :30] = 0.7, 0.4
    batches = [one.double().permute(2, 0, 1)[None] for one in (image, truth)]
    expected = structural_similarity_index_measure(*batches, data_range=1.0)
    assert ssim(image, truth) == pytest.approx(float(expected), abs=1e-9)


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (10, 10), (11, 11)])
def test_images_smaller_than_the_window_have_an_ssim(size):
    image, truth = torch.rand(*size, 3, generator=torch.Generator().manual_seed(0)), torch.zeros(*size, 3)
    assert ssim(image, image.clone()) == pytest.approx(1.0)
    assert -1 <= ssim(image, truth) < 0.999


def test_a_small_image_scores_as_itself_on_black():
    generator = torch.Generator().manual_seed(1)
    image, truth = torch.rand(5, 7, 3, generator=generator), torch.rand(5, 7, 3, generator=generator)
    larger = [torch.zeros(11, 11, 3), torch.zeros(11, 11, 3)]
    larger[0][:5, :7], larger[1][:5, :7] = image, truth
    assert ssim(image, truth) == pytest.approx(ssim(*larger))


def test_a_small_image_on_white_scores_as_itself_on_white():
    generator = torch.Generator().manual_seed(1)
    image, truth = torch.rand(5, 7, 3, generator=generator), torch.rand(5, 7, 3, generator=generator)
    larger = [torch.ones(11, 11, 3), torch.ones(11, 11, 3)]
    larger[0][:5, :7], larger[1][:5, :7] = image, truth
    assert ssim(image, truth, 1.0) == pytest.approx(ssim(*larger))
    assert ssim(image, truth, 1.0) != pytest.approx(ssim(image, truth), abs=1e-3)
    assert float(ssim_loss(image, truth, 1.0)) == pytest.approx(1 - ssim(image, truth, 1.0), abs=1e-4)


@pytest.mark.parametrize("size", [(4, 9), (24, 37)])
def test_dissimilarity_is_one_minus_ssim_with_a_gradient_downhill(size):
    generator = torch.Generator().manual_seed(2)
    truth = torch.rand(*size, 3, generator=generator)
    image = (0.7 * truth + 0.3 * torch.rand(*size, 3, generator=generator)).requires_grad_()
    loss = ssim_loss(image, truth)
    assert loss.item() == pytest.approx(1 - ssim(image, truth), abs=1e-4)
    (slope,) = torch.autograd.grad(loss, image)
    shorter = image.detach() - 1e-3 * slope / slope.norm()
    fallen = loss.item() - (1 - ssim(shorter, truth))
    assert fallen == pytest.approx(1e-3 * float(slope.norm()), rel=0.05, abs=2e-6)


@pytest.mark.parametrize("size", [(11, 11), (24, 37)])
def test_ssim_equals_torchmetrics_with_gradient(size):
    from torchmetrics.functional.image import structural_similarity_index_measure  # takes 3 s

    target = drawn(*size, 3)
    image = (0.7 * target + 0.3 * drawn(*size, 3, seed=1)).requires_grad_()
    ours = ssim_loss(image, target)
    ours.backward()
    other = image.detach().clone().requires_grad_()
    theirs = 1 - structural_similarity_index_measure(
        other.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], data_range=1.0
    )
    theirs.backward()
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(image.grad, other.grad, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("size", [(11, 11), (12, 64), (77, 33)])
def test_fused_ssim_is_the_plain_one_with_gradient(size):
    target = drawn(*size, 3).double()
    image = (0.8 * target + 0.2 * drawn(*size, 3, seed=1)).requires_grad_()
    ours, theirs = ssim_loss(image, target), plain_ssim_loss(image, target)
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    gradients = [torch.autograd.grad(3 * value, image)[0] for value in (ours, theirs)]
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-12)
    single = image.detach().float().requires_grad_()
    ssim_loss(single, target.float()).backward()
    torch.testing.assert_close(3 * single.grad.double(), gradients[1], rtol=1e-3, atol=1e-6)


def test_fused_ssim_gradcheck():
    target, image = drawn(13, 11, 3).double(), drawn(13, 11, 3, seed=1).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: ssim_loss(x, target), image)


def test_ssim_is_the_same_on_any_number_of_threads():
    numba.get_num_threads()
    image, target, found = drawn(70, 40, 3).requires_grad_(), drawn(70, 40, 3, seed=1), []
    for count in (1, 2):
        with threads(count):
            value = ssim_loss(image, target)
            found.append((value, *torch.autograd.grad(value, image)))
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_ssim_is_differentiable_in_its_target_too():
    image, target = drawn(16, 16, 3), drawn(16, 16, 3, seed=1).requires_grad_()
    ssim_loss(image, target).backward()
    assert target.grad.abs().max() > 0


def test_ssim_lets_nothing_that_is_not_finite_vanish():
    image = drawn(40, 20, 3)
    image[3, 4, 1] = float("nan")
    assert ssim_loss(image, drawn(40, 20, 3, seed=1)).isnan()


def test_ssim_of_equal_images_is_zero_and_grows_with_noise():
    target = drawn(20, 20, 3)
    noise = drawn(20, 20, 3, seed=2) - 0.5
    values = [float(ssim_loss(target + amount * noise, target)) for amount in (0, 0.05, 0.2)]
    assert abs(values[0]) < 1e-6
    assert values[0] < values[1] < values[2]


def test_the_two_windows_are_one_rounded_differently():
    assert (gaussian_window() - rounded_gaussian_window()).abs().max() < 2e-8
    assert float(rounded_gaussian_window().double().sum()) == pytest.approx(1, abs=1e-7)
