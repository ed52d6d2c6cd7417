"""Windows of a long clip: frames that are posed together, and those of them that count.

A window counts its own frames and poses one more on either side, which accelerations and velocities
look at. Every term of a clip belongs to exactly one window, so the windows' losses add up to the loss of
the clip, and so do their gradients.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

_HALO = 1  # frames on either side that differences in time look at


@dataclasses.dataclass(frozen=True)
class Window:
    """Frames ``begin`` to ``end`` - 1 of a clip count; ``low`` to ``high`` - 1 are posed."""

    begin: int
    end: int
    low: int
    high: int

    @property
    def posed(self) -> slice:
        """The posed frames among the clip's."""
        return slice(self.low, self.high)

    @property
    def own(self) -> slice:
        """The frames that count, among the posed ones."""
        return slice(self.begin - self.low, self.end - self.low)

    @property
    def differences(self) -> slice:
        """The first and second differences of posed frames that count.

        A first difference belongs to its later frame, a second difference to its middle one: both have
        the number of that frame, less one.
        """
        return slice(max(self.own.start - 1, 0), self.own.stop - 1)


def windows(count: int, size: int) -> list[Window]:
    """Windows of at most ``size`` own frames that cover ``count`` frames."""
    starts = range(0, count, size)
    ends = [min(start + size, count) for start in starts]
    return [
        Window(begin, end, max(begin - _HALO, 0), min(end + _HALO, count))
        for begin, end in zip(starts, ends, strict=True)
    ]


def bumps(times: Tensor, width: float, low: int = 0, high: int | None = None) -> tuple[Tensor, int, int]:
    """Weights that spread each frame's step over the frames ``low`` to ``high`` - 1.

    A step spreads over time as a Gaussian that ends at three standard deviations.

    Args:
        times: [T], increasing, in the units of :mod:`pipeline.clip.clock`.
        width: standard deviation in the same; 0 moves each frame alone.
        low, high: the frames that move; all by default.

    Returns:
        [high - low, last - first], rows sum to 1, and ``first`` and ``last``: the steps that take part.
    """
    high = len(times) if high is None else high
    if width == 0:
        return torch.eye(high - low), low, high
    reach = 3 * width
    first = int(torch.searchsorted(times, times[low] - reach))
    last = int(torch.searchsorted(times, times[high - 1] + reach, right=True))
    away = times[low:high, None] - times[first:last]
    weight = torch.exp(-away.float().square() / (2 * width**2)) * (away.abs() <= reach)
    return weight / weight.sum(1, keepdim=True), first, last
