"""Structural similarity and its gradient at once on a CPU.

Its plain twin is ``plain_ssim_loss`` in ``ssim.py``, where the definition stands; tests hold them together.

Four local means are enough: of both images, of the sum of their squares and of their product. The loss is a
scalar, so its gradient is known but for a factor as soon as its value is: the derivatives with respect to
three of the means (the target has none) go back through the transposed window while they are in the cache.
Colours stay side by side as they are in the image; a tap of the window is three numbers away.

Pixels are taken in bands of rows of a fixed height, so that the result does not depend on the threads.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipeline.numba_kernels import checked_kernel, checked_parallel_kernel, inline_kernel, use_torch_threads

TAPS, REACH = 11, 5  # pixels, of the window and to either side of its middle
BAND = 32  # rows
MEANS = 4  # of the image, the target, the sum of their squares, their product


def fused_ssim_loss(
    image: Tensor,  # [H, W, C]
    target: Tensor,  # [H, W, C]
    window: Tensor,  # [11]
    constants: tuple[float, float],
) -> Tensor:
    """One minus the mean structural similarity, scalar; only the image gets a gradient.

    Args:
        image, target: of one dtype, float32 or float64, at least 6 pixels along each side.
        window: symmetric, adds up to one.
        constants: C1 and C2.
    """
    return _Ssim.apply(image, target, window.to(image), constants)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, window: Tensor, constants: Any) -> Tensor:
        use_torch_threads()
        x, y = (one.detach().contiguous().numpy() for one in (image, target))
        rows, channels = len(x), np.uint64(x.shape[2])
        flat, taps = (x.reshape(rows, -1), y.reshape(rows, -1)), window.numpy()
        c1, c2 = (x.dtype.type(one) for one in constants)
        wanted = ctx.needs_input_grad[0]
        slopes = np.empty((3, *flat[0].shape) if wanted else (3, 1, 1), x.dtype)
        sums = np.zeros(rows, np.float64)
        similarity(*flat, taps, channels, c1, c2, wanted, sums, slopes)
        if wanted:
            gradient = np.empty_like(x)
            pull_back(*flat, taps, channels, slopes, x.dtype.type(-1 / x.size), gradient.reshape(rows, -1))
            ctx.save_for_backward(torch.from_numpy(gradient))
        return image.new_tensor(1 - sums.sum() / x.size)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, push: Tensor) -> tuple[Tensor, None, None, None]:
        return ctx.saved_tensors[0] * push, None, None, None


@inline_kernel
def _mirrored(place, length):
    """A row or column beyond the border, mirrored at the outermost one."""
    place = abs(place)
    return place if place < length else 2 * (length - 1) - place


@checked_kernel
def _along_row(wide, taps, channels, narrow):
    """The window over a row that is 5 pixels wider on either side."""
    a, b, c, d, e, f = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    s = np.uint64(channels)
    for i in range(np.uint64(narrow.shape[0])):
        narrow[i] = (
            a * (wide[i] + wide[i + np.uint64(10) * s])
            + b * (wide[i + s] + wide[i + np.uint64(9) * s])
            + c * (wide[i + np.uint64(2) * s] + wide[i + np.uint64(8) * s])
            + d * (wide[i + np.uint64(3) * s] + wide[i + np.uint64(7) * s])
            + e * (wide[i + np.uint64(4) * s] + wide[i + np.uint64(6) * s])
            + f * wide[i + np.uint64(5) * s]
        )


@checked_kernel
def _across_rows(band, first, taps, row):
    """The window down the columns of a band [rows, C W], over its rows from ``first`` on."""
    a, b, c, d, e, f = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    n = np.uint64(first)
    for i in range(np.uint64(row.shape[0])):
        row[i] = (
            a * (band[n, i] + band[n + np.uint64(10), i])
            + b * (band[n + np.uint64(1), i] + band[n + np.uint64(9), i])
            + c * (band[n + np.uint64(2), i] + band[n + np.uint64(8), i])
            + d * (band[n + np.uint64(3), i] + band[n + np.uint64(7), i])
            + e * (band[n + np.uint64(4), i] + band[n + np.uint64(6), i])
            + f * band[n + np.uint64(5), i]
        )


@checked_kernel
def _widen(row, channels, wide):
    """A row with 5 mirrored pixels on either side."""
    width = row.shape[0] // channels
    for i in range(np.uint64(row.shape[0])):
        wide[i + np.uint64(REACH) * channels] = row[i]
    for k in range(REACH):
        left, right = _mirrored(k - REACH, width), _mirrored(width + k, width)
        for c in range(channels):
            wide[k * channels + c] = row[left * channels + c]
            wide[(width + REACH + k) * channels + c] = row[right * channels + c]


@checked_kernel
def _row_means(x, y, taps, channels, wide, band, place):
    """The four quantities of one row of the images, averaged along it."""
    _widen(x, channels, wide[0])
    _widen(y, channels, wide[1])
    for i in range(np.uint64(wide.shape[1])):
        wide[2, i] = wide[0, i] * wide[0, i] + wide[1, i] * wide[1, i]
        wide[3, i] = wide[0, i] * wide[1, i]
    for mean in range(MEANS):
        _along_row(wide[mean], taps, channels, band[mean, place])


@checked_kernel
def _row_value(means, c1, c2):
    """The sum of the similarities of a row of pixels."""
    total = c1 - c1
    for i in range(np.uint64(means.shape[1])):
        mx, my, squares, product = means[0, i], means[1, i], means[2, i], means[3, i]
        both, own = mx * my, mx * mx + my * my
        covariance = product - both
        value = (both + both + c1) * (covariance + covariance + c2)
        total += value / ((own + c1) * (squares - own + c2))
    return total


@checked_kernel
def _row_slopes(means, c1, c2, of_mean, of_squares, of_product):
    """The derivatives of a row's similarities with respect to three of their means."""
    one = c1 / c1
    for i in range(np.uint64(means.shape[1])):
        mx, my, squares, product = means[0, i], means[1, i], means[2, i], means[3, i]
        both, own = mx * my, mx * mx + my * my
        covariance = product - both
        n1, n2 = both + both + c1, covariance + covariance + c2
        i1, i2 = one / (own + c1), one / (squares - own + c2)
        similar = n1 * n2 * i1 * i2
        half = my * (n2 - n1) * i1 * i2 - mx * similar * (i1 - i2)
        of_mean[i], of_squares[i] = half + half, -similar * i2
        of_product[i] = (n1 + n1) * i1 * i2


