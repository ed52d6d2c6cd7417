"""What accuracy costs in time: which settings buy what, found within a budget, and their frontier."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.config.request import DEFAULT_PRESET, parse_request
from pipeline.job import open_job
from pipeline.studies.design import Point, label_of, singles, words_of
from pipeline.studies.explore import (
    DEFAULT_BUDGET,
    Explorer,
    Preset,
    cost_of,
    explore,
    seconds_of,
)
from pipeline.studies.fits import FitPoint
from pipeline.studies.frontier import frontier, short_of
from pipeline.studies.knobs import CHANCE, Knob, knobs_of
from pipeline.studies.run import Failure, base_words, stage_words, study_folder
from pipeline.study import Outcome

if TYPE_CHECKING:
    from pipeline.studies.clip import Clip


@dataclasses.dataclass(frozen=True)
class Entry:
    """A row of the study: a point, or a preset.

    Attributes:
        number: of its row.
        label: what it differs in from the base.
        words: those that it adds.
        outcome: what it came to; None where it failed.
        reason: why it failed.
        quality: metric -> mean over the base's held-out frames, at the base's picture size.
        speed: numbers of ``pipeline.studies.clip.speeds``.
        cost: processor seconds of training.
        point: of the design; None for a preset.
        preset: which it is; empty if none.
    """

    number: int
    label: str
    words: Mapping[str, str]
    outcome: Outcome | None
    reason: str
    quality: Mapping[str, float]
    speed: Mapping[str, float]
    cost: float
    point: Point | None = None
    preset: str = ""

    def get(self, metric: str) -> float:
        """A metric; NaN where there is none."""
        return self.quality.get(metric, math.nan)

    @property
    def gaussians(self) -> float:
        """Of the avatar; NaN where there is none."""
        return self.speed.get("gaussians", math.nan)

    @property
    def whole(self) -> float:
        """Processor seconds of every stage up to training, of those that noted them."""
        seconds = self.outcome.cpu_seconds.values() if self.outcome else ()
        known = [value for value in seconds if math.isfinite(value)]
        return sum(known) if known else math.nan


@dataclasses.dataclass(frozen=True)
class Study:
    """Everything that a study of what accuracy costs came to.

    Attributes:
        subject: whose avatar.
        own: the study's own words.
        knobs: what was turned.
        entries: in the order of their making; the first is the base.
        expected: preset -> expected cost, of those that were not made.
        fits: registrations.
        budget: seconds.
        seconds: of this call.
    """

    subject: str
    own: Mapping[str, str]
    knobs: Sequence[Knob]
    entries: Sequence[Entry]
    expected: Mapping[str, float]
    fits: Sequence[FitPoint]
    budget: float
    seconds: float

    @property
    def base(self) -> Entry:
        """The study's own settings."""
        return self.entries[0]

    @property
    def noise(self) -> float:
        """How far another seed's PSNR is off; NaN where it was not reached."""
        apart = [
            abs(entry.get("psnr") - self.base.get("psnr")) for entry in self.entries if self.by_chance(entry)
        ]
        return apart[0] if apart else math.nan

    def by_chance(self, entry: Entry) -> bool:
        """Whether an entry is the base with another seed: it shows what chance is worth, and is no choice."""
        place = [knob.name for knob in self.knobs].index(CHANCE)
        return bool(entry.point and entry.point[place])

    @property
    def choices(self) -> list[Entry]:
        """The entries that a user can choose from."""
        return [entry for entry in self.entries if not self.by_chance(entry)]

    def edge(self, cost: str = "train", metric: str = "psnr") -> set[int]:
        """The numbers of the entries on the frontier.

        Args:
            cost: ``train`` or ``animation_ms``.
            metric: of the quality; LPIPS's sign is turned.
        """
        choices, sign = self.choices, -1 if metric.startswith("lpips") else 1
        costs = [self.costs(entry, cost) for entry in choices]
        qualities = [sign * entry.get(metric) for entry in choices]
        return {choices[place].number for place in frontier(costs, qualities)}

    @staticmethod
    def costs(entry: Entry, cost: str) -> float:
        """What an entry is plotted over."""
        return entry.cost if cost == "train" else entry.speed.get(cost, math.nan)

    def short(self, entry: Entry) -> float:
        """How much PSNR an entry lacks against what costs no more."""
        costs, qualities = ([one.cost for one in self.choices], [one.get("psnr") for one in self.choices])
        return short_of(entry.cost, entry.get("psnr"), costs, qualities)


