"""Blending the Gaussians of each tile front to back, forward and backward, as numba kernels.

A tile's pixels live in one small buffer of planes, and the rows of a tile that a Gaussian touches are one
loop over it, which the compiler turns into vector instructions. What lets it is easily undone:

* Indices are unsigned. Signed ones bring numba's wrap-around for negative indices into the loop: eight times
  slower.
* The number of iterations is known at run time only (whole rows, so no remainder is left over). A loop of
  constant length is unrolled before the vectoriser looks at it: as bad.
* The planes are one array at constant distances, so that nothing can overlap, as far as the compiler knows.
* What a pixel decides is a select, never a branch.

A pixel's transmittance is stored negated once the pixel has ended.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange, types
from numba.extending import overload

from pipeline.numba_kernels import kernel, parallel_kernel
from pipeline.splat import image_formation as constants
from pipeline.splat.tiles import TILE

_PIXELS = TILE * TILE

# Records are copied from memory in batches before they are used: they lie far apart, and the misses of a
# batch overlap where those of one record after the other do not.
_BATCH = 32
_WIDTH = 12  # the columns of a record that are copied, in the order of ``project``
# Then planes of _PIXELS numbers. Of both passes: the pixels' centres, and the transmittance.
_X, _Y, _T = (np.uint64(_BATCH * _WIDTH + k * _PIXELS) for k in range(3))
# Of the forward pass: colour and depth.
_R, _G, _B, _D = (np.uint64(_T + k * _PIXELS) for k in (1, 2, 3, 4))
_FORWARD_SIZE = int(_D) + _PIXELS
# Of the backward pass: what is still to come of the loss, and the gradients of colour and depth.
_REST, _VR, _VG, _VB, _VD = (np.uint64(_T + k * _PIXELS) for k in (1, 2, 3, 4, 5))
_BACKWARD_SIZE = int(_VD) + _PIXELS


class Limits(NamedTuple):
    """Numbers of the blending in the dtype of the records, which a literal would widen to double."""

    zero: np.floating
    half: np.floating
    one: np.floating
    alpha_max: np.floating
    alpha_min: np.floating
    transmittance_min: np.floating
    touch: np.floating


# What ending a pixel counts as weight: it marks a member that nothing of is seen and that yet must be drawn
# again in the backward pass. The least weight there can be is ALPHA_MIN * TRANSMITTANCE_MIN.
_TOUCH = 1e-30
_LEAST_WEIGHT = 1e-8


def make_limits(dtype: type[np.floating]) -> Limits:
    """The limits of ``constants`` as numbers of type ``dtype``."""
    numbers = (0.0, 0.5, 1.0, constants.ALPHA_MAX, constants.ALPHA_MIN, constants.TRANSMITTANCE_MIN, _TOUCH)
    return Limits(*(dtype(number) for number in numbers))


def _exp_negative(sigma):
    """exp(-sigma), for sigma >= 0, in sigma's precision; single precision to 2e-7 relative."""
    raise NotImplementedError("only inside kernels")


@overload(_exp_negative, jit_options={"fastmath": {"contract", "arcp", "nsz", "afn", "reassoc"}})
def _overload_exp_negative(sigma):
    if sigma != types.float32:
        return lambda sigma: math.exp(-sigma)
    real = np.float32

    def single(sigma):
        # A library's expf is a call, which would end the vectorising: 2^k 2^f, with a polynomial for 2^f.
        t = min(sigma, real(80.0)) * real(-1.4426950408889634)
        k = np.int32(t - real(0.5))
        f = t - real(k)
        p = real(1.5403530393381608e-4)
        p = p * f + real(1.3333558146428443e-3)
        p = p * f + real(9.618129107628477e-3)
        p = p * f + real(5.550410866482158e-2)
        p = p * f + real(0.2402265069591007)
        p = p * f + real(0.6931471805599453)
        p = p * f + real(1.0)
        return p * np.int32((k + np.int32(127)) << np.int32(23)).view(np.float32)

    return single


@kernel
def _base(k):
    """The place in the buffer at which the batch's record k begins."""
    return np.uint64(k) * np.uint64(_WIDTH)


@kernel
def _fetch(records, i, base, left, top, buffer):
    """Copy record i into the buffer, with its mean relative to the tile's corner."""
    buffer[base] = records[i, 0] - left
    buffer[base + np.uint64(1)] = records[i, 1] - top
    for column in range(np.uint64(2), np.uint64(_WIDTH)):
        buffer[base + column] = records[i, column]


