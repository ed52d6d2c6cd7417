"""Who is done, and who failed at which stage and why: the last lines of a run of many subjects."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from doit.exceptions import UnmetDependency
from doit.reporter import ConsoleReporter


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a subject.

    Attributes:
        subject: who.
        stage: where it stopped; empty where it is done.
        reason: why, in a line.
        seconds: how long it took.
    """

    subject: str
    stage: str = ""
    reason: str = ""
    seconds: float = 0.0


def summary_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """The summary, a line a subject after one with the counts."""
    failed = [one for one in outcomes if one.stage]
    width = max((len(one.subject) for one in outcomes), default=0)
    lines = [f"{len(outcomes) - len(failed)} of {len(outcomes)} subjects done, {len(failed)} failed"]
    for one in outcomes:
        said = f"failed at {one.stage}: {one.reason}" if one.stage else "done"
        lines.append(f"  {one.subject:<{width}}  {said}")
    return lines


def summarising(chosen: Sequence[str], stages: Sequence[str]) -> type[ConsoleReporter]:
    """A doit reporter that ends a run of several subjects with a summary.

    Args:
        chosen: the subjects that the command line names.
        stages: every stage, upstream first.
    """

    class Reporter(ConsoleReporter):
        """As doit's own, but tasks that only wait for a failed one are not reported as failures."""

        desc = "console output and a summary of subjects"

        def __init__(self, outstream: Any, options: Mapping[str, Any]) -> None:
            super().__init__(outstream, options)
            self.reasons: dict[tuple[str, str], str] = {}
            self.blocked: dict[tuple[str, str], str] = {}
            self.touched: set[str] = set()

        def _note(self, task: Any) -> None:
            self.touched.add(task.name.partition(":")[2])

        def add_success(self, task: Any) -> None:
            """Called by doit."""
            self._note(task)
            super().add_success(task)

        def skip_uptodate(self, task: Any) -> None:
            """Called by doit."""
            self._note(task)
            super().skip_uptodate(task)

        def add_failure(self, task: Any, fail: Any) -> None:
            """Called by doit."""
            stage, _, subject = task.name.partition(":")
            self.touched.add(subject)
            if isinstance(fail, UnmetDependency):
                self.blocked.setdefault((stage, subject), f"what it needs failed: {fail.message}".strip())
                return
            self.reasons[stage, subject] = str(fail.message).strip().splitlines()[0] if fail.message else ""
            super().add_failure(task, fail)

        def complete_run(self) -> None:
            """Called by doit."""
            super().complete_run()
            subjects = [subject for subject in chosen if subject in self.touched]
            if len(subjects) < 2:
                return
            known = {**self.blocked, **self.reasons}
            outcomes = []
            for subject in subjects:
                at = next((stage for stage in stages if (stage, subject) in known), "")
                outcomes.append(Outcome(subject, at, known.get((at, subject), "")))
            self.write("\n".join(["", *summary_lines(outcomes)]) + "\n")
            sys.stdout.flush()

    return Reporter
