"""Long videos in tiles: which frames are denoised together, and how their overlaps are blended."""

from __future__ import annotations

import torch
from torch import Tensor


def tiles(frames: int, size: int, overlap: int) -> list[list[int]]:
    """Frame numbers of each tile.

    Frame 0 shows the reference's own pose and leads every tile, so that each knows whom it shows; the
    others follow one another. Two neighbours have ``overlap`` frames in common, frame 0 among them, and the
    last two as many as it takes to end at the last frame.

    Args:
        frames: of the video, frame 0 included.
        size: frames of a tile; a shorter video is one tile.
        overlap: at least 1 and less than ``size - 1``.

    Raises:
        ValueError: the overlap leaves no way forward.
    """
    if frames <= size:
        return [list(range(frames))]
    if not 1 <= overlap < size - 1:
        raise ValueError(f"an overlap of {overlap} leaves tiles of {size} no way forward")
    last = frames - size
    starts = [*range(0, last, size - overlap), last]
    return [[0, *range(start + 1, start + size)] for start in starts]


def tile_weights(size: int) -> Tensor:
    """The weight of each place in a tile, [size]: a triangle, so that tiles fade into one another."""
    rising = (torch.arange(size) + 0.5) * 2 / size
    return torch.minimum(rising, 2 - rising)