@kernel
def _start_tile(buffer, width, height, limits):
    """Clear the planes; give the tile's ``width`` x ``height`` pixels transmittance one, the rest none."""
    buffer[int(_T) :] = limits.zero
    for y in range(TILE):
        for x in range(TILE):
            i = y * TILE + x
            buffer[int(_X) + i], buffer[int(_Y) + i] = x + 0.5, y + 0.5
            if x < width and y < height:
                buffer[int(_T) + i] = limits.one


@kernel
def _all_ended(buffer, limits):
    """True where no pixel of the tile can take any more."""
    most = limits.zero
    for i in range(int(_T), int(_T) + _PIXELS):
        most = max(most, buffer[i])
    return most <= limits.zero


@kernel
def _record(buffer, base):
    """The record at ``base``: mean (2), half conic xx, xy, half conic yy, opacity, colour (3), depth."""
    mean_x, mean_y = buffer[base], buffer[base + np.uint64(1)]
    xx, xy, yy = buffer[base + np.uint64(2)], buffer[base + np.uint64(3)], buffer[base + np.uint64(4)]
    opacity, depth = buffer[base + np.uint64(5)], buffer[base + np.uint64(9)]
    red, green, blue = buffer[base + np.uint64(6)], buffer[base + np.uint64(7)], buffer[base + np.uint64(8)]
    return mean_x, mean_y, xx, xy, yy, opacity, red, green, blue, depth


@kernel
def _pixel_range(buffer, base, top):
    """The pixels of the tile from the first to the last row that the record at ``base`` can touch."""
    first, end = int(buffer[base + np.uint64(10)]), int(buffer[base + np.uint64(11)])
    first, end = max(first - top, 0), min(end - top, TILE)
    return np.uint64(first) * np.uint64(TILE), np.uint64(end) * np.uint64(TILE)


@kernel
def _draw(buffer, base, top, limits):
    """Draw the record at ``base`` of the buffer over the tile; its summed weight, see _TOUCH."""
    zero, _, _, alpha_max, alpha_min, transmittance_min, touch = limits
    mean_x, mean_y, xx, xy, yy, opacity, red, green, blue, depth = _record(buffer, base)
    first, end = _pixel_range(buffer, base, top)
    total = zero
    for i in range(first, end):
        t = buffer[_T + i]
        dx, dy = buffer[_X + i] - mean_x, buffer[_Y + i] - mean_y
        sigma = (xx * dx + xy * dy) * dx + yy * dy * dy
        alpha = min(alpha_max, opacity * _exp_negative(sigma))
        drawable = (t > zero) & (sigma >= zero) & (alpha >= alpha_min)
        behind = t - t * alpha
        drawn = drawable & (behind > transmittance_min)
        ends = drawable & (behind <= transmittance_min)
        weight = alpha * t if drawn else zero
        buffer[_R + i] += weight * red
        buffer[_G + i] += weight * green
        buffer[_B + i] += weight * blue
        buffer[_D + i] += weight * depth
        buffer[_T + i] = behind if drawn else (-t if ends else t)
        total += touch if ends else weight
    return total


@parallel_kernel
def blend_forward(
    order, tiles, columns, records, limits, color, depth, transmittance, member_weights, slot_weights
):
    """Draw every tile.

    Args:
        order: int64 [tiles], the order in which tiles are taken.
        tiles: ``Tiles`` of ``columns`` tiles a row.
        records: [N, RECORD_WIDTH], as ``project_forward`` leaves them.
        limits: ``Limits`` in the records' dtype.
        color: output [H, W, 3]; depth: output [H, W]; transmittance: output [H, W].
        member_weights: output [M], each member's weight summed over its tile.
        slot_weights: output [M], the same, slot by slot.
    """
    height, width = depth.shape
    for q in prange(order.shape[0]):
        tile = order[q]
        top, left = tile // columns * TILE, tile % columns * TILE
        tile_width, tile_height = min(width - left, TILE), min(height - top, TILE)
        buffer = np.empty(_FORWARD_SIZE, records.dtype)
        _start_tile(buffer, tile_width, tile_height, limits)
        first, stop = tiles.starts[tile], tiles.starts[tile + 1]
        while first < stop and not _all_ended(buffer, limits):
            end = min(first + _BATCH, stop)
            for k in range(first, end):
                _fetch(records, tiles.members[k], _base(k - first), left, top, buffer)
            for k in range(first, end):
                weight = _draw(buffer, _base(k - first), top, limits)
                member_weights[k], slot_weights[tiles.slots[k]] = weight, weight
            first = end
        for k in range(first, stop):
            member_weights[k], slot_weights[tiles.slots[k]] = limits.zero, limits.zero
        for y in range(tile_height):
            for x in range(tile_width):
                i = y * TILE + x
                transmittance[top + y, left + x] = abs(buffer[int(_T) + i])
                color[top + y, left + x, 0] = buffer[int(_R) + i]
                color[top + y, left + x, 1] = buffer[int(_G) + i]
                color[top + y, left + x, 2] = buffer[int(_B) + i]
                depth[top + y, left + x] = buffer[int(_D) + i]


