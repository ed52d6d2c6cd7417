"""Studies: one subject under several settings, each a version in the store, compared in one table.

A variant is a set of ``NAME=VALUE`` words on top of the study's own. What two variants share (footage,
fit, a whole avatar that is only evaluated differently) is made once, because the store finds it by its
key; a study that was interrupted goes on where it was.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.artifact import RUN, Artifact
from pipeline.config.request import parse_request
from pipeline.errors import UserError
from pipeline.job import Job, open_job
from pipeline.process import run_stage_process
from pipeline.stage import Stage, usual

SUMMARY = "summary.json"  # what the evaluate stage publishes its means in


@dataclasses.dataclass(frozen=True)
class Variant:
    """One row of a study.

    Attributes:
        name: for the table.
        words: settings that differ from the study's own, as on the command line.
    """

    name: str
    words: Mapping[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one variant came to.

    Attributes:
        subject: whose avatar.
        variant: its name.
        means: split -> method -> metric -> mean over frames, as in summary.json.
        gaussians: of the avatar.
        seconds: stage -> wall-clock seconds of the run that made its result.
        cpu_seconds: stage -> processor seconds of it, of all threads: less disturbed by other jobs. Less
            what compiled kernels, for the first run of a study pays that for all.
        folders: stage -> where its result lies.
    """

    subject: str
    variant: str
    means: Mapping[str, Any]
    gaussians: int
    seconds: Mapping[str, float]
    cpu_seconds: Mapping[str, float]
    folders: Mapping[str, Path]

    def held_out(self, metric: str, method: str = "avatar") -> float:
        """A metric's mean over the held-out frames."""
        value = self.means.get("test", {}).get(method, {}).get(metric)
        return float("nan") if value is None else float(value)


def outcome_of(
    subject: str,
    variant: Variant,
    words: Mapping[str, str],
    log: Path | None = None,
    stages: Iterable[str] | None = None,
) -> Outcome:
    """Runs what is not in the store yet, and reads what the variant came to.

    ``latest`` is left pointing where it pointed before.

    Args:
        subject: whose avatar.
        variant: the settings that differ.
        words: the study's own words, which the variant's replace.
        log: where the stages' own lines go; this terminal if None.
        stages: how far to go, as for ``made``; without evaluate there are no means.

    Raises:
        UserError: a setting is wrong, or a stage stopped.
    """
    job = open_job(subject, parse_request({**words, **variant.words}, subject))
    return _read(subject, variant, made(job, stages, log))


def with_needed(stages: Mapping[str, Stage], wanted: Iterable[str]) -> list[str]:
    """Some stages and all that they need, upstream first."""
    found = set(wanted)
    for name in reversed(list(stages)):
        found |= set(stages[name].needs) if name in found else set()
    return [name for name in stages if name in found]


def made(job: Job, stages: Iterable[str] | None = None, log: Path | None = None) -> dict[str, Artifact]:
    """The results of some stages and of all that they need; what is not in the store is run first.

    ``latest`` is left pointing where it pointed before.

    Args:
        job: whose, and under which settings.
        stages: names; all that run without being asked for if None.
        log: where the stages' own lines go; this terminal if None.

    Raises:
        UserError: a stage stopped.
    """
    found = {}
    with _latest_kept(job):
        for stage in with_needed(job.stages, usual(job.stages) if stages is None else stages):
            if job.find(stage) is None:
                _run(job, stage, log)
            artifact = job.find(stage)
            if artifact is None:
                raise UserError(f"{stage}:{job.subject.name} ran, and its result is not in the store")
            found[stage] = artifact
    return found


def _read(subject: str, variant: Variant, artifacts: Mapping[str, Artifact]) -> Outcome:
    folders = {stage: artifact.folder for stage, artifact in artifacts.items()}
    records = {stage: json.loads((folder / RUN).read_text()) for stage, folder in folders.items()}
    summary = _summary(folders.get("evaluate"))
    return Outcome(
        subject=subject,
        variant=variant.name,
        means=summary["means"],
        gaussians=summary["gaussians"],
        seconds={stage: record["seconds"] for stage, record in records.items()},
        cpu_seconds={stage: _cpu_seconds(record) for stage, record in records.items()},
        folders=folders,
    )


def _summary(folder: Path | None) -> dict[str, Any]:
    """What evaluate published; nothing where there is no such stage."""
    if folder is None:
        return {"means": {}, "gaussians": 0}
    return json.loads((folder / SUMMARY).read_text(encoding="utf-8"))


def _cpu_seconds(record: Mapping[str, Any]) -> float:
    """Of a run and of those that were killed before it, up to the checkpoint that it went on from."""
    timings = record.get("timings", {})
    more = timings.get("earlier_cpu_seconds", 0.0) - timings.get("compile_cpu_seconds", 0.0)
    return record.get("cpu_seconds", float("nan")) + more


def _run(job: Job, stage: str, log: Path | None) -> None:
    """Runs one stage in a process of its own."""
    reason = run_stage_process(stage, job.subject.name, job.request, log)
    if reason:
        raise UserError(f"{stage}:{job.subject.name} {reason}")


@contextlib.contextmanager
def _latest_kept(job: Job) -> Iterator[None]:
    """Puts every stage's ``latest`` back to what it was."""
    before = {stage: job.store.latest(job.subject.name, stage) for stage in job.stages}
    try:
        yield
    finally:
        for artifact in before.values():
            if artifact is not None and os.path.isdir(artifact.folder):
                job.store.select(artifact)
