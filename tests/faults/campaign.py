"""Kill after kill, each followed by the same command, until it is through; then all bytes are compared."""

from __future__ import annotations

import dataclasses
import random
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.run.progress import Progress
from tests.faults.flips import damage_every_stage, unnoticed
from tests.faults.observe import differences, litter, phase, published, wrongs
from tests.faults.project import Project
from tests.faults.runs import MOMENTS, TARGETS, Kill, Run

A_STAGE = 4  # kills of each stage, and of doit's start, before a run is let through
PATIENCE = 10.0  # seconds for a stage to end after doit was killed
SHARES = (0.8, 0.1, 0.1)  # of the targets
IN_PUBLISHING = 0.3  # of the kills that wait for a step of publishing


@dataclasses.dataclass
class Tally:
    """What came of all kills.

    Attributes:
        kills: (stage, phase) -> how many.
        targets: who was killed -> how many.
        resumed: runs that went on from a checkpoint.
        runs: that came through and were compared.
        missed: kills for which the run was over too soon.
        failures: what went wrong, in words; each begins with one of ``KINDS``.
        left: what finished runs left behind, hidden and harmless.
        flipped: bits that were flipped in finished results, a file of each kind.
        mended: whether one command was seen to make a damaged file of every stage again, with equal bytes.
        seconds: of all of it.
    """

    kills: Counter[tuple[str, str]] = dataclasses.field(default_factory=Counter)
    targets: Counter[str] = dataclasses.field(default_factory=Counter)
    resumed: int = 0
    runs: int = 0
    missed: int = 0
    failures: list[str] = dataclasses.field(default_factory=list)
    left: Counter[str] = dataclasses.field(default_factory=Counter)
    flipped: int = 0
    mended: bool = False
    seconds: float = 0.0

    def count(self, kind: str) -> int:
        """How many failures of a kind there were."""
        return sum(failure.startswith(kind) for failure in self.failures)

    def as_json(self) -> dict[str, Any]:
        plain = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        plain["kills"] = {f"{stage} {where}": count for (stage, where), count in self.kills.items()}
        return {**plain, **{kind: self.count(kind) for kind in KINDS}}


CORRUPT, MANUAL, DIFFERENT, ORPHAN = "corrupt", "manual step", "different bytes", "orphan"
UNNOTICED = "unnoticed"
KINDS = (CORRUPT, MANUAL, DIFFERENT, ORPHAN, UNNOTICED)


@dataclasses.dataclass(frozen=True)
class Reference:
    """A run that nothing disturbed.

    Attributes:
        files: digests of what it published.
        seconds: of each stage, and of doit's start under the empty name.
        folder: a copy of its store, to look at where bytes differ.
    """

    files: dict[str, str]
    seconds: dict[str, float]
    folder: Path

    def expected(self, kills: int) -> float:
        """Seconds that so many kills take, about: each costs half a stage, each whole run all of them."""
        stages = [seconds for name, seconds in self.seconds.items() if name]
        whole = sum(self.seconds.values())
        half = sum(stages) / len(stages) / 2 + self.seconds[""] + 0.3
        return kills * half + (kills / (A_STAGE * len(self.seconds)) + 1) * whole


def plan(stages: tuple[str, ...], seed: int, moments: tuple[str, ...] = MOMENTS) -> Iterator[Kill]:
    """Kills without end: some of each stage in turn, at random moments."""
    draw = random.Random(seed)
    while True:
        for stage in ("", *stages):
            for _ in range(A_STAGE):
                publishing = bool(stage) and draw.random() < IN_PUBLISHING
                target = draw.choices(TARGETS, SHARES)[0] if stage else "group"
                yield Kill(stage, draw.choice(moments) if publishing else "", draw.random(), target)


def undisturbed(project: Project, keep: Path) -> Reference:
    """Runs the subject twice, keeps a copy of the second store and clears it.

    Twice, for the first may compile kernels, and because equal runs must give equal bytes to begin with.

    Raises:
        RuntimeError: a run failed, or they differ; what follows would say nothing.
    """
    found = []
    for _ in range(2):
        shutil.rmtree(project.artifacts, ignore_errors=True)
        run = Run(project)
        if run.finish():
            raise RuntimeError(f"the undisturbed run failed:\n{run.text()}")
        found.append(published(project))
    shutil.copytree(project.artifacts, keep, symlinks=True)
    shutil.rmtree(project.artifacts)
    if names := differences(*found):
        raise RuntimeError(f"two undisturbed runs differ in {', '.join(names)}")
    return Reference(found[-1], run.durations(), keep)