@parallel_kernel
def sum_weights(slot_starts, slot_weights, weights):
    """Sum each Gaussian's weights over its tiles: [M] -> ``weights`` [N]."""
    for i in prange(weights.shape[0]):
        total = 0.0
        for j in range(slot_starts[i], slot_starts[i + 1]):
            total += slot_weights[j]
        weights[i] = total if total > _LEAST_WEIGHT else 0.0


@kernel
def _weigh(buffer, base, top, limits, sums):
    """Draw the record at ``base`` of the buffer; ``sums`` [4] gets its weights times the picture's planes."""
    zero, _, _, alpha_max, alpha_min, transmittance_min, _ = limits
    mean_x, mean_y, xx, xy, yy, opacity, _, _, _, _ = _record(buffer, base)
    first, end = _pixel_range(buffer, base, top)
    s_red = s_green = s_blue = s_fourth = zero
    for i in range(first, end):
        t = buffer[_T + i]
        dx, dy = buffer[_X + i] - mean_x, buffer[_Y + i] - mean_y
        sigma = (xx * dx + xy * dy) * dx + yy * dy * dy
        alpha = min(alpha_max, opacity * _exp_negative(sigma))
        drawable = (t > zero) & (sigma >= zero) & (alpha >= alpha_min)
        behind = t - t * alpha
        drawn = drawable & (behind > transmittance_min)
        ends = drawable & (behind <= transmittance_min)
        weight = alpha * t if drawn else zero
        s_red += weight * buffer[_R + i]
        s_green += weight * buffer[_G + i]
        s_blue += weight * buffer[_B + i]
        s_fourth += weight * buffer[_D + i]
        buffer[_T + i] = behind if drawn else (-t if ends else t)
    sums[0], sums[1], sums[2], sums[3] = s_red, s_green, s_blue, s_fourth


@parallel_kernel
def blend_sums(order, tiles, columns, records, limits, member_weights, picture, slot_sums):
    """Each tile's sums, for each of its Gaussians, of blending weight times a picture.

    Args:
        order, tiles, columns, records, limits: as given to ``blend_forward``.
        member_weights: as ``blend_forward`` left them.
        picture: [H, W, 4].
        slot_sums: output [M, 4]; not written for a member without weight.
    """
    height, width = picture.shape[:2]
    for q in prange(order.shape[0]):
        tile = order[q]
        first, stop = tiles.starts[tile], tiles.starts[tile + 1]
        if first < stop:
            top, left = tile // columns * TILE, tile % columns * TILE
            tile_width, tile_height = min(width - left, TILE), min(height - top, TILE)
            buffer, batch = np.empty(_FORWARD_SIZE, records.dtype), np.empty(_BATCH, np.int64)
            _start_tile(buffer, tile_width, tile_height, limits)
            for y in range(tile_height):
                for x in range(tile_width):
                    i = y * TILE + x
                    buffer[int(_R) + i] = picture[top + y, left + x, 0]
                    buffer[int(_G) + i] = picture[top + y, left + x, 1]
                    buffer[int(_B) + i] = picture[top + y, left + x, 2]
                    buffer[int(_D) + i] = picture[top + y, left + x, 3]
            while first < stop:
                count, first = _fetch_touched(
                    records, tiles.members, member_weights, first, stop, left, top, buffer, batch
                )
                for k in range(count):
                    _weigh(buffer, _base(k), top, limits, slot_sums[tiles.slots[batch[k]]])


@kernel
def _load_gradients(buffer, left, top, width, height, image, gradients):
    """Fill the backward pass's planes.

    What is still to come of the loss, before the first Gaussian, is the image times its gradient, less what
    alpha's gradient has at stake in the transmittance that is left.
    """
    color, depth, transmittance = image
    g_color, g_alpha, g_depth = gradients
    for y in range(height):
        for x in range(width):
            i, v, u = y * TILE + x, top + y, left + x
            red, green, blue, far = g_color[v, u, 0], g_color[v, u, 1], g_color[v, u, 2], g_depth[v, u]
            rest = color[v, u, 0] * red + color[v, u, 1] * green + color[v, u, 2] * blue + depth[v, u] * far
            buffer[int(_REST) + i] = rest - g_alpha[v, u] * transmittance[v, u]
            buffer[int(_VR) + i], buffer[int(_VG) + i], buffer[int(_VB) + i] = red, green, blue
            buffer[int(_VD) + i] = far


