"""Variants of one subject's settings: each is made as versions in the store, and its scores are read back.

A variant is a set of overrides, setting's name -> text, on top of the study's base. What two variants share
(footage, fit, a whole avatar that is only evaluated differently) is made once, because the store finds it by
its key; for the same reason an interrupted study goes on where it was.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.config.request import Request
from pipeline.errors import UserError
from pipeline.run.job import Found, Job, open_job
from pipeline.run.process import make_results
from pipeline.store.artifact import RUN

Overrides = Mapping[str, str]
"""Setting's name -> text, as on the command line."""

Settings = Mapping[str, Any]
"""Stage -> its settings."""

SCALES: Mapping[str, Overrides] = {
    "preset": {},
    "small": {"train.iterations": "200", "train.subdivisions": "0", "plan.edge_pixels": "5"},
}
"""``scale=`` -> its overrides; those of the command line win over them."""

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
"""Settings of evaluate that leave out what no study shows, where there is such a setting."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """One row of a study: its name in tables, and the settings that differ from the study's base."""

    name: str
    overrides: Overrides = dataclasses.field(default_factory=dict)


def another_seed(settings: Settings) -> Variant:
    """The variant that shows what chance is worth: the base, trained with the next seed."""
    return Variant("another seed", {"train.seed": str(settings["train"].seed + 1)})


@dataclasses.dataclass(frozen=True)
class Result:
    """One variant's scores and times, or why it failed.

    Attributes:
        subject: whose avatar.
        variant: its name.
        failure: the reason in a line; empty where it did not fail. Then all below is empty.
        means: method -> metric -> mean over the held-out frames, of the metrics that have one.
        seconds: stage -> wall-clock seconds of the run that made its version.
        cpu_seconds: stage -> processor seconds of all threads of it, less what compiling took.
        folders: stage -> where its version lies.
    """

    subject: str
    variant: str
    failure: str = ""
    means: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)
    seconds: Mapping[str, float] = dataclasses.field(default_factory=dict)
    cpu_seconds: Mapping[str, float] = dataclasses.field(default_factory=dict)
    folders: Mapping[str, Path] = dataclasses.field(default_factory=dict)

    @property
    def training_cost(self) -> float:
        """Processor seconds of training and of the views made for it; NaN of a failure."""
        stages = ("train", "auxiliary")
        return math.nan if self.failure else sum(self.cpu_seconds.get(stage, 0.0) for stage in stages)

    @property
    def line(self) -> str:
        """One line for the terminal."""
        psnr = self.means.get("avatar", {}).get("psnr", math.nan)
        done = f"{psnr:.2f} dB, trained in {self.training_cost:.0f} processor seconds"
        return f"{self.subject}, {self.variant}: {f'failed: {self.failure}' if self.failure else done}"


@dataclasses.dataclass(frozen=True)
class Base:
    """One subject's request that a study's variants override, and where its stages write their lines.

    Attributes:
        subject: whose avatar.
        request: the study's own settings and places.
        log: a file for the stages' lines.
        preset: the preset that the base is, unchanged; empty where settings differ from one.
    """

    subject: str
    request: Request
    log: Path
    preset: str = ""

    def job(self, overrides: Overrides | None = None) -> Job:
        """The job of a variant; UserError where a setting is wrong."""
        return open_job(self.subject, self.request.override(overrides or {}))

    @functools.cached_property
    def settings(self) -> Settings:
        """The base's own."""
        return self.job().settings

    def missing(self, stage: str, overrides: Overrides) -> list[str]:
        """The stages up to one that the store does not hold."""
        job, found = self.job(overrides), Found()
        return [name for name in job.upstream_first([stage]) if job.find(name, found) is None]

    def run(self, variant: Variant, stages: Iterable[str] | None = None) -> Result:
        """Makes what the store lacks of a variant and reads its scores; a failure is returned, not raised.

        Args:
            variant: overrides on top of the base's.
            stages: how far to go, as for ``make_results``.
        """
        self.log.parent.mkdir(parents=True, exist_ok=True)
        try:
            versions = make_results(self.job(variant.overrides), stages, self.log)
            folders = {stage: version.folder for stage, version in versions.items()}
            means = read_summary(folders["evaluate"])["means"] if "evaluate" in folders else {}
            records = {stage: run_record(folder) for stage, folder in folders.items()}
            seconds = {stage: record["seconds"] for stage, record in records.items()}
            cpu = {stage: cpu_seconds(record) for stage, record in records.items()}
            return Result(self.subject, variant.name, "", means, seconds, cpu, folders)
        except (UserError, OSError) as error:
            return Result(self.subject, variant.name, str(error))

    def under_preset(self, preset: str) -> Base:
        """The same subject and places under a preset's own settings."""
        request = dataclasses.replace(self.request, preset=preset, overrides={})
        return dataclasses.replace(self, request=request, preset=preset)


def base_of(subject: str, request: Request, log: Path, views: bool = False) -> Base:
    """A study's base: the request, on top of its scale, a lean evaluate and a curve of ten points.

    Args:
        subject: whose avatar.
        request: the command line's.
        log: a file for the stages' lines.
        views: views are generated where the preset leaves them out.

    Raises:
        UserError: a setting or the scale is wrong.
    """
    if request.scale not in SCALES:
        raise UserError(f"scale={request.scale}: there is no such scale; there are {', '.join(SCALES)}")
    own = {**SCALES[request.scale], **request.overrides}
    settings = open_job(subject, dataclasses.replace(request, overrides=own)).settings
    lean = {f"evaluate.{n}": text for n, text in LEAN.items() if hasattr(settings.get("evaluate"), n)}
    train = settings.get("train")
    if train is not None:
        tenth = max(1, train.iterations // 10) if train.iterations else train.held_out_every
        lean["train.held_out_every"] = str(min(train.held_out_every, tenth))
    if views and settings["auxiliary"].generator == "off":
        lean["auxiliary.generator"] = "auto"
    changed = any(not name.startswith("evaluate.") for name in own)
    full = dataclasses.replace(request, overrides={**lean, **own})
    return Base(subject, full, log, "" if changed else request.preset)


def read_summary(folder: Path) -> dict[str, Any]:
    """``summary.json`` of a version of evaluate, with the choices that its means depend on.

    Returns:
        What it holds; its ``means`` are those of the held-out frames: method -> metric -> mean, of the
        metrics that have one.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        held_out = summary["means"].get("test", {})
        means = {
            method: {metric: value for metric, value in of.items() if value is not None}
            for method, of in held_out.items()
        }
        return {**summary, "means": means}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} cannot be read ({error}): run the evaluate stage again") from None


def run_record(folder: Path) -> dict[str, Any]:
    """Times and machine of the run that made a version."""
    return json.loads((folder / RUN).read_text(encoding="utf-8"))


def cpu_seconds(record: Mapping[str, Any]) -> float:
    """Processor seconds of a run, less those of compiling, for the first run of a study pays that for all.

    Those of runs that were killed before it are counted up to the checkpoint that it went on from.
    """
    timings = record.get("timings", {})
    more = timings.get("earlier_cpu_seconds", 0.0) - timings.get("compile_cpu_seconds", 0.0)
    return record.get("cpu_seconds", math.nan) + more