class Campaign:
    """So many kills of one subject's runs."""

    def __init__(
        self, project: Project, reference: Reference, kills: int, seed: int, keep: Path, seconds: float = 1e9
    ):
        self.project, self.reference, self.kills, self.keep = project, reference, kills, keep
        self.limit, self.start = seconds, time.monotonic()
        self.plan, self.tally, self.draw = plan(project.stages, seed), Tally(), random.Random(seed)

    def run(self) -> Tally:
        """All kills and one run that is let through, then flipped bits."""
        self.start, before = time.monotonic(), ""
        progress = Progress(self.kills, "faults")
        while sum(self.tally.kills.values()) < self.kills and time.monotonic() - self.start < self.limit:
            kill = next(self.plan)
            if before and not kill.stage:  # all stages have had theirs: through with it
                self.through(Run(self.project))
            before = kill.stage
            if self.strike(kill):
                note = f"{self.tally.runs} whole runs compared, {len(self.tally.failures)} failures"
                progress.advance(1, note)
        self.through(Run(self.project))
        progress.close()
        self.flips()
        return self.stopped()

    def stopped(self) -> Tally:
        """What is known now."""
        self.tally.seconds = time.monotonic() - self.start
        return self.tally

    def strike(self, kill: Kill) -> bool:
        """Starts the command, kills it and looks at what is left; false where it was over too soon."""
        run = Run(self.project)
        if not run.wait_and_kill(kill, self.reference.seconds.get(kill.stage, 1.0)):
            self.tally.missed += 1
            self.through(run)
            return False
        if not run.gone(PATIENCE):
            self.fail(ORPHAN, f"a stage went on after {kill}", run)
        run.finish()
        self.note(run)
        where = phase(self.project, run.stage) if run.stage else "starting"
        self.tally.kills[run.stage or "doit", where] += 1
        self.tally.targets[run.killed] += 1
        if run.killed == "stage" and "killed by signal 9" not in run.text():
            self.fail(MANUAL, f"doit does not say who was killed by {kill}", run)
        for wrong in wrongs(self.project):
            self.fail(CORRUPT, f"{wrong}, after {kill} ({where})", run)
        return True

    def through(self, run: Run) -> None:
        """Lets a run come to its end, compares every byte and clears the store."""
        status = run.finish()
        self.note(run)
        if status:
            self.fail(MANUAL, f"the same command failed with status {status}", run)
        else:
            self.tally.runs += 1
            self.compare(run)
            self.tally.left.update(litter(self.project))
        self.clear()

    def compare(self, run: Run) -> None:
        """Notes every published file that is not as in the undisturbed run, and keeps a copy."""
        names = differences(self.reference.files, published(self.project))
        for wrong in wrongs(self.project):
            self.fail(CORRUPT, f"{wrong}, at the end of run {self.tally.runs}", run)
        for name in names:
            self.fail(DIFFERENT, f"{name} in run {self.tally.runs}", run)
            made = self.project.artifacts / self.project.subject / name
            if made.is_file():
                copy = self.keep / f"run{self.tally.runs}" / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(made, copy)

    def flips(self) -> None:
        """Flips bits in finished results: each is found, and one command makes all that is damaged again."""
        self.expect(Run(self.project), 0)
        self.expect(Run(self.project, f"verify:{self.project.subject}"), 0)
        self.tally.flipped, missed = unnoticed(self.project, self.draw)
        damage_every_stage(self.project, self.draw)
        run = Run(self.project, f"verify:{self.project.subject}")
        self.expect(run, 1)
        missed += [
            stage
            for stage in self.project.stages
            if f"rerun the stage: doit run {stage}:{self.project.subject}" not in run.text()
        ]
        for kind in missed:
            self.fail(UNNOTICED, f"a flipped bit in {kind}", run)
        before = len(self.tally.failures)
        self.through(Run(dataclasses.replace(self.project, words=(*self.project.words, "verify=true"))))
        self.tally.mended = len(self.tally.failures) == before

    def expect(self, run: Run, status: int) -> None:
        """Notes a run that does not end with this status."""
        if run.finish() != status:
            self.fail(MANUAL, f"{' '.join(run.project.words)} ended with {run.process.returncode}", run)

    def note(self, run: Run) -> None:
        """Counts what a run said of going on."""
        self.tally.resumed += "goes on from iteration" in run.text()

    def fail(self, kind: str, what: str, run: Run) -> None:
        """Notes a failure, and leaves the run's lines beside what is kept."""
        self.tally.failures.append(f"{kind}: {what}")
        self.keep.mkdir(parents=True, exist_ok=True)
        log = self.keep / f"failure{len(self.tally.failures)}.log"
        log.write_text(f"{kind}: {what}\n\n{run.text()}\n", encoding="utf-8")
        print(f"faults: {kind}: {what} ({log})", flush=True)

    def clear(self) -> None:
        """Deletes the subject's results, so that the next run begins anew."""
        shutil.rmtree(self.project.artifacts / self.project.subject, ignore_errors=True)