@kernel
def _redraw(buffer, base, top, limits, slots, slot):
    """Redraw the record at ``base`` over the tile, and leave its gradients in ``slots`` [M, GRADIENT_WIDTH].

    With q = colour · its gradient + depth · its gradient, and ``rest`` = the sum of weight q over what lies
    behind, less alpha's share: dL/dalpha = T q - rest / (1 - alpha), and dL/dsigma = -alpha dL/dalpha.
    """
    zero, half, one, alpha_max, alpha_min, transmittance_min, _ = limits
    mean_x, mean_y, xx, xy, yy, opacity, red, green, blue, depth = _record(buffer, base)
    first, end = _pixel_range(buffer, base, top)
    s = sx = sy = sxx = sxy = syy = s_red = s_green = s_blue = s_depth = zero
    for i in range(first, end):
        t = buffer[_T + i]
        dx, dy = buffer[_X + i] - mean_x, buffer[_Y + i] - mean_y
        sigma = (xx * dx + xy * dy) * dx + yy * dy * dy
        unclamped = opacity * _exp_negative(sigma)
        alpha = min(alpha_max, unclamped)
        drawable = (t > zero) & (sigma >= zero) & (alpha >= alpha_min)
        behind = t - t * alpha
        drawn = drawable & (behind > transmittance_min)
        ends = drawable & (behind <= transmittance_min)
        weight = alpha * t if drawn else zero
        v_red, v_green, v_blue, v_depth = buffer[_VR + i], buffer[_VG + i], buffer[_VB + i], buffer[_VD + i]
        q = red * v_red + green * v_green + blue * v_blue + depth * v_depth
        rest = buffer[_REST + i] - weight * q
        buffer[_REST + i] = rest
        buffer[_T + i] = behind if drawn else (-t if ends else t)
        slope = (rest / (one - alpha) - t * q) * unclamped
        g_sigma = slope if (drawn & (unclamped <= alpha_max)) else zero
        gx, gy = g_sigma * dx, g_sigma * dy
        s += g_sigma
        sx += gx
        sy += gy
        sxx += gx * dx
        sxy += gx * dy
        syy += gy * dy
        s_red += weight * v_red
        s_green += weight * v_green
        s_blue += weight * v_blue
        s_depth += weight * v_depth
    slots[slot, 0], slots[slot, 1] = -(xx * sx + xx * sx + xy * sy), -(xy * sx + yy * sy + yy * sy)
    slots[slot, 2], slots[slot, 3], slots[slot, 4] = half * sxx, sxy, half * syy
    slots[slot, 5] = -s / opacity
    slots[slot, 6], slots[slot, 7], slots[slot, 8], slots[slot, 9] = s_red, s_green, s_blue, s_depth


@kernel
def _fetch_touched(records, members, member_weights, first, stop, left, top, buffer, batch):
    """Fetch the next members that were drawn into the buffer and note them in ``batch``.

    Returns:
        How many were fetched, and the member to go on from.
    """
    count = 0
    while first < stop and count < _BATCH:
        if member_weights[first] > 0.0:
            _fetch(records, members[first], _base(count), left, top, buffer)
            batch[count] = first
            count += 1
        first += 1
    return count, first


@parallel_kernel
def blend_backward(order, tiles, columns, records, limits, member_weights, image, gradients, slot_gradients):
    """The gradients of every tile, front to back a second time.

    Front to back, T is multiplied by 1 - alpha as it was before; back to front it would have to be divided.

    Args:
        order, tiles, columns, records, limits: as given to ``blend_forward``.
        member_weights: as ``blend_forward`` left them.
        image: (color, depth, transmittance) as ``blend_forward`` left them.
        gradients: (color, alpha, depth), the loss's gradients for [H, W, 3], [H, W], [H, W].
        slot_gradients: output [M, GRADIENT_WIDTH], what each tile has for each of its Gaussians; not written
            for a member without weight.
    """
    height, width = image[1].shape
    for q in prange(order.shape[0]):
        tile = order[q]
        first, stop = tiles.starts[tile], tiles.starts[tile + 1]
        if first < stop:
            top, left = tile // columns * TILE, tile % columns * TILE
            tile_width, tile_height = min(width - left, TILE), min(height - top, TILE)
            buffer, batch = np.empty(_BACKWARD_SIZE, records.dtype), np.empty(_BATCH, np.int64)
            _start_tile(buffer, tile_width, tile_height, limits)
            _load_gradients(buffer, left, top, tile_width, tile_height, image, gradients)
            while first < stop:
                count, first = _fetch_touched(
                    records, tiles.members, member_weights, first, stop, left, top, buffer, batch
                )
                for k in range(count):
                    _redraw(buffer, _base(k), top, limits, slot_gradients, tiles.slots[batch[k]])
