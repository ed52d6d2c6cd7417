"""Some of many frames, evenly spread over them.

Two rules, because the frames that each has chosen are in published results. They agree on how many, and
differ at the end: ``spread_from_start`` takes the first of each of ``count`` equal parts, and never the last
item; ``spread_end_to_end`` takes both ends and what lies evenly between.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

Item = TypeVar("Item")


def spread_from_start(items: Sequence[Item], count: int) -> tuple[Item, ...]:
    """At most ``count`` of the items, the first of each of as many equal parts; all if there are no more.

    >>> spread_from_start(range(10), 4)
    (0, 2, 5, 7)
    """
    if len(items) <= count:
        return tuple(items)
    return tuple(items[place * len(items) // count] for place in range(count))


def spread_end_to_end(items: Sequence[Item], count: int) -> list[Item]:
    """At most ``count`` of the items, evenly spaced, first and last included; the middle one if count is 1.

    >>> spread_end_to_end(range(10), 4)
    [0, 3, 6, 9]
    """
    if count >= len(items):
        return list(items)
    if count == 1:
        return [items[len(items) // 2]]
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]
