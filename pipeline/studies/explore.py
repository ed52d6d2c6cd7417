"""Making the points of a study of what accuracy costs, one after the other, within a budget."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pipeline.artifact import RUN
from pipeline.config.request import parse_request
from pipeline.errors import UserError
from pipeline.job import Found, Job, open_job
from pipeline.studies.design import (
    TRAIN,
    Design,
    Made,
    Point,
    base_of,
    label_of,
    next_combination,
    next_single,
    singles,
    words_of,
)
from pipeline.studies.fits import FitPoint, fit_point, fit_steps
from pipeline.studies.knobs import Knob
from pipeline.studies.run import Ending, Failure, attempt
from pipeline.study import Outcome, Variant, with_needed
from pipeline.workspace import Workspace

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
DEFAULT_BUDGET = "20m"
VIEWS = "auxiliary"
SLOWEST, FASTEST = 8.0, 0.5  # how far expectations are corrected by what things took


def seconds_of(text: str) -> float:
    """``20m``, ``90s``, ``1.5h`` or a number of seconds.

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


def cost_of(outcome: Outcome) -> float:
    """Processor seconds of training and of the views made for it, their processes' starts included."""
    return sum(outcome.cpu_seconds.get(stage, 0.0) for stage in (TRAIN, VIEWS))


Judge = Callable[[Outcome], float]
"""What an outcome is plotted by: quality, more is better."""


@dataclasses.dataclass
class Explorer:
    """One subject's study in the making.

    Attributes:
        subject: whose avatar.
        own: the study's own words.
        knobs: what can be turned.
        budget: seconds of this call.
        log: where the stages' lines go.
        judge: of an outcome's quality; the base's comes first.
        say: gets a line a point.
        endings: what has been made, in that order.
        fits: registrations that have been made.
    """

    subject: str
    own: Mapping[str, str]
    knobs: Sequence[Knob]
    budget: float
    log: Path
    judge: Judge
    say: Callable[[str], None] = print
    endings: dict[Point, Ending] = dataclasses.field(default_factory=dict)
    fits: list[FitPoint] = dataclasses.field(default_factory=list)
    _start: float = dataclasses.field(default_factory=time.monotonic)
    _took: float = 0.0
    _expected: float = 0.0
    _qualities: dict[Point, float] = dataclasses.field(default_factory=dict)

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start

    @property
    def slowness(self) -> float:
        """How many times longer than expected things have been taking."""
        ratio = self._took / self._expected if self._expected else 1.0
        return min(max(ratio, FASTEST), SLOWEST)

    def variant(self, point: Point) -> Variant:
        """A point as a variant."""
        return Variant(label_of(self.knobs, point), words_of(self.knobs, point))

    def job(self, point: Point) -> Job:
        """A point's job."""
        return open_job(
            self.subject, parse_request({**self.own, **words_of(self.knobs, point)}, self.subject)
        )

    def needed(self, point: Point) -> list[str]:
        """The stages of a point that the store does not hold."""
        job = self.job(point)
        found: Found = {}
        return [stage for stage in with_needed(job.stages, (TRAIN,)) if job.find(stage, found) is None]

    def made(self) -> list[Made]:
        """The points so far, as the design sees them."""
        known = []
        for point, ending in self.endings.items():
            if isinstance(ending, Outcome):
                quality = self._qualities[point]
                known.append(Made(point, ending.seconds, cost_of(ending), quality))
            else:
                known.append(Made(point, {}, math.nan, math.nan))
        return known

    def make(self, point: Point) -> Ending:
        """Makes one point, and notes how long it took against what was expected."""
        needed = self.needed(point)
        expected = Design(self.knobs, self.made()).seconds(point, needed)
        start = time.monotonic()
        ending = attempt(self.subject, self.variant(point), self.own, self.log, (TRAIN,))
        if isinstance(ending, Outcome):
            self._qualities[point] = self.judge(ending)
            if expected:
                self._took += time.monotonic() - start
                self._expected += expected
        self.endings[point] = ending
        self.tell(ending, self._qualities.get(point, math.nan), f", {self.left_text()}")
        return ending

    def tell(self, ending: Ending, quality: float, left: str = "") -> None:
        """A line on what was made."""
        text = f"[{spoken(self.spent)} of {spoken(self.budget)}{left}] {self.subject}, {ending.variant}: "
        if isinstance(ending, Failure):
            self.say(f"{text}failed: {ending.reason}")
        else:
            self.say(f"{text}{quality:.2f} dB, trained in {cost_of(ending):.0f} processor seconds")

    def left_text(self) -> str:
        """What is still to come of the levels tried alone, at most what is left of the budget."""
        design = Design(self.knobs, self.made())
        missing = [point for point in singles(self.knobs) if point not in self.endings]
        seconds = self.slowness * sum(design.seconds(point, self.needed(point)) for point in missing)
        least = min(seconds, max(0.0, self.budget - self.spent))
        return f"{len(missing)} levels to try, about {spoken(least)}"

    def run(self, choose: Callable[..., Point | None]) -> None:
        """Makes what ``choose`` names until it names nothing more.

        Args:
            choose: ``next_single`` or ``next_combination``.
        """
        while True:
            left = self.budget - self.spent
            point = choose(self.knobs, self.made(), self.needed, left, self.slowness)
            if point is None:
                return
            self.make(point)

    def make_fits(self, own_steps: int) -> None:
        """Registrations of several efforts, as far as a quarter of the budget reaches."""
        base = self.endings.get(base_of(self.knobs))
        each = base.seconds.get("fit", 0.0) if isinstance(base, Outcome) else 0.0
        for steps in fit_steps(own_steps):
            stored = open_job(
                self.subject, parse_request({**self.own, "fit.iterations": str(steps)}, self.subject)
            ).find("fit")
            expected = self.slowness * each * steps / own_steps
            if not stored and self.fits and self.spent + expected > self.budget / 4:
                self.say(f"fit of {steps} steps is left out: the budget")
                continue
            try:
                self.fits.append(fit_point(self.subject, self.own, steps, self.log))
            except (UserError, OSError) as error:
                self.say(f"fit of {steps} steps failed: {error}")