def tradeoff(subject: str, words: Mapping[str, str]) -> Path:
    """Explores one subject's settings and writes table, plots and page.

    Returns:
        The study's folder.

    Raises:
        UserError: a word is wrong, or the base itself failed.
    """
    workspace, start = parse_request(words).workspace, time.monotonic()
    budget, own = seconds_of(words.get("budget", DEFAULT_BUDGET)), base_words(subject, words)
    knobs, folder = (
        knobs_of(open_job(subject, parse_request(own, subject)).settings),
        study_folder(workspace, "tradeoff", subject),
    )
    judge = Judging(words)
    explorer = Explorer(subject, own, knobs, budget, folder / "log.txt", judge)
    told = f"{len(singles(knobs))} levels of {len(knobs)} knobs, then what combines"
    print(f"tradeoff of {subject}: {told}, within {words.get('budget', DEFAULT_BUDGET)}", flush=True)
    presets = explore(explorer, stage_words(words), workspace)
    study = gathered(explorer, presets, judge, words, time.monotonic() - start)

    from pipeline.studies.tradeoff_report import publish

    publish(folder, study)
    return folder


class Judging:
    """Held-out quality at the base's picture size, by evaluate's metrics but without that stage's pictures.

    Evaluate would cost as much as a short training; and it measures at the size that was learnt from.
    """

    def __init__(self, words: Mapping[str, str]) -> None:
        self.words = words
        self.base: Outcome | None = None
        self._clip: Clip | None = None

    def clip(self, base: Outcome) -> Clip:
        """What avatars are measured on."""
        from pipeline.studies.measured import clip_of  # torch, which the DAG does without

        if self._clip is None:
            self._clip = clip_of(base, self.words, parse_request(self.words).workspace)
        return self._clip

    def qualities(self, outcome: Outcome) -> dict[str, float]:
        """Metric -> mean over the base's held-out frames."""
        base = self.base = self.base or outcome
        from pipeline.studies.clip import quality, quality_name
        from pipeline.studies.measured import notes_of

        clip = self.clip(base)
        notes = notes_of(parse_request(self.words).workspace, outcome.subject)
        return notes.once(quality_name(outcome, clip), lambda: quality(outcome, clip))

    def __call__(self, outcome: Outcome) -> float:
        """PSNR."""
        return self.qualities(outcome).get("psnr", math.nan)


def gathered(
    explorer: Explorer, presets: Sequence[Preset], judge: Judging, words: Mapping[str, str], seconds: float
) -> Study:
    """The study, with what a frame of each avatar costs."""
    from pipeline.studies.clip import speeds
    from pipeline.studies.measured import notes_of

    outcomes = [one for one in explorer.endings.values() if isinstance(one, Outcome)]
    outcomes += [preset.outcome for preset in presets if preset.outcome]
    explorer.say(f"timing {len(outcomes)} avatars in motion")
    notes = notes_of(parse_request(words).workspace, explorer.subject)
    fast = speeds(outcomes, judge.clip(outcomes[0]), notes)
    entries: list[Entry] = []
    for point, ending in explorer.endings.items():
        label = label_of(explorer.knobs, point)
        entries.append(
            _entry(len(entries) + 1, label, words_of(explorer.knobs, point), ending, judge, fast, point)
        )
    for preset in presets:
        if preset.outcome:
            words_in = {"preset": preset.name}
            entry = _entry(
                len(entries) + 1, f"preset {preset.name}", words_in, preset.outcome, judge, fast, None
            )
            entries.append(dataclasses.replace(entry, preset=preset.name))
    if is_preset(words):
        entries[0] = dataclasses.replace(entries[0], preset=words.get("preset", DEFAULT_PRESET))
    return Study(
        subject=explorer.subject,
        own=explorer.own,
        knobs=explorer.knobs,
        entries=entries,
        expected={preset.name: preset.cost for preset in presets if preset.outcome is None},
        fits=explorer.fits,
        budget=explorer.budget,
        seconds=seconds,
    )


