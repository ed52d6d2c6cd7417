"""Which points nothing beats: no other is both as cheap and as good."""

from __future__ import annotations

import math
from collections.abc import Sequence


def frontier(costs: Sequence[float], qualities: Sequence[float]) -> list[int]:
    """The points that no other dominates, the cheapest first.

    A point dominates another if it costs no more and is no worse, and one of the two is strict. Of points
    that are equal in both, the first one stands for all. Points with a number that is not finite never count.

    Args:
        costs: less is better.
        qualities: more is better; as many.

    Returns:
        Places in the sequences; along them costs and qualities both rise strictly.
    """
    known = [
        place
        for place, pair in enumerate(zip(costs, qualities, strict=True))
        if all(math.isfinite(value) for value in pair)
    ]
    known.sort(key=lambda place: (costs[place], -qualities[place], place))
    kept: list[int] = []
    for place in known:
        if not kept or qualities[place] > qualities[kept[-1]]:
            kept.append(place)
    return kept


def short_of(cost: float, quality: float, costs: Sequence[float], qualities: Sequence[float]) -> float:
    """How much quality a point lacks against the best of those that cost no more; 0 on the frontier.

    Args:
        cost, quality: the point.
        costs, qualities: of what it is compared with, itself included or not.
    """
    affordable = [q for c, q in zip(costs, qualities, strict=True) if c <= cost and math.isfinite(q)]
    return max(0.0, max(affordable, default=quality) - quality)
