"""Every term of the training objective, against a hand value or an independent implementation."""

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from pipeline.avatar.sparse import SparsePair
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


def test_size_by_hand():
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    assert float(losses.size(values)) == 7.5
    assert float(losses.size(values, torch.tensor([False, True]))) == 12.5
    assert float(losses.size(values, torch.tensor([False, False]))) == 0
