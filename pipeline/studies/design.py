"""Which settings to try next, so that a frontier is found in a stated time.

Not a full grid. First the base, then every level of every knob alone (each knob's first level before any
knob's second, the cheapest first), then combinations: from every point of the frontier one knob is turned to
a level that has been tried alone, and of these the one is made that is expected to push the frontier out the
most for each second that making it takes. Costs multiply and gains add up, as far as is known from the
levels tried alone. The next point depends on what was made and what is left of the budget, so that an
interrupted study goes on as it would have; a point whose results are in the store costs nothing.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

from pipeline.studies.frontier import frontier
from pipeline.studies.knobs import Knob

Point = tuple[int, ...]
"""A level of each knob; 0 is the study's own."""

LEAST_AREA = 0.01  # dB times e-foldings of cost, that a combination must promise
TRAIN = "train"


@dataclasses.dataclass(frozen=True)
class Made:
    """A point that was made.

    Attributes:
        point: which.
        seconds: stage -> wall-clock seconds of the run that made its result.
        cost: what it is plotted over.
        quality: what it is plotted by; NaN where it failed.
    """

    point: Point
    seconds: Mapping[str, float]
    cost: float
    quality: float


def base_of(knobs: Sequence[Knob]) -> Point:
    """The study's own settings."""
    return (0,) * len(knobs)


def words_of(knobs: Sequence[Knob], point: Point) -> dict[str, str]:
    """The words of a point, on top of the study's own."""
    words: dict[str, str] = {}
    for knob, level in zip(knobs, point, strict=True):
        words |= knob.levels[level].words
    return words


def label_of(knobs: Sequence[Knob], point: Point) -> str:
    """What a point differs in from the study's own settings."""
    turned = [knob.levels[level].label for knob, level in zip(knobs, point, strict=True) if level]
    return ", ".join(turned) or "base"


def singles(knobs: Sequence[Knob]) -> list[Point]:
    """Every level alone: each knob's first before any knob's second."""
    base = base_of(knobs)
    depth = max((len(knob.levels) for knob in knobs), default=1)
    return [
        turned(base, place, level)
        for level in range(1, depth)
        for place, knob in enumerate(knobs)
        if level < len(knob.levels)
    ]


def turned(point: Point, place: int, level: int) -> Point:
    """The point with one knob at another level."""
    return (*point[:place], level, *point[place + 1 :])


class Design:
    """What is known of the costs and gains of each level, from the points made so far."""

    def __init__(self, knobs: Sequence[Knob], made: Sequence[Made]) -> None:
        self.knobs, self.made = knobs, {one.point: one for one in made}
        self.base = self.made.get(base_of(knobs))

    def _single(self, place: int, level: int) -> Made | None:
        return self.made.get(turned(base_of(self.knobs), place, level))

    def ratio(self, place: int, level: int, of: Callable[[Made], float], guess: float) -> float:
        """How many times the base a level costs by itself."""
        alone = self._single(place, level) if level else self.base
        if alone is None or self.base is None:
            return guess
        ratio = of(alone) / max(of(self.base), 1e-9)
        return ratio if math.isfinite(ratio) and ratio > 0 else guess

    def seconds(self, point: Point, stages: Sequence[str]) -> float:
        """How long these stages of a point are expected to take; 0 where nothing is known of them."""
        if self.base is None:
            return 0.0
        total = 0.0
        for stage in stages:
            expected = self.base.seconds.get(stage, 0.0)
            for place, level in enumerate(point):
                if level:
                    guess = self.knobs[place].levels[level].factor if stage == TRAIN else 1.0
                    expected *= self.ratio(place, level, functools.partial(_seconds, stage), guess)
            total += expected
        return total

    def gain(self, place: int, level: int) -> float:
        """What a level adds to the base's quality by itself; NaN where that is not known."""
        alone = self._single(place, level) if level else self.base
        return alone.quality - self.base.quality if alone and self.base else math.nan

    def combinations(self) -> Iterator[tuple[Point, float, float]]:
        """Points one knob off the frontier that have not been made, with the cost and quality expected."""
        made = [one for one in self.made.values() if self._combines(one.point)]
        for place_in in frontier([one.cost for one in made], [one.quality for one in made]):
            start = made[place_in]
            for place, knob in enumerate(self.knobs):
                for level in range(len(knob.levels)) if knob.combines else ():
                    point = turned(start.point, place, level)
                    gain = self.gain(place, level) - self.gain(place, start.point[place])
                    if point in self.made or not math.isfinite(gain):
                        continue
                    cost = start.cost * self._cost_ratio(place, level)
                    yield point, cost / self._cost_ratio(place, start.point[place]), start.quality + gain

    def _combines(self, point: Point) -> bool:
        return all(knob.combines or not level for knob, level in zip(self.knobs, point, strict=True))

    def _cost_ratio(self, place: int, level: int) -> float:
        return self.ratio(place, level, lambda one: one.cost, self.knobs[place].levels[level].factor)

    def promise(self, cost: float, quality: float) -> float:
        """By how much a point would push the frontier out."""
        made = [one for one in self.made.values() if self._combines(one.point)]
        known = [(one.cost, one.quality) for one in made if math.isfinite(one.quality)]
        corner = 2 * max(one for one, _ in known), min(one for _, one in known)
        return area([*known, (cost, quality)], corner) - area(known, corner)


