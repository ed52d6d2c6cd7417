"""A cache of which Gaussians each training frame showed when it was last drawn.

The pose heads work for one frame at a time, and a Gaussian that the frame does not show gets no gradient from
it. So they are asked only for those that the frame showed the last time. Every Gaussian is drawn all the
same, with its static part alone if need be: one that becomes visible is noticed at once, and has its
pose-dependent part back when the frame is drawn next.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

UNKNOWN = -1


class FrameVisibilityCache(nn.Module):
    """One bit for each training frame and Gaussian. A checkpoint holds its buffers.

    Attributes:
        bits: [F, N / 8] uint8, which Gaussians the frames showed, of the N of the finest level.
        levels: [F] int8, the level of subdivision that the frame was drawn at, or UNKNOWN.
    """

    bits: Tensor  # [F, N / 8]
    levels: Tensor  # [F]

    def __init__(self, frames: tuple[int, ...], count: int):
        """An empty cache.

        Args:
            frames: the numbers of the training frames.
            count: Gaussians of the finest level.
        """
        super().__init__()
        self._places = {frame: place for place, frame in enumerate(frames)}
        self.register_buffer("bits", torch.zeros(len(frames), -(-count // 8), dtype=torch.uint8))
        self.register_buffer("levels", torch.full((len(frames),), UNKNOWN, dtype=torch.int8))

    def visible_rows(self, frame: int, level: int, count: int, kept: Tensor | None = None) -> Tensor | None:
        """The Gaussians that a frame showed, [M] int64; None if it was not drawn at this level yet.

        Args:
            frame: its number.
            level: of subdivision.
            count: Gaussians of this level that the visibility gate leaves.
            kept: [count] int64, which of the level's these are; the first ``count`` if None.
        """
        place = self._places[frame]
        if int(self.levels[place]) != level:
            return None
        visible = _unpacked(self.bits[place])
        return torch.nonzero(visible[:count] if kept is None else visible[kept])[:, 0]

    def record(self, frame: int, level: int, weights: Tensor, kept: Tensor | None = None) -> None:
        """Stores which Gaussians a frame has shown; gated ones count as not visible.

        Args:
            frame: its number.
            level: of subdivision.
            weights: [N], each Gaussian's summed blending weight.
            kept: as for ``visible_rows``.
        """
        place, device = self._places[frame], self.bits.device
        visible = torch.zeros(8 * self.bits.shape[1], dtype=torch.uint8, device=device)
        drawn = torch.arange(len(weights), device=device) if kept is None else kept
        visible[drawn] = (weights > 0).to(torch.uint8)
        powers = torch.tensor([1, 2, 4, 8, 16, 32, 64, 128], dtype=torch.uint8, device=device)
        self.bits[place] = (visible.view(-1, 8) * powers).sum(1, dtype=torch.uint8)
        self.levels[place] = level


def _unpacked(bits: Tensor) -> Tensor:
    """The bits of bytes, the lowest first: [B] uint8 -> [8 B] uint8."""
    return (bits[:, None] >> torch.arange(8, dtype=torch.uint8, device=bits.device) & 1).flatten()