@dataclasses.dataclass(frozen=True)
class Preset:
    """A preset beside the points.

    Attributes:
        name: of it.
        cost: what it costs, or is expected to.
        outcome: what it came to; None where the store does not hold it and the budget did not reach.
    """

    name: str
    cost: float
    outcome: Outcome | None = None


def presets_of(explorer: Explorer, words: Mapping[str, str], workspace: Workspace) -> list[Preset]:
    """The presets: read from the store, else made where the budget allows, else only their expected cost.

    Args:
        explorer: with every level tried alone.
        words: of the command line that are no settings: a preset is what it is.
        workspace: where presets lie.
    """
    found = []
    base = explorer.endings.get(base_of(explorer.knobs))
    for path in sorted((workspace.data / "presets").glob("*.toml")):
        if not isinstance(base, Outcome):
            continue
        own = {**{key: value for key, value in words.items() if "." not in key}, "preset": path.stem}
        job = open_job(explorer.subject, parse_request(own, explorer.subject))
        cost = expected_cost(explorer, job, base)
        left = (explorer.budget - explorer.spent) / 2
        share = sum(base.seconds.values()) / max(cost_of(base), 1e-9)
        if job.find(TRAIN) is None and explorer.slowness * cost * share > left:
            found.append(Preset(path.stem, cost))
            continue
        ending = attempt(explorer.subject, Variant(f"preset {path.stem}"), own, explorer.log, (TRAIN,))
        if isinstance(ending, Outcome):
            explorer.tell(ending, explorer.judge(ending))
            found.append(Preset(path.stem, cost_of(ending), ending))
        else:
            explorer.tell(ending, math.nan)
            found.append(Preset(path.stem, cost))
    return found


def expected_cost(explorer: Explorer, job: Job, base: Outcome) -> float:
    """What training under a job's settings would cost, from the levels that were tried alone.

    Iterations count in proportion, levels of subdivision and precision by what they were found to cost.
    """
    own = explorer.job(base_of(explorer.knobs)).settings["train"]
    wanted, design = job.settings["train"], Design(explorer.knobs, explorer.made())
    moving = iterating(base)
    cost = cost_of(base) - moving + moving * wanted.iterations / own.iterations
    for place, knob in enumerate(explorer.knobs):
        for level, one in enumerate(knob.levels):
            changed = explorer.job(_only(explorer.knobs, place, level)).settings["train"]
            name = {"number of Gaussians": "subdivisions", "precision": "half_precision"}.get(knob.name)
            if level and name and getattr(changed, name) == getattr(wanted, name):
                cost *= design.ratio(place, level, lambda made: made.cost, one.factor)
    return cost


def iterating(outcome: Outcome) -> float:
    """Processor seconds of the iterations alone; all of training's where they were not noted."""
    record = json.loads((outcome.folders[TRAIN] / RUN).read_text(encoding="utf-8"))
    marks = record["timings"].get("curve_seconds") or [(0, 0.0, cost_of(outcome))]
    return float(marks[-1][2])


def _only(knobs: Sequence[Knob], place: int, level: int) -> Point:
    return tuple(level if other == place else 0 for other in range(len(knobs)))


def explore(explorer: Explorer, words: Mapping[str, str], workspace: Workspace) -> list[Preset]:
    """Makes the base, registrations, levels alone, presets and combinations, as far as the budget reaches.

    Raises:
        UserError: the base itself failed.
    """
    base = explorer.make(base_of(explorer.knobs))
    if isinstance(base, Failure):
        raise UserError(base.reason)
    explorer.make_fits(explorer.job(base_of(explorer.knobs)).settings["fit"].iterations)
    explorer.run(next_single)
    presets = presets_of(explorer, words, workspace)
    explorer.run(next_combination)
    return presets
