"""Running a study's variants one after the other; one that fails is named and does not stop the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.config.request import parse_request
from pipeline.errors import UserError
from pipeline.job import open_job
from pipeline.stage import Progress
from pipeline.study import Outcome, Variant, outcome_of
from pipeline.workspace import Workspace

OWN_WORDS = ("subject", "dataset", "budget", "scale")
"""Words of the command line that are a study's and no stage's."""

SCALES: Mapping[str, Mapping[str, str]] = {
    "preset": {},
    "small": {"train.iterations": "200", "train.subdivisions": "0"},
}
"""What ``scale=`` stands for; any other word of the command line wins over it."""

LEAN = {
    "turntable_frames": "2",
    "training_frames": "1",
    "comparison_frames": "1",
    "baseline_frames": "20",
    "mesh_frames": "0",
    "second_mask": "off",
    "slider_frames": "0",
    "motion_frames": "0",
}
"""What evaluate can leave out because a study does not show it, of the settings that it has."""


@dataclasses.dataclass(frozen=True)
class Failure:
    """A variant that stopped.

    Attributes:
        subject: whose avatar.
        variant: its name.
        reason: why, in a line.
    """

    subject: str
    variant: str
    reason: str


Ending = Outcome | Failure


def base_words(subject: str, words: Mapping[str, str]) -> dict[str, str]:
    """The words of a study's own settings.

    The command line's, on top of what ``scale=`` stands for, evaluate's lean settings, and a curve of at
    least five points.

    Raises:
        UserError: a word is wrong.
    """
    scaled = scale_words(words)
    own = stage_words(words)
    settings = open_job(subject, parse_request({**scaled, **own}, subject)).settings
    return {
        **lean_words(settings.get("evaluate")),
        **curve_words(settings.get("train")),
        **scaled,
        **own,
    }


def stage_words(words: Mapping[str, str]) -> dict[str, str]:
    """The command line's words that concern the stages; a dataset's, where it is said whose avatar."""
    own = {name: value for name, value in words.items() if name not in OWN_WORDS}
    return {**own, "dataset": words["dataset"]} if {"subject", "dataset"} <= set(words) else own


def scale_words(words: Mapping[str, str]) -> Mapping[str, str]:
    """What ``scale=`` stands for; UserError where there is no such scale."""
    scale = words.get("scale", "preset")
    if scale not in SCALES:
        raise UserError(f"scale={scale}: there is no such scale; there are {', '.join(SCALES)}")
    return SCALES[scale]


def lean_words(evaluate: Any) -> dict[str, str]:
    """The settings of evaluate that a study turns down, of those that there are."""
    return {f"evaluate.{name}": value for name, value in LEAN.items() if hasattr(evaluate, name)}


def curve_words(train: Any) -> dict[str, str]:
    """The settings that give training a curve of at least five points."""
    if not hasattr(train, "held_out_every"):
        return {}
    return {"train.held_out_every": str(min(train.held_out_every, max(1, train.iterations // 5)))}


def attempt(
    subject: str,
    variant: Variant,
    words: Mapping[str, str],
    log: Path,
    stages: Iterable[str] | None = None,
) -> Ending:
    """What one variant came to, or why it came to nothing; ``stages`` as for ``pipeline.study.made``."""
    try:
        return outcome_of(subject, variant, words, log, stages)
    except (UserError, OSError) as error:
        return Failure(subject, variant.name, str(error))


def run_variants(
    subject: str,
    variants: Iterable[Variant],
    words: Mapping[str, str],
    log: Path,
    progress: Progress | None = None,
    say: Callable[[str], None] = print,
) -> list[Ending]:
    """Runs variants of one subject; what the store holds is not made again.

    Args:
        subject: whose avatar.
        variants: in the order of the table.
        words: the study's own.
        log: where the stages' lines go.
        progress: of the whole study; advanced by one a variant.
        say: gets a line a variant.
    """
    endings = []
    for variant in variants:
        ending = attempt(subject, variant, words, log)
        endings.append(ending)
        say(line(ending))
        if progress is not None:
            progress.advance(1, variant.name)
    return endings


def line(ending: Ending) -> str:
    """One line on a variant, for the terminal."""
    if isinstance(ending, Failure):
        return f"{ending.subject}, {ending.variant}: failed: {ending.reason}"
    psnr, seconds = ending.held_out("psnr"), ending.cpu_seconds.get("train", float("nan"))
    numbers = f"{psnr:.2f} dB, {ending.gaussians:,} Gaussians, trained in {seconds:.0f} processor seconds"
    return f"{ending.subject}, {ending.variant}: {numbers}"


def study_folder(workspace: Workspace, kind: str, name: str) -> Path:
    """Where a study leaves what it found; made."""
    folder = workspace.data / "studies" / kind / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder
