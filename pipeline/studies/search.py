"""The designs of a tradeoff, made one after the other within a budget of seconds, and which nothing beats.

Not a full grid: the base, then every level of every sweep parameter alone, then combinations of the levels
that gained most for their time. A design is the tuple of levels that differ from the base; () is the base.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipeline.errors import UserError
from pipeline.studies.measure import Numbers, score_table
from pipeline.studies.sweep import CHANCE, Level
from pipeline.studies.variants import Base, Result, Variant

MOST_COMBINED = 6  # levels that combinations are made of: 15 pairs, 20 triples, ...

Design = tuple[Level, ...]


def label_of(design: Design) -> str:
    """A design's name in tables."""
    return ", ".join(level.label for level in design) or "base"


def overrides_of(design: Design) -> dict[str, str]:
    """The settings that a design sets on top of the base's."""
    return {name: text for level in design for name, text in level.overrides.items()}


def seconds_of(text: str) -> float:
    """Seconds of a length of time such as ``20m``, ``90s``, ``1.5h`` or a bare number of seconds.

    Raises:
        UserError: it is none of these, or not more than nothing.
    """
    try:
        seconds = pd.Timedelta(text if text[-1:].isalpha() else f"{text}s").total_seconds()
    except ValueError:
        seconds = math.nan
    if not seconds > 0:
        raise UserError(f"budget={text}: is no length of time; write 90s, 20m or 2h")
    return seconds


def spoken(seconds: float) -> str:
    """Seconds for people."""
    if seconds >= 7200:
        return f"{seconds / 3600:.1f} h"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


@dataclasses.dataclass
class Search:
    """One subject's designs in the making; what is affordable is judged by what has been made so far.

    Attributes:
        base: whose avatar, and the settings that designs override.
        budget: seconds of this call; results that the store holds cost nothing of it.
        measure: a function: result -> the same with its scores; the base's is asked for first.
        clock: a function: the present second.
        results: design -> result, in the order of their making.
    """

    base: Base
    budget: float
    measure: Callable[[Result], Result]
    clock: Callable[[], float] = time.monotonic
    results: dict[Design, Result] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self._start = self.clock()

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return self.clock() - self._start

    def make(self, design: Design) -> Result:
        """Makes one design up to its trained avatar and measures it."""
        self.results[design] = self.run(self.base, Variant(label_of(design), overrides_of(design)))
        return self.results[design]

    def make_affordable(self, designs: Iterable[Design]) -> None:
        """Makes the designs that the store holds or that what is left of the budget is expected to reach."""
        for design in designs:
            seconds = self.expected_seconds(design)
            if not seconds or seconds <= self.budget - self.spent:
                self.make(design)

    def run(self, base: Base, variant: Variant) -> Result:
        """Makes a variant up to its trained avatar, measures it and prints a line on it."""
        result = self.measure(base.run(variant, ["train"]))
        print(f"[{spoken(self.spent)} of {spoken(self.budget)}] {result.line}", flush=True)
        return result

    def expected_seconds(self, design: Design) -> float:
        """Wall-clock seconds that the stages of a design that the store lacks are expected to take.

        None of it where a setting is wrong, which running tells.
        """
        try:
            missing = self.base.missing("train", overrides_of(design))
        except UserError:
            return 0.0
        seconds = {stage: self.results[()].seconds.get(stage, 0.0) for stage in missing}
        if "train" in seconds:
            seconds["train"] *= math.prod(map(self.cost_ratio, design))
        return sum(seconds.values())

    def cost_ratio(self, level: Level) -> float:
        """Training cost of a level alone over the base's; the guess of it where it has not been made."""
        cost = self.results[(level,)].training_cost if (level,) in self.results else math.nan
        ratio = cost / max(self.results[()].training_cost, 1e-9)
        return ratio if 0 < ratio < math.inf else level.factor


