"""Hard cuts of a film: where one shot ends and another begins, and the shot that is taken."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipeline.errors import UserError

CUT = 0.5  # least distance of the pictures on either side: 0 for equal ones, 1.4 for those without a relation
TIMES = 3.0  # what the pictures around differ by
_FLAT = 4.0  # grey levels: noise of pictures that show nothing
AROUND = 6  # neighbouring pairs on either side that are compared with


@dataclasses.dataclass(frozen=True)
class FilmShot:
    """Frames between two cuts: the numbers of the first and the last, and how many there are."""

    first: int
    last: int
    count: int

    def __contains__(self, frame: int) -> bool:
        """True for a frame of the shot."""
        return self.first <= frame <= self.last


def find_cuts(thumbnails: Sequence[np.ndarray]) -> list[int]:
    """The places that begin a new shot, increasing; the first picture is not among them.

    A cut is a pair of neighbours that differ much, and many times as much as the pairs around them. After a
    flash, the pictures on its two sides are alike again: that is no cut.

    Args:
        thumbnails: of all frames in order, [h, w] grey, small.
    """
    steps = [_difference(a, b) for a, b in zip(thumbnails[:-1], thumbnails[1:], strict=True)]
    cuts: list[int] = []
    for place, step in enumerate(steps):
        around = steps[max(0, place - AROUND) : place] + steps[place + 1 : place + 1 + AROUND]
        if step < CUT or (around and step < TIMES * float(np.quantile(around, 0.9))):
            continue
        before, after = thumbnails[max(0, place - 1)], thumbnails[min(len(thumbnails) - 1, place + 2)]
        flash = min(_difference(before, thumbnails[place + 1]), _difference(thumbnails[place], after))
        if flash >= CUT / 2:
            cuts.append(place + 1)
    return cuts


def film_shots(frames: Sequence[int], cuts: Sequence[int]) -> list[FilmShot]:
    """The shots of a film, in order.

    Args:
        frames: the frames' numbers, as many as there were thumbnails.
        cuts: of ``find_cuts``.
    """
    starts, ends = [0, *cuts], [*cuts, len(frames)]
    return [FilmShot(frames[a], frames[b - 1], b - a) for a, b in zip(starts, ends, strict=True) if b > a]


def choose_shot(
    shots: Sequence[FilmShot], searched: Sequence[tuple[int, int]], number: int, name: str
) -> FilmShot:
    """The shot of a number, or the longest that shows somebody.

    Args:
        shots: of a film, one at least.
        searched: (frame number, how many people were found in it).
        number: counted from 1; 0 for the longest.
        name: of the film, for messages.

    Raises:
        UserError: there is no shot of that number.
    """
    if number > len(shots):
        shown = f"{len(shots)} shots" if len(shots) > 1 else "one shot"
        raise UserError(f"{name} has {shown}: ingest.shot={number} is none of them, choose a lower number")
    if number:
        return shots[number - 1]
    peopled = {row for frame, count in searched for row, shot in enumerate(shots) if count and frame in shot}
    rows = sorted(peopled or range(len(shots)))
    return shots[max(rows, key=lambda row: (shots[row].count, -row))]


def _difference(first: np.ndarray, second: np.ndarray) -> float:
    """The distance of two thumbnails, sqrt(2 - 2 r) of their correlation r; exposure does not change it."""
    pair = [one.astype(np.float32) - one.mean() for one in (first, second)]
    spread = [float(np.sqrt(np.square(one).mean())) + _FLAT for one in pair]
    return float(np.sqrt(np.square(pair[0] / spread[0] - pair[1] / spread[1]).mean()))
