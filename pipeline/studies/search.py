"""The designs of a tradeoff, made one after the other within a budget of seconds."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable

import pandas as pd

from pipeline.errors import UserError
from pipeline.studies.sweep import CHANCE, Design, Level, label_of, overrides_of
from pipeline.studies.variants import Base, Result, Variant

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
TRAIN, VIEWS = "train", "auxiliary"


def seconds_of(text: str) -> float:
    """Seconds of a length of time such as ``20m``, ``90s``, ``1.5h`` or a bare number of seconds.

    Raises:
        UserError: it is none of these, or not more than nothing.
    """
    number, unit = (text[:-1], text[-1]) if text and text[-1] in UNITS else (text, "s")
    try:
        seconds = float(number) * UNITS[unit]
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise UserError(f"budget={text}: is no length of time; write 90s, 20m or 2h")
    return seconds


def spoken(seconds: float) -> str:
    """Seconds for people."""
    if seconds >= 7200:
        return f"{seconds / 3600:.1f} h"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def training_cost(result: Result) -> float:
    """Processor seconds of training and of the views made for it; NaN of a failure."""
    return math.nan if result.failure else sum(result.cpu_seconds.get(stage, 0.0) for stage in (TRAIN, VIEWS))


@dataclasses.dataclass
class Search:
    """One subject's designs in the making; what is affordable is judged by what has been made so far.

    Attributes:
        base: whose avatar, and the settings that designs override.
        budget: seconds of this call; results that the store holds cost nothing of it.
        psnr_of: a function: result -> its quality in dB; the base's is asked for first.
        clock: a function: the present second.
        results: design -> result, in the order of their making.
        psnr: design -> quality in dB, NaN where it failed.
    """

    base: Base
    budget: float
    psnr_of: Callable[[Result], float]
    clock: Callable[[], float] = time.monotonic
    results: dict[Design, Result] = dataclasses.field(default_factory=dict)
    psnr: dict[Design, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self._start = self.clock()

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return self.clock() - self._start

    def make(self, design: Design) -> Result:
        """Makes one design up to its trained avatar and measures it."""
        variant = Variant(label_of(design), overrides_of(design))
        self.results[design], self.psnr[design] = self.run(self.base, variant)
        return self.results[design]

    def make_affordable(self, designs: Iterable[Design]) -> None:
        """Makes the designs that the store holds or that what is left of the budget is expected to reach."""
        for design in designs:
            seconds = self.expected_seconds(design)
            if not seconds or seconds <= self.budget - self.spent:
                self.make(design)

    def run(self, base: Base, variant: Variant) -> tuple[Result, float]:
        """Makes a variant up to its trained avatar, prints a line on it, and returns its PSNR, too."""
        result = base.run(variant, [TRAIN])
        psnr = math.nan if result.failure else self.psnr_of(result)
        done = f"{psnr:.2f} dB, trained in {training_cost(result):.0f} processor seconds"
        line = f"failed: {result.failure}" if result.failure else done
        spent = f"[{spoken(self.spent)} of {spoken(self.budget)}]"
        print(f"{spent} {result.subject}, {result.variant}: {line}", flush=True)
        return result, psnr

    def expected_seconds(self, design: Design) -> float:
        """Wall-clock seconds that the stages of a design that the store lacks are expected to take."""
        seconds = {stage: self.results[()].seconds.get(stage, 0.0) for stage in self.missing(design)}
        if TRAIN in seconds:
            seconds[TRAIN] *= math.prod(map(self.cost_ratio, design))
        return sum(seconds.values())

    def missing(self, design: Design) -> list[str]:
        """The stages of a design that the store lacks; none where a setting is wrong, which running tells."""
        try:
            return self.base.missing(TRAIN, overrides_of(design))
        except UserError:
            return []

    def cost_ratio(self, level: Level) -> float:
        """Training cost of a level alone over the base's; the guess of it where it has not been made."""
        cost = training_cost(self.results[(level,)]) if (level,) in self.results else math.nan
        ratio = cost / max(training_cost(self.results[()]), 1e-9)
        return ratio if 0 < ratio < math.inf else level.factor

    @property
    def noise(self) -> float:
        """How far another seed's quality is off, dB; NaN where it was not made."""
        seeds = [psnr for design, psnr in self.psnr.items() if design and design[0].parameter == CHANCE]
        return abs(seeds[0] - self.psnr[()]) if seeds else math.nan

    def alone(self) -> pd.DataFrame:
        """The base and the levels that were tried alone, but for another seed; see ``combinations``."""
        rows: list[tuple[Level | None, float, float]] = [(None, 0.0, 1.0)]
        for level in (design[0] for design in self.results if len(design) == 1):
            if level.parameter != CHANCE:
                rows.append((level, self.psnr[(level,)] - self.psnr[()], self.cost_ratio(level)))
        return pd.DataFrame(rows, columns=["level", "gain", "ratio"])