def is_preset(words: Mapping[str, str]) -> bool:
    """Whether the base is a preset as it is."""
    settings = [name for name in words if "." in name and not name.startswith("evaluate.")]
    return not settings and words.get("scale", "preset") == "preset"


def _entry(
    number: int,
    label: str,
    words: Mapping[str, str],
    ending: Outcome | Failure,
    judge: Judging,
    fast: Mapping[str, Mapping[str, float]],
    point: Point | None,
) -> Entry:
    if isinstance(ending, Failure):
        return Entry(number, label, words, None, ending.reason, {}, {}, math.nan, point)
    speed = fast.get(ending.folders["train"].name, {})
    return Entry(number, label, words, ending, "", judge.qualities(ending), speed, cost_of(ending), point)


def sentence(study: Study) -> str:
    """What a user can act on: the knob that gives the most for its time, and the one that gives the most."""
    base, noise = study.base, study.noise
    least = noise if math.isfinite(noise) else 0.0
    alone = [entry for entry in study.entries if entry.point and sum(map(bool, entry.point)) == 1]
    known = [
        (entry, entry.get("psnr") - base.get("psnr"), entry.cost / base.cost)
        for entry in alone
        if math.isfinite(entry.get("psnr")) and not study.by_chance(entry)
    ]
    if not known:
        return "The budget reached no setting but the study's own: give it more time."
    gaining = [one for one in known if one[1] > least]
    if not gaining:
        chance = f"more than another seed does ({least:.1f} dB)" if math.isfinite(noise) else "anything"
        return f"No single change that was tried gains {chance}: {_told_cheapest(study, least)}."
    worth = max(gaining, key=lambda one: one[1] / max(math.log(max(one[2], 1.02)), 1e-3))
    most = max(gaining, key=lambda one: one[1])
    text = _told(study, *worth)
    if most[0] is not worth[0]:
        text += f"; the most is gained by {_told(study, *most, first=False)}"
    return f"{text}."


def _told(study: Study, entry: Entry, gain: float, ratio: float, first: bool = True) -> str:
    place = next(place for place, level in enumerate(entry.point or ()) if level)
    knob = study.knobs[place]
    before, after = knob.levels[0].label, knob.levels[(entry.point or ())[place]].label
    if knob.name == "number of Gaussians" and math.isfinite(entry.gaussians + study.base.gaussians):
        before, after = (f"{one.gaussians:,.0f} Gaussians" for one in (study.base, entry))
    time = f"{ratio:.1f} times the training time" if abs(ratio - 1) > 0.05 else "no more training time"
    change = after if after.startswith("with") else f"from {before} to {after}"
    return f"{'Going' if first else 'going'} {change}, at {time}: {gain:+.1f} dB"


def _told_cheapest(study: Study, least: float) -> str:
    """The cheapest entry that is no worse than the base by more than chance, at the price of what."""
    base = study.base
    as_good = [one for one in study.choices if one.get("psnr") >= base.get("psnr") - least]
    cheapest = min(as_good, key=lambda one: one.cost)
    if cheapest.cost > 0.95 * base.cost:
        return f"stay with {told_size(study, base)}"
    perceived = f"LPIPS×100 {100 * cheapest.get('lpips_alex'):.1f}, was {100 * base.get('lpips_alex'):.1f}"
    time = f"{cheapest.cost / base.cost:.1f} times the training time"
    return f"{cheapest.label}, at {time}, does as well in PSNR ({perceived})"


def told_size(study: Study, entry: Entry) -> str:
    """An entry's size in words."""
    return f"{entry.gaussians:,.0f} Gaussians and {study.knobs[0].levels[0].label}"
