"""The kernels of ``fused_head.py``: the norm between layers, for centred rows with interleaved groups.

Numba does not know bfloat16: it is read as the upper half of a float32, from memory seen as uint16.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from numba.extending import overload
from torch import Tensor

from pipeline.numba_kernels import checked_parallel_kernel, inline_kernel

EPSILON = 1e-5
MOST_LANES = 32
CHUNKS = 16  # of rows; sums over rows are added up chunk by chunk, whatever the number of threads


def lanes_of(channels: int, groups: int) -> np.uint64:
    """The number of channels that the kernels take at a time: a power of two times the groups."""
    lanes = groups
    while lanes * 2 <= MOST_LANES and channels % (lanes * 2) == 0:
        lanes *= 2
    return np.uint64(lanes)


def bits(x: Tensor) -> np.ndarray:
    """The tensor's memory as numpy can hold it: bfloat16 as uint16."""
    x = x.detach()
    return x.view(torch.uint16).numpy() if x.dtype == torch.bfloat16 else x.numpy()


def load(x):
    """A stored number as float32."""


def rounded(value, like):
    """A float32 as a number of the same kind as ``like`` is stored."""


@overload(load, inline="always")
def _load(x):
    if x is numba.types.uint16:
        return lambda x: np.uint32(np.uint32(x) << np.uint32(16)).view(np.float32)
    return lambda x: x


@overload(rounded, inline="always")
def _rounded(value, like):
    if like is not numba.types.uint16:
        return lambda value, like: value

    def to_nearest_even(value, like):
        word = np.float32(value).view(np.uint32)
        return np.uint16(
            (word + np.uint32(0x7FFF) + ((word >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16)
        )

    return to_nearest_even


# Lane counts are run-time numbers and unsigned, or the loops would be unrolled before they are vectorised.


@inline_kernel
def _fold(sums, lanes, groups):
    """Adds up the lanes of each group, into the first ``groups`` places."""
    half = lanes
    while half > groups:
        half = half >> np.uint64(1)
        for lane in range(half):
            sums[lane] += sums[lane + half]


@inline_kernel
def _spread(sums, lanes, groups):
    """Repeats the first ``groups`` places over all lanes."""
    half = groups
    while half < lanes:
        for lane in range(half):
            sums[lane + half] = sums[lane]
        half = half << np.uint64(1)


@inline_kernel
def _inverse_deviation(row, inverse, lanes, groups, channels):
    for lane in range(lanes):
        inverse[lane] = np.float32(0)
    first = np.uint64(0)
    while first < channels:
        for lane in range(lanes):
            inverse[lane] += row[first + lane] * row[first + lane]
        first += lanes
    _fold(inverse, lanes, groups)
    scale = np.float32(groups) / np.float32(channels)
    for lane in range(groups):
        inverse[lane] = np.float32(1) / np.sqrt(inverse[lane] * scale + np.float32(EPSILON))
    _spread(inverse, lanes, groups)


@inline_kernel
def _standardise(row, inverse, lanes, groups, channels):
    """Divides each group of a centred row by its deviation, in place."""
    _inverse_deviation(row, inverse, lanes, groups, channels)
    first = np.uint64(0)
    while first < channels:
        for lane in range(lanes):
            row[first + lane] *= inverse[lane]
        first += lanes


@checked_parallel_kernel
def norm_relu(x, weight, bias, lanes, groups, y):
    """``y = relu(group_norm(x))``, [N, C], float32 or bfloat16 as uint16; weight and bias [C] float32."""
    rows, channels = x.shape[0], np.uint64(x.shape[1])
    step = (rows + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        normal, inverse = np.empty(channels, np.float32), np.empty(lanes, np.float32)
        for row in range(chunk * step, min(rows, (chunk + 1) * step)):
            for k in range(channels):
                normal[k] = load(x[row, k])
            _standardise(normal, inverse, lanes, groups, channels)
            for k in range(channels):
                value = normal[k] * weight[k] + bias[k]
                y[row, k] = rounded(np.float32(0) if value < 0 else value, x[row, k])


@checked_parallel_kernel
def sum_norm_relu(products, shared, own, own_weight, weight, bias, lanes, groups, y):
    """``norm_relu`` of ``products + shared + own @ own_weight``."""
    rows, channels = products.shape[0], np.uint64(products.shape[1])
    step = (rows + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        normal, inverse = np.empty(channels, np.float32), np.empty(lanes, np.float32)
        for row in range(chunk * step, min(rows, (chunk + 1) * step)):
            for k in range(channels):
                normal[k] = load(products[row, k]) + shared[k]
            for e in range(own.shape[1]):
                for k in range(channels):
                    normal[k] += own[row, e] * own_weight[e, k]
            _standardise(normal, inverse, lanes, groups, channels)
            for k in range(channels):
                value = normal[k] * weight[k] + bias[k]
                y[row, k] = rounded(np.float32(0) if value < 0 else value, products[row, k])


@inline_kernel
def _standardise_backward(push, normal, inverse, along, lanes, groups, channels):
    """Turns the gradient of standardised values into that of the centred ones before, in place."""
    for lane in range(lanes):
        along[lane] = np.float32(0)
    first = np.uint64(0)
    while first < channels:
        for lane in range(lanes):
            along[lane] += push[first + lane] * normal[first + lane]
        first += lanes
    _fold(along, lanes, groups)
    for lane in range(groups):
        along[lane] *= np.float32(groups) / np.float32(channels)
    _spread(along, lanes, groups)
    first = np.uint64(0)
    while first < channels:
        for lane in range(lanes):
            k = first + lane
            push[k] = inverse[lane] * (push[k] - normal[k] * along[lane])
        first += lanes


@inline_kernel
def _affine_backward(push, normal, weight, sums):
    """Adds up the parameters' gradients, and turns that after scaling into that before, in place."""
    channels = np.uint64(len(push))
    for k in range(channels):
        sums[0, k] += push[k] * normal[k]
        sums[1, k] += push[k]
        push[k] *= weight[k]


@checked_parallel_kernel
def norm_relu_backward(x, gradient, weight, bias, lanes, groups, to_x, y, sums):
    """Gradients of ``norm_relu``'s ``x`` and, added to ``sums``, of weight, bias and all rows of x.

    ``to_x`` may be ``gradient``. ``y`` is computed again.
    """
    rows, channels = x.shape[0], np.uint64(x.shape[1])
    step = (rows + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        normal, push = np.empty(channels, np.float32), np.empty(channels, np.float32)
        inverse, along = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
        own = np.empty((3, channels), np.float32)
        for part in range(3):
            for k in range(channels):
                own[part, k] = np.float32(0)
        for row in range(chunk * step, min(rows, (chunk + 1) * step)):
            for k in range(channels):
                normal[k] = load(x[row, k])
            _standardise(normal, inverse, lanes, groups, channels)
            for k in range(channels):
                value = normal[k] * weight[k] + bias[k]
                push[k] = load(gradient[row, k]) if value > 0 else np.float32(0)
                y[row, k] = rounded(np.float32(0) if value < 0 else value, x[row, k])
            _affine_backward(push, normal, weight, own)
            _standardise_backward(push, normal, inverse, along, lanes, groups, channels)
            for k in range(channels):
                own[2, k] += push[k]
                to_x[row, k] = rounded(push[k], x[row, k])
        for part in range(3):
            for k in range(channels):
                sums[chunk, part, k] += own[part, k]
