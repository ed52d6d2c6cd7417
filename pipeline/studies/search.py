"""The designs of a tradeoff, made one after the other within a budget of seconds."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from pipeline.errors import UserError
from pipeline.studies.measure import Numbers, score_table
from pipeline.studies.sweep import CHANCE, Design, Level, label_of, overrides_of, shortfalls
from pipeline.studies.variants import Base, Result, Variant


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

    def points(self) -> pd.DataFrame:
        """The designs that have been made so far; see ``point_table``."""
        return point_table([(result, design, "") for design, result in self.results.items()])


Run = tuple[Result, Design | None, str]
"""A result, its design (None for a preset), and the preset that it is (empty if none)."""


def point_table(runs: Sequence[Run], speeds: Mapping[Path, Numbers] | None = None) -> pd.DataFrame:
    """The points of a tradeoff, numbered from 1, in the order of their making.

    Args:
        runs: the base's first.
        speeds: as ``AvatarMeter.speeds`` gives them.

    Returns:
        The columns of ``score_table``, ``result``, ``design`` and ``preset`` as in ``runs``, ``label``;
        ``times``, training cost over the base's; ``gain``, dB over the base; ``chance``, true of another
        seed, which is no choice; and ``short``, dB under the frontier, of the others.
    """
    results, designs, presets = zip(*runs, strict=True)
    points = score_table(results, speeds or {})
    points = points.assign(result=results, preset=presets, label=[one.variant for one in results])
    points["design"] = pd.Series(designs, dtype=object)
    points["chance"] = [bool(design) and design[0].parameter == CHANCE for design in designs]
    points["times"] = points["train_s"] / max(points["train_s"].iloc[0], 1e-9)
    points["gain"] = points["psnr"] - points["psnr"].iloc[0]
    choices = points[~points["chance"]]
    points["short"] = shortfalls(choices["train_s"], choices["psnr"])
    return points.set_axis(points.index + 1)
