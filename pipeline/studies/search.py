"""The designs of a tradeoff, registrations and presets, made one after the other within a budget of seconds.

Not a full grid: the base, then every level of every sweep parameter alone, then combinations of the levels
that gained most for their time.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable

import pandas as pd

from pipeline.errors import UserError
from pipeline.run.job import Job
from pipeline.studies.fit_error import FACTORS, fit_numbers
from pipeline.studies.sweep import (
    GAUSSIANS,
    PRECISION,
    REPRESENTATION,
    Design,
    Level,
    label_of,
    overrides_of,
    setting_of,
)
from pipeline.studies.variants import Base, Result, Variant, run_record


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

    def expected_cost(self, job: Job, levels: Iterable[Level]) -> float:
        """Processor seconds that training under a job's settings would cost, from the levels tried alone.

        Steps count in proportion, Gaussians, precision and representation by what they were found to cost.
        """
        own, wanted, result = self.base.settings["train"], job.settings["train"], self.results[()]
        cost = result.training_cost
        marks = run_record(result.folders["train"])["timings"]["curve_seconds"] or [(1, 0.0, cost)]
        done, _, iterating = marks[-1]  # the rest is spent before and after the steps
        planned = done / own.effort if not own.iterations else done
        cost += iterating * ((wanted.iterations or planned * wanted.effort) / done - 1)
        for level in levels:
            if level.parameter in (GAUSSIANS, PRECISION, REPRESENTATION) and all(
                str(setting_of(job.settings, name)).lower() == text for name, text in level.overrides.items()
            ):
                cost *= self.cost_ratio(level)
        return cost

    def run_fits(self) -> pd.DataFrame:
        """Steps -> ``fit_numbers`` of registrations, as far as a quarter of the budget reaches."""
        own = max(1, self.base.settings["fit"].iterations)
        rows: dict[int, dict[str, float]] = {}
        for steps in sorted({max(1, round(own * factor)) for factor in FACTORS}):
            variant = Variant(f"fit of {steps} steps", {"fit.iterations": str(steps)})
            seconds = self.results[()].seconds["fit"] * steps / own
            late = self.spent + seconds > self.budget / 4
            if rows and late and self.base.missing("fit", variant.overrides):
                print(f"{variant.name} is left out: the budget")
                continue
            result = self.base.run(variant, ["fit"])
            if result.failure:
                print(f"{variant.name} failed: {result.failure}")
            else:
                rows[steps] = fit_numbers(result, self.base.request.workspace.body_file)
        return pd.DataFrame.from_dict(rows, orient="index")

    def run_presets(self, levels: Iterable[Level]) -> tuple[dict[str, Result], dict[str, float]]:
        """The presets that the store holds or half of what is left reaches; the others' expected cost."""
        own = self.results[()]
        results, expected = {}, {}
        for path in sorted((self.base.request.workspace.definitions("presets")).glob("*.toml")):
            base = self.base.under_preset(path.stem)
            cost = self.expected_cost(base.job(), levels)
            seconds = cost * sum(own.seconds.values()) / max(own.training_cost, 1e-9)
            if seconds <= (self.budget - self.spent) / 2 or not base.missing("train", {}):
                result = self.run(base, Variant(f"preset {path.stem}"))
                if not result.failure:
                    results[path.stem] = result
                    continue
            expected[path.stem] = cost
        return results, expected
