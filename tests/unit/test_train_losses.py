"""Every term of the training objective, against a hand value or an independent implementation."""

import pytest
import torch

from pipeline.avatar.sparse import SparsePair
from pipeline.metrics import ssim_loss
from stages.train import losses

# A path of three vertices, 0 - 1 - 2.
PATH = SparsePair.build(
    torch.tensor([0, 1, 1, 2]), torch.tensor([1, 0, 2, 1]), torch.tensor([1.0, 0.5, 0.5, 1.0]), (3, 3)
)


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def test_l1_by_hand():
    assert torch.equal(
        losses.l1(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.25)), torch.full((2, 2, 3), 0.25)
    )


def test_weighted_mean_by_hand():
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    assert float(losses.weighted_mean(values)) == 2.5
    assert float(losses.weighted_mean(values, torch.tensor([[0.0], [2.0]]))) == 3.5
    assert float(losses.weighted_mean(values, 2.0, count=10)) == 2


def test_laplacian_by_hand():
    # Own value minus the neighbours' mean: -1, 1 - 1.5, 2.
    values = torch.tensor([[0.0], [1.0], [3.0]])
    assert losses.laplacian(values, PATH).flatten().tolist() == pytest.approx([1, 0.25, 4])


def test_laplacian_of_a_constant_is_zero():
    assert not losses.laplacian(torch.full((3, 2), 7.0), PATH).any()


def test_laplacian_gradient():
    values = drawn(3, 2).double()
    dense = SparsePair(PATH.matrix.to_dense().double(), PATH.transpose.to_dense().double())
    assert torch.autograd.gradcheck(lambda x: losses.laplacian(x, dense), values.requires_grad_())


def test_l2_by_hand():
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    assert losses.l2(values).tolist() == [[1, 4], [9, 16]]


def test_blended_image_has_the_weighted_l1_and_no_gradient_at_weight_zero():
    image, target = drawn(12, 13, 3).requires_grad_(), drawn(12, 13, 3, seed=1)
    weight = torch.ones(12, 13)
    weight[3:5] = 0.0
    weight[7] = 0.25
    value = losses.l1(losses.blend_to_target(image, target, weight), target).mean()
    torch.testing.assert_close(value, (weight[..., None] * (image - target).abs()).mean())
    (value + ssim_loss(losses.blend_to_target(image, target, weight), target)).backward()
    assert (image.grad[3:5] == 0).all() and (image.grad[7] != 0).any()


def test_scale_growth_has_a_penalty_and_shrinking_has_none():
    log_scale = torch.tensor([[-2.0, -0.1, 0.0], [0.5, 1.0, -1.0]], requires_grad=True)
    value = losses.scale_growth(log_scale)
    assert float(value.detach().sum()) == pytest.approx(0.25 + 1)
    value.sum().backward()
    assert torch.equal(log_scale.grad != 0, log_scale.detach() > 0)


def test_scale_shrink_is_the_other_half():
    log_scale = torch.tensor([[-2.0, -0.1, 0.0], [0.5, 1.0, -1.0]])
    both = losses.scale_growth(log_scale) + losses.scale_shrink(log_scale)
    torch.testing.assert_close(both, log_scale.square())


def test_outward_offsets_count_by_their_direction():
    normals = torch.tensor([[0.0, 0.0, 1.0]])
    assert float(losses.outward_offset(0.02 * normals, normals)) == pytest.approx(1, abs=0.01)
    assert float(losses.outward_offset(-0.02 * normals, normals)) == 0
    aslant = torch.tensor([[0.0, 0.02, 0.02]])
    assert float(losses.outward_offset(aslant, normals)) == pytest.approx(2**-0.5, abs=0.01)
    nothing = torch.zeros(4, 3, requires_grad=True)
    losses.outward_offset(nothing, normals.expand(4, 3)).sum().backward()
    assert torch.isfinite(nothing.grad).all()


def test_color_variance_pulls_towards_a_mean_that_stays():
    colors = torch.tensor([[0.0, 0.5, 1.0], [1.0, 0.5, 1.0]], requires_grad=True)
    value = losses.color_variance(colors)
    assert float(value.detach().sum()) == pytest.approx(2 * 0.25)
    value.sum().backward()
    torch.testing.assert_close(colors.grad, (colors.detach() - colors.detach().mean(0)) * 2)
