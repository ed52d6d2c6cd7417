"""GroupNorm followed by ReLU, as one pass over the data on a CPU.

Between the heads' matrix products, torch would run layer_norm, a scaling, a ReLU and their four
backward kernels, each of them a pass over memory. They cost more than the products do. Here the
forward pass is one kernel and the backward pass another, on float32 or bfloat16 (which numba does
not know: it is read as the upper half of a float32). ``reference`` says what they mean.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
import torch.nn.functional as functional
from numba.extending import overload
from torch import Tensor

EPSILON = 1e-5
CHUNKS = 16  # of rows; sums over rows are added up chunk by chunk, whatever the number of threads
FAST = {"contract", "arcp", "nsz", "afn", "reassoc"}  # never "nnan" or "ninf": what is not finite must show


def reference(x: Tensor, weight: Tensor, bias: Tensor, groups: int) -> Tensor:
    """``relu(group_norm(x))`` of [N, C], by torch's ``layer_norm`` on a view."""
    rows, channels = x.shape
    size = channels // groups
    normal = functional.layer_norm(x.view(rows, groups, size), (size,), eps=EPSILON).view(rows, channels)
    return functional.relu(torch.addcmul(bias.to(x.dtype), normal, weight.to(x.dtype)))


def group_norm_relu(x: Tensor, weight: Tensor, bias: Tensor, groups: int) -> Tensor:
    """``relu(group_norm(x))``, [N, C] -> [N, C] of the same dtype.

    Args:
        x: [N, C], float32 or bfloat16 on a CPU for the fast kernels; anything else takes the
            reference's way.
        weight, bias: [C] float32.
        groups: must divide C.
    """
    known = x.dtype in (torch.float32, torch.bfloat16) and weight.dtype == torch.float32
    if known and x.device.type == "cpu":
        return _GroupNormReLU.apply(x, weight, bias, groups)
    return reference(x, weight, bias, groups)


class _GroupNormReLU(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, bias: Tensor, groups: int) -> Tensor:
        x = x.contiguous()
        ctx.save_for_backward(x, weight, bias)
        ctx.groups = groups
        y = torch.empty_like(x)
        _forward(_bits(x), _bits(weight), _bits(bias), groups, _bits(y))
        return y

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        x, weight, bias = ctx.saved_tensors
        to_x, sums = torch.empty_like(x), np.zeros((CHUNKS, 2, x.shape[1]), np.float32)
        push = _bits(gradient.to(x.dtype).contiguous())
        _backward(_bits(x), push, _bits(weight), _bits(bias), ctx.groups, _bits(to_x), sums)
        total = torch.from_numpy(sums.sum(0))
        return to_x, total[0], total[1], None


def _bits(x: Tensor) -> np.ndarray:
    """The tensor's memory as numpy can hold it: bfloat16 as uint16."""
    x = x.detach()
    return x.view(torch.uint16).numpy() if x.dtype == torch.bfloat16 else x.numpy()


@numba.njit(fastmath=FAST, cache=True)
def _standardise(row, inverse, size):
    """Subtracts each group's mean and divides by its deviation, in place; ``inverse`` gets 1 / deviation."""
    scale = np.float32(1) / np.float32(size)
    for group in range(len(inverse)):
        first = np.uint64(group) * size
        total = np.float32(0)
        squares = np.float32(0)
        for k in range(first, first + size):
            total += row[k]
        mean = total * scale
        for k in range(first, first + size):
            squares += (row[k] - mean) * (row[k] - mean)
        inverse[group] = np.float32(1) / np.sqrt(squares * scale + np.float32(EPSILON))
        for k in range(first, first + size):
            row[k] = (row[k] - mean) * inverse[group]


@numba.njit(fastmath=FAST, cache=True)
def _standardise_backward(push, normal, inverse, size):
    """Turns the gradient of standardised values into that of the values before, in place."""
    scale = np.float32(1) / np.float32(size)
    for group in range(len(inverse)):
        first = np.uint64(group) * size
        along = np.float32(0)
        mean = np.float32(0)
        for k in range(first, first + size):
            mean += push[k]
            along += push[k] * normal[k]
        mean *= scale
        along *= scale
        for k in range(first, first + size):
            push[k] = inverse[group] * (push[k] - mean - normal[k] * along)


@numba.njit(fastmath=FAST, cache=True)
def _affine_relu_backward(push, normal, weight, bias, sums):
    """Turns the gradient after scaling and ReLU into that before, in place; adds up the parameters'."""
    channels = np.uint64(len(push))
    for k in range(channels):
        push[k] = push[k] if normal[k] * weight[k] + bias[k] > 0 else np.float32(0)
    for k in range(channels):
        sums[0, k] += push[k] * normal[k]
    for k in range(channels):
        sums[1, k] += push[k]
    for k in range(channels):
        push[k] *= weight[k]


def _load(x):
    """A stored number as float32."""


def _round(value, like):
    """A float32 as a number of the same kind as ``like`` is stored."""


@overload(_load, inline="always")
def _load_overload(x):
    if x is numba.types.uint16:
        return lambda x: np.uint32(np.uint32(x) << np.uint32(16)).view(np.float32)
    return lambda x: x


@overload(_round, inline="always")
def _round_overload(value, like):
    if like is not numba.types.uint16:
        return lambda value, like: value

    def to_nearest_even(value, like):
        bits = np.float32(value).view(np.uint32)
        return np.uint16(
            (bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16)
        )

    return to_nearest_even


@numba.njit(parallel=True, fastmath=FAST, cache=True)
def _forward(x, weight, bias, groups, y):
    rows, channels = x.shape[0], np.uint64(x.shape[1])
    size = channels // np.uint64(groups)
    step = (rows + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        normal = np.empty(channels, np.float32)
        inverse = np.empty(groups, np.float32)
        for row in range(chunk * step, min(rows, (chunk + 1) * step)):
            for k in range(channels):
                normal[k] = _load(x[row, k])
            _standardise(normal, inverse, size)
            for k in range(channels):
                normal[k] = normal[k] * weight[k] + bias[k]
            for k in range(channels):
                y[row, k] = _round(np.float32(0) if normal[k] < 0 else normal[k], x[row, k])


@numba.njit(parallel=True, fastmath=FAST, cache=True)
def _backward(x, gradient, weight, bias, groups, to_x, sums):
    rows, channels = x.shape[0], np.uint64(x.shape[1])
    size = channels // np.uint64(groups)
    step = (rows + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        normal = np.empty(channels, np.float32)
        push = np.empty(channels, np.float32)
        inverse = np.empty(groups, np.float32)
        for row in range(chunk * step, min(rows, (chunk + 1) * step)):
            for k in range(channels):
                normal[k] = _load(x[row, k])
            for k in range(channels):
                push[k] = _load(gradient[row, k])
            _standardise(normal, inverse, size)
            _affine_relu_backward(push, normal, weight, bias, sums[chunk])
            _standardise_backward(push, normal, inverse, size)
            for k in range(channels):
                to_x[row, k] = _round(push[k], x[row, k])
