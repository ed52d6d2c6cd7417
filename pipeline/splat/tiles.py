"""Lists of the Gaussians that each tile of the image may show, front to back, as numba kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.numba_kernels import kernel

# A tile's side in pixels: a row of a tile is one vector of sixteen lanes, or two of eight, ...
TILE = 16

# Three passes of 11 bits cover the 32 bits of a key.
_RADIX_BITS = 11
_RADIX = 1 << _RADIX_BITS
_PASSES = 3


class Tiles(NamedTuple):
    """Lists of Gaussians, one for each tile, one after the other.

    Attributes:
        starts: int64 [tiles + 1], where each tile's list begins. Tiles are numbered row by row.
        members: int32 [M], the Gaussians of each list in order of depth.
        slots: int32 [M], for each member its own place in an array in which the places of one Gaussian are
            neighbours: what tiles write there is summed without locks, in an order that is always the same.
        slot_starts: int64 [N + 1], where each Gaussian's slots begin.
    """

    starts: np.ndarray
    members: np.ndarray
    slots: np.ndarray
    slot_starts: np.ndarray


@kernel
def sort_by_depth(depths, drawn):
    """Order of depth among the Gaussians ``drawn``.

    A stable radix sort, least significant digit first: equal depths stay in order of index.

    Args:
        depths: float32 [M], positive, so that their bits as unsigned integers are in the same order.
        drawn: int32 [M], the Gaussians that these are the depths of.

    Returns:
        int32 [M]: ``drawn`` from front to back.
    """
    count = depths.shape[0]
    keys, ids = depths.view(np.uint32), drawn
    histogram = np.zeros((_PASSES, _RADIX), np.int64)
    for key in keys:
        for digit in range(_PASSES):
            histogram[digit, (key >> np.uint32(digit * _RADIX_BITS)) & np.uint32(_RADIX - 1)] += 1
    for digit in range(_PASSES):
        shift = np.uint32(digit * _RADIX_BITS)
        total = 0
        for value in range(_RADIX):
            size = histogram[digit, value]
            histogram[digit, value] = total
            total += size
        sorted_keys, sorted_ids = np.empty(count, np.uint32), np.empty(count, np.int32)
        for k in range(count):
            value = (keys[k] >> shift) & np.uint32(_RADIX - 1)
            place = histogram[digit, value]
            histogram[digit, value] = place + 1
            sorted_keys[place], sorted_ids[place] = keys[k], ids[k]
        keys, ids = sorted_keys, sorted_ids
    return ids


@kernel
def _drawn(records, depth_column, boxes):
    """The Gaussians that have a box, and their depths: int32 [M], float32 [M]."""
    ids, depths = np.empty(boxes.shape[0], np.int32), np.empty(boxes.shape[0], np.float32)
    count = 0
    for i in range(boxes.shape[0]):
        if boxes[i, 2] > 0:
            ids[count], depths[count] = i, records[i, depth_column]
            count += 1
    return ids[:count], depths[:count]


@kernel
def _append(order, boxes, columns, starts, slot_starts):
    """Append the Gaussians in the given order to their tiles' lists; see ``Tiles``."""
    ends = starts[:-1].copy()
    members, slots = np.empty(slot_starts[-1], np.int32), np.empty(slot_starts[-1], np.int32)
    for k in range(order.shape[0]):
        # Unsigned indices, and nothing read from an array in the inner loops that the writes to the others
        # might have changed for all that the compiler knows: twice as fast.
        i = np.uint32(order[k])
        left, top, right, bottom = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
        slot = slot_starts[i]
        for y in range(top, bottom):
            for x in range(left, right):
                tile = np.uint64(y * columns + x)
                member = np.uint64(ends[tile])
                ends[tile] += 1
                members[member], slots[member] = i, slot
                slot += 1
    return members, slots


@kernel
def bin_gaussians(records, depth_column, boxes, columns, rows):
    """Make the ``Tiles`` of an image that has ``columns`` x ``rows`` tiles.

    Sorting the Gaussians once, then appending each to its tiles, needs no sort of the many (Gaussian, tile)
    pairs.

    Args:
        records: [N, RECORD_WIDTH] as ``project_forward`` leaves them, with the depth in ``depth_column``.
        boxes: int32 [N, 4], the tiles of each Gaussian.
    """
    starts = np.zeros(columns * rows + 1, np.int64)
    slot_starts = np.empty(boxes.shape[0] + 1, np.int64)
    total = 0
    for i in range(boxes.shape[0]):
        slot_starts[i] = total
        for y in range(boxes[i, 1], boxes[i, 3]):
            for x in range(boxes[i, 0], boxes[i, 2]):
                starts[y * columns + x + 1] += 1
                total += 1
    slot_starts[-1] = total
    for tile in range(columns * rows):
        starts[tile + 1] += starts[tile]

    ids, depths = _drawn(records, depth_column, boxes)
    members, slots = _append(sort_by_depth(depths, ids), boxes, columns, starts, slot_starts)
    return Tiles(starts, members, slots, slot_starts)


def deal_tiles(starts: np.ndarray, workers: int) -> np.ndarray:
    """An order of tiles in which ``workers`` equal runs are about equally much work: int64 [tiles].

    The scheduler hands each thread one run. Heavy tiles come first in each.
    """
    heaviest_first = np.argsort(-np.diff(starts), kind="stable")
    return np.concatenate([heaviest_first[worker::workers] for worker in range(workers)])
