"""Every term of the training objective, against a hand value or an independent implementation."""

import numba
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from pipeline.avatar.sparse import SparsePair
from pipeline.threads import threads
from stages.train import losses

# A path of three vertices, 0 - 1 - 2.
PATH = SparsePair.build(
    torch.tensor([0, 1, 1, 2]), torch.tensor([1, 0, 2, 1]), torch.tensor([1.0, 0.5, 0.5, 1.0]), (3, 3)
)


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def test_l1_by_hand():
    assert float(losses.l1(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.25))) == 0.25


@pytest.mark.parametrize("size", [(11, 11), (24, 37)])
def test_ssim_equals_torchmetrics_with_gradient(size):
    target = drawn(*size, 3)
    image = (0.7 * target + 0.3 * drawn(*size, 3, seed=1)).requires_grad_()
    ours = losses.ssim(image, target)
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
    ours, theirs = losses.ssim(image, target), losses.plain_ssim(image, target)
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    gradients = [torch.autograd.grad(3 * value, image)[0] for value in (ours, theirs)]
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-12)
    single = image.detach().float().requires_grad_()
    losses.ssim(single, target.float()).backward()
    torch.testing.assert_close(3 * single.grad.double(), gradients[1], rtol=1e-3, atol=1e-6)


def test_fused_ssim_gradcheck():
    target, image = drawn(13, 11, 3).double(), drawn(13, 11, 3, seed=1).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: losses.ssim(x, target), image)


def test_ssim_is_the_same_on_any_number_of_threads():
    numba.get_num_threads()
    image, target, found = drawn(70, 40, 3).requires_grad_(), drawn(70, 40, 3, seed=1), []
    for count in (1, 2):
        with threads(count):
            value = losses.ssim(image, target)
            found.append((value, *torch.autograd.grad(value, image)))
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_ssim_is_differentiable_in_its_target_too():
    image, target = drawn(16, 16, 3), drawn(16, 16, 3, seed=1).requires_grad_()
    losses.ssim(image, target).backward()
    assert target.grad.abs().max() > 0


def test_ssim_lets_nothing_that_is_not_finite_vanish():
    image = drawn(40, 20, 3)
    image[3, 4, 1] = float("nan")
    assert losses.ssim(image, drawn(40, 20, 3, seed=1)).isnan()


def test_ssim_of_equal_images_is_zero_and_grows_with_noise():
    target = drawn(20, 20, 3)
    noise = drawn(20, 20, 3, seed=2) - 0.5
    values = [float(losses.ssim(target + amount * noise, target)) for amount in (0, 0.05, 0.2)]
    assert abs(values[0]) < 1e-6
    assert values[0] < values[1] < values[2]


def test_over_by_hand():
    color, alpha = torch.full((1, 1, 3), 0.3), torch.tensor([[0.5]])
    result = losses.over(color, alpha, torch.tensor([1.0, 0.0, 0.4]))
    torch.testing.assert_close(result.flatten(), torch.tensor([0.8, 0.3, 0.5]))


def test_laplacian_by_hand():
    # Own value minus the neighbours' mean: -1, 1 - 1.5, 2; their squares 1, 0.25, 4.
    values = torch.tensor([[0.0], [1.0], [3.0]])
    assert float(losses.laplacian(values, PATH)) == pytest.approx(5.25 / 3)


def test_laplacian_of_a_constant_is_zero():
    assert float(losses.laplacian(torch.full((3, 2), 7.0), PATH)) == 0


def test_laplacian_gradient():
    values = drawn(3, 2).double()
    dense = SparsePair(PATH.matrix.to_dense().double(), PATH.transpose.to_dense().double())
    assert torch.autograd.gradcheck(lambda x: losses.laplacian(x, dense), values.requires_grad_())


def test_laplacian_weights_each_vertex():
    values, weight = torch.tensor([[0.0], [1.0], [3.0]]), torch.tensor([[2.0], [0.0], [0.5]])
    assert float(losses.laplacian(values, PATH, weight)) == pytest.approx((2 * 1 + 0.5 * 4) / 3)


def test_l2_by_hand():
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    assert float(losses.l2(values)) == 7.5
    assert float(losses.l2(values, torch.tensor([[0.0], [2.0]]))) == 12.5
    assert float(losses.l2(values, 0.0)) == 0


def test_blended_image_has_the_weighted_l1_and_no_gradient_at_weight_zero():
    image, target = drawn(12, 13, 3).requires_grad_(), drawn(12, 13, 3, seed=1)
    weight = torch.ones(12, 13)
    weight[3:5] = 0.0
    weight[7] = 0.25
    value = losses.l1(losses.blend_to_target(image, target, weight), target)
    torch.testing.assert_close(value, (weight[..., None] * (image - target).abs()).mean())
    (value + losses.ssim(losses.blend_to_target(image, target, weight), target)).backward()
    assert (image.grad[3:5] == 0).all() and (image.grad[7] != 0).any()


def test_scale_growth_has_a_penalty_and_shrinking_has_none():
    log_scale = torch.tensor([[-2.0, -0.1, 0.0], [0.5, 1.0, -1.0]], requires_grad=True)
    value = losses.scale_growth(log_scale)
    assert float(value.detach()) == pytest.approx((0.25 + 1) / 6)
    value.backward()
    assert torch.equal(log_scale.grad != 0, log_scale.detach() > 0)


def test_outward_offsets_count_by_their_direction():
    normals = torch.tensor([[0.0, 0.0, 1.0]])
    assert float(losses.outward_offset(0.02 * normals, normals)) == pytest.approx(1, abs=0.01)
    assert float(losses.outward_offset(-0.02 * normals, normals)) == 0
    aslant = torch.tensor([[0.0, 0.02, 0.02]])
    assert float(losses.outward_offset(aslant, normals)) == pytest.approx(2**-0.5, abs=0.01)
    nothing = torch.zeros(4, 3, requires_grad=True)
    losses.outward_offset(nothing, normals.expand(4, 3)).backward()
    assert torch.isfinite(nothing.grad).all()


def test_color_variance_pulls_towards_a_mean_that_stays():
    colors = torch.tensor([[0.0, 0.5, 1.0], [1.0, 0.5, 1.0]], requires_grad=True)
    value = losses.color_variance(colors)
    assert float(value.detach()) == pytest.approx(2 * 0.25 / 6)
    value.backward()
    torch.testing.assert_close(colors.grad, (colors.detach() - colors.detach().mean(0)) * 2 / 6)