@checked_parallel_kernel
def similarity(x, y, taps, channels, c1, c2, wanted, sums, slopes):
    """The structural similarity of two images.

    Args:
        x, y: [H, W C].
        taps: [11].
        channels: uint64, C.
        c1, c2: numbers of the images' dtype.
        wanted: whether ``slopes`` are.
        sums: output [H] float64, each row's similarities added up.
        slopes: output [3, H, W C], the similarities' derivatives with respect to the local mean of the image,
            of both images' squares, and of the product.
    """
    rows, width = x.shape
    for number in numba.prange((rows + BAND - 1) // BAND):
        first = number * BAND
        last = min(rows, first + BAND)
        wide = np.empty((MEANS, width + 2 * REACH * int(channels)), x.dtype)
        band, means = np.empty((MEANS, BAND + 2 * REACH, width), x.dtype), np.empty((MEANS, width), x.dtype)
        for place in range(last - first + 2 * REACH):
            row = _mirrored(first + place - REACH, rows)
            _row_means(x[row], y[row], taps, channels, wide, band, place)
        for row in range(first, last):
            for mean in range(MEANS):
                _across_rows(band[mean], row - first, taps, means[mean])
            sums[row] = _row_value(means, c1, c2)
            if wanted:
                _row_slopes(means, c1, c2, slopes[0, row], slopes[1, row], slopes[2, row])


@checked_kernel
def _add_row(row, factor, total):
    for i in range(np.uint64(total.shape[0])):
        total[i] += factor * row[i]


@checked_kernel
def _gather_rows(slope, place, taps, total):
    """The derivatives that reach row ``place`` of the image down the columns, mirrored rows included."""
    rows = slope.shape[0]
    total[:] = 0
    mirrored = (place, -place, 2 * (rows - 1) - place)
    for turn in range(3):
        there = mirrored[turn]
        if turn > 0 and (there == place or there < -REACH or there >= rows + REACH):
            continue
        for tap in range(TAPS):
            row = there - tap + REACH
            if row >= 0 and row < rows:
                _add_row(slope[row], taps[tap], total)


@checked_kernel
def _gather_along(row, taps, channels, padded, wide, total):
    """The transposed window along a row, mirrored pixels folded back.

    Args:
        padded: scratch, 10 pixels wider on either side; wide: scratch, 5 pixels wider on either side.
    """
    count, reach = np.uint64(row.shape[0]), np.uint64(REACH) * channels
    width = row.shape[0] // channels
    padded[:] = 0
    for i in range(count):
        padded[i + np.uint64(2) * reach] = row[i]
    _along_row(padded, taps, channels, wide)
    for i in range(count):
        total[i] = wide[i + reach]
    for k in range(REACH):
        left, right = _mirrored(k - REACH, width), _mirrored(width + k, width)
        for c in range(channels):
            total[left * channels + c] += wide[k * channels + c]
            total[right * channels + c] += wide[(width + REACH + k) * channels + c]


@checked_parallel_kernel
def pull_back(x, y, taps, channels, slopes, factor, gradient):
    """The gradient of the image from the derivatives with respect to local means.

    Args:
        x, y, taps, channels: as for ``similarity``.
        slopes: [3, H, W C], as it leaves them.
        factor: of the images' dtype, that the gradient is multiplied with.
        gradient: output [H, W C].
    """
    rows, width = x.shape
    for number in numba.prange((rows + BAND - 1) // BAND):
        reach = REACH * int(channels)
        column, pulled = np.empty(width, x.dtype), np.empty((3, width), x.dtype)
        padded, wide = np.empty(width + 4 * reach, x.dtype), np.empty(width + 2 * reach, x.dtype)
        for row in range(number * BAND, min(rows, number * BAND + BAND)):
            for slope in range(3):
                _gather_rows(slopes[slope], row, taps, column)
                _gather_along(column, taps, channels, padded, wide, pulled[slope])
            for i in range(np.uint64(width)):
                slant = x[row, i] * pulled[1, i]
                gradient[row, i] = factor * (pulled[0, i] + slant + slant + y[row, i] * pulled[2, i])