def area(points: Sequence[tuple[float, float]], corner: tuple[float, float]) -> float:
    """What a frontier has under it: quality above the corner's, over the logarithm of cost.

    Args:
        points: cost and quality of each.
        corner: the highest cost and the lowest quality that count.
    """
    inside = [(cost, quality) for cost, quality in points if cost < corner[0]]
    costs, qualities = [one for one, _ in inside], [one for _, one in inside]
    kept = frontier(costs, qualities)
    ends = [*(costs[place] for place in kept[1:]), corner[0]][: len(kept)]
    return sum(
        (math.log(end) - math.log(costs[place])) * max(0.0, qualities[place] - corner[1])
        for place, end in zip(kept, ends, strict=True)
    )


def _seconds(stage: str, one: Made) -> float:
    return one.seconds.get(stage, math.nan)


def next_single(
    knobs: Sequence[Knob],
    made: Sequence[Made],
    needed: Callable[[Point], Sequence[str]],
    left: float,
    slowness: float = 1.0,
) -> Point | None:
    """The base, or the next level to try alone; None when all are made or none fits what is left.

    Args:
        knobs: what can be turned.
        made: so far, failed ones too.
        needed: the stages of a point that the store does not hold.
        left: seconds of the budget; the base is made whatever it is.
        slowness: how many times longer than expected things have been taking.
    """
    known = Design(knobs, made)
    if base_of(knobs) not in known.made:
        return base_of(knobs)
    missing = [point for point in singles(knobs) if point not in known.made]
    # In an order that does not hang on what happens to be stored, so that a resumed study keeps to it.
    missing.sort(key=lambda point: (max(point), known.seconds(point, (TRAIN,))))
    return next((point for point in missing if affordable(known, point, needed, left, slowness)), None)


def affordable(
    known: Design, point: Point, needed: Callable[[Point], Sequence[str]], left: float, slowness: float
) -> bool:
    """Whether a point is in the store, or is expected to be made within what is left."""
    stages = needed(point)
    return not stages or slowness * known.seconds(point, stages) <= left


def next_combination(
    knobs: Sequence[Knob],
    made: Sequence[Made],
    needed: Callable[[Point], Sequence[str]],
    left: float,
    slowness: float = 1.0,
) -> Point | None:
    """The combination that promises the most a second; None when none promises enough or fits what is left.

    Args:
        knobs, made, needed, left, slowness: as for ``next_single``.
    """
    known = Design(knobs, made)
    if known.base is None or not math.isfinite(known.base.quality):
        return None
    best, most = None, 0.0
    for point, expected, quality in known.combinations():
        promise = known.promise(expected, quality)
        if promise < LEAST_AREA:
            continue
        value = promise / max(known.seconds(point, (TRAIN,)), 1.0)
        if value > most and affordable(known, point, needed, left, slowness):
            best, most = point, value
    return best
