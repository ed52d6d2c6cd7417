"""The decoders: their norm, their condition on the pose, and how they start."""

import numpy as np
import pytest
import torch
from torch import nn

from pipeline.avatar.head import GroupNormReLU, Head
from pipeline.avatar.head_kernels import CHUNKS, bits, lanes_of, norm_relu, norm_relu_backward


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def randomised(module: nn.Module) -> nn.Module:
    for number, parameter in enumerate(module.parameters()):
        parameter.data = 0.3 * drawn(*parameter.shape, seed=number + 10)
    return module


@pytest.mark.parametrize("groups", [1, 4, 8])
def test_norm_equals_torchs_group_norm_with_gradients(groups):
    ours, theirs = randomised(GroupNormReLU(groups, 32)), nn.GroupNorm(groups, 32)
    theirs.load_state_dict(ours.state_dict())
    inputs = [(3 * drawn(50, 32) + 1).requires_grad_() for _ in range(2)]
    outputs = [ours(inputs[0]), theirs(inputs[1]).relu()]
    torch.testing.assert_close(*outputs)
    for output in outputs:
        (output * drawn(50, 32, seed=1)).sum().backward()
    torch.testing.assert_close(inputs[0].grad, inputs[1].grad, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours.weight.grad, theirs.weight.grad, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours.bias.grad, theirs.bias.grad, rtol=1e-4, atol=1e-5)


def test_kernels_in_bfloat16_give_the_rounded_result_with_gradients():
    x, push = (drawn(40, 32, seed=seed).bfloat16() for seed in (0, 3))
    norm, lanes = [bits(drawn(32, seed=seed)) for seed in (1, 2)], lanes_of(32, 4)
    results = []
    for kind in (torch.float32, torch.bfloat16):
        y, again, to_x = (torch.empty(40, 32, dtype=kind) for _ in range(3))
        sums = np.zeros((CHUNKS, 3, 32), np.float32)
        norm_relu(bits(x.to(kind)), *norm, lanes, np.uint64(4), bits(y))
        given = bits(x.to(kind)), bits(push.to(kind))
        norm_relu_backward(*given, *norm, lanes, np.uint64(4), bits(to_x), bits(again), sums)
        assert torch.equal(y, again)
        results.append((y, to_x, sums))
    single, half = results
    assert torch.equal(half[0], single[0].bfloat16())  # rounded to nearest, as torch rounds
    assert torch.equal(half[1], single[1].bfloat16())
    np.testing.assert_allclose(half[2], single[2], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("half", [False, True])
def test_head_lets_nothing_that_is_not_finite_vanish(half):
    head, x = randomised(Head(8, 2, width=16, groups=4)), drawn(3, 8)
    x[1, 2] = float("nan")
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        output = head(x)
    assert output[1].isnan().all() and output[::2].isfinite().all()


def test_split_first_layer_equals_concatenated_inputs():
    head = randomised(Head(12, 5, condition=7, width=16, groups=4))
    whole = Head(12 + 7, 5, width=16, groups=4)
    weights = head.state_dict()
    joined = torch.cat([weights.pop("first.weight"), weights.pop("condition.weight")], 1)
    whole.load_state_dict({**weights, "first.weight": joined})
    points, shared = drawn(30, 12), drawn(7, seed=3)
    expected = whole(torch.cat([points, shared.expand(30, 7)], 1))
    torch.testing.assert_close(head(points, shared), expected)
    assert not torch.allclose(head(points, shared), head(points, 2 * shared))


def test_new_head_changes_nothing_and_learns():
    head = Head(12, 5, condition=7, width=16, groups=4)
    output = head(drawn(30, 12), drawn(7))
    assert torch.equal(output, torch.zeros(30, 5))
    (output - 1).square().sum().backward()
    assert head.last.weight.grad.abs().max() > 0


def test_conditioned_head_needs_its_condition():
    with pytest.raises(ValueError, match="conditioned"):
        Head(4, 2, condition=3, width=8, groups=2)(drawn(5, 4))


def test_half_precision_stays_close():
    head = randomised(Head(12, 5, width=16, groups=4))
    with torch.autocast("cpu", torch.bfloat16):
        half = head(drawn(30, 12))
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), head(drawn(30, 12)), rtol=0.1, atol=0.1)