def point_table(
    designs: Mapping[Design, Result],
    presets: Mapping[str, Result] | None = None,
    speeds: Mapping[Path, Numbers] | None = None,
) -> pd.DataFrame:
    """The points of a tradeoff, numbered from 1, in the order of their making.

    Args:
        designs: the base's first.
        presets: by name; they come last.
        speeds: as ``AvatarMeter.speeds`` gives them.

    Returns:
        The columns of ``score_table``; ``label``, as ``1. base``; ``design``, None of a preset; ``preset``,
        empty of others; ``times``, training cost over the base's; ``gain``, dB over the base; ``chance``,
        true of another seed, which is no choice; and ``short``, dB under the frontier, of the others.
    """
    presets = presets or {}
    results = enumerate([*designs.values(), *presets.values()], 1)
    points = score_table(dict(results), speeds or {})
    points["label"] = [f"{number}. {result.variant}" for number, result in points["result"].items()]
    points["design"] = pd.Series([*designs, *[None] * len(presets)], points.index, dtype=object)
    points["preset"] = [*[""] * len(designs), *presets]
    points["chance"] = [bool(design) and design[0].parameter == CHANCE for design in points["design"]]
    points["times"] = points["train_s"] / max(points["train_s"].iloc[0], 1e-9)
    points["gain"] = points["psnr"] - points["psnr"].iloc[0]
    choices = points[~points["chance"]]
    points["short"] = shortfalls(choices["train_s"], choices["psnr"])
    return points


def noise_of(points: pd.DataFrame) -> float:
    """How far another seed's PSNR is off, dB; NaN where none was reached."""
    return points.loc[points["chance"], "gain"].abs().max()


def combinations(points: pd.DataFrame) -> list[Design]:
    """Pairs, then triples and more, of the levels that gained most for their time, the best first.

    Levels count that gain more than chance does, and those that nothing beats, for they save time.

    Args:
        points: the base and what was tried so far, as ``point_table`` gives them.
    """
    noise = noise_of(points)
    alone = points[~points["chance"] & points["design"].map(len).le(1)].dropna(subset=["gain", "times"])
    unbeaten = alone.index.isin(frontier(alone["times"], alone["gain"]))
    gaining = alone["gain"] > (noise if math.isfinite(noise) else 0.0)
    kept = alone[(gaining | unbeaten) & alone["design"].map(bool)]
    best = kept["design"][worth_of(kept).sort_values(kind="stable").index[::-1]][:MOST_COMBINED]
    return [
        tuple(levels)
        for size in range(2, MOST_COMBINED + 1)
        for levels in itertools.combinations(itertools.chain(*best), size)
        if len({level.parameter for level in levels}) == size
    ]


def worth_of(points: pd.DataFrame) -> pd.Series:
    """Quality gained for each e-fold of training time; a loss counts as it is.

    Args:
        points: ``gain``, dB over the base; ``times``, training time over the base's.
    """
    worth = points["gain"] / np.log(points["times"].clip(lower=1.02))
    return worth.where(points["gain"] > 0, points["gain"])


def frontier(costs: pd.Series, qualities: pd.Series) -> list[Any]:
    """The labels of the points that no other dominates, the cheapest first.

    A point dominates another if it costs no more and is no worse, and one of the two is strict. Of points
    that are equal in both, the first one stands for all. Points with a number that is not finite never count.

    Args:
        costs: less is better.
        qualities: more is better; of the same index.
    """
    points = pd.DataFrame({"cost": costs, "quality": qualities}).astype(float)
    points = points[points.abs().lt(math.inf).all(axis=1)]
    points = points.sort_values(["cost", "quality"], ascending=[True, False], kind="stable")
    before = points["quality"].cummax().shift(fill_value=-math.inf)
    return points.index[points["quality"] > before].tolist()


def shortfalls(costs: pd.Series, qualities: pd.Series) -> pd.Series:
    """The quality that each point lacks against the best of those that cost no more; 0 on the frontier."""
    best = costs.map(lambda cost: qualities[costs <= cost].max())
    return (best - qualities).clip(lower=0.0)
