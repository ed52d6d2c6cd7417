"""The time that training has taken, a killed run's part included; for run.json, never for published files."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.files.json_files import write_json
from pipeline.run.compile_timer import CompileTimer

NAME = "timer.json"

Mark = tuple[int, float, float]
"""Iterations done, and the wall-clock and processor seconds that they took."""


class TrainingTimer:
    """Seconds of the iterations alone: compiling and scoring on the way do not count.

    Attributes:
        marks: of the points of the curve.
        earlier: of the processes that were killed before this one, up to their last checkpoint.
    """

    def __init__(self, work: Path, compiled: CompileTimer):
        """Starts at iteration 0.

        Args:
            work: the folder with the checkpoint.
            compiled: what this process has compiled.
        """
        self._compiled = compiled
        self._file = work / NAME
        self.marks: list[Mark] = []
        self.earlier: Mark = (0, 0.0, 0.0)
        self._wall, self._cpu = self._spent()

    def start(self, iteration: int) -> None:
        """Starts anew, from the marks of a killed run if training goes on from its checkpoint.

        Args:
            iteration: steps done.
        """
        if iteration:
            self._read(iteration)
        self._wall, self._cpu = self._spent()

    def _spent(self) -> tuple[float, float]:
        """Seconds of this process, less what it compiled."""
        compiled = self._compiled
        return time.monotonic() - compiled.seconds, time.process_time() - compiled.cpu_seconds

    def _read(self, iteration: int) -> None:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            known = json.loads(self._file.read_text(encoding="utf-8"))
            if known["earlier"][0] == iteration:
                self.earlier = tuple(known["earlier"])
                self.marks = [tuple(mark) for mark in known["marks"] if mark[0] <= iteration]

    def now(self, iteration: int) -> Mark:
        """The mark of this moment."""
        wall, cpu = self._spent()
        return (
            iteration,
            round(self.earlier[1] + wall - self._wall, 3),
            round(self.earlier[2] + cpu - self._cpu, 3),
        )

    def mark(self, iteration: int) -> None:
        """Adds a mark for a point of the curve."""
        self.marks.append(self.now(iteration))

    def save(self, iteration: int) -> None:
        """Stores the marks beside a checkpoint that has just been written."""
        state = {"earlier": self.now(iteration), "marks": self.marks}
        write_json(self._file, state)

    def summary(self, first: int, last: int) -> dict[str, Any]:
        """The seconds of all iterations and of each of this process's, for run.json.

        ``curve_seconds`` has iteration, wall-clock and processor seconds of each point of the curve.

        Args:
            first: the iteration that this process began with.
            last: iterations done.
        """
        _, wall, _ = self.now(last)
        return {
            "train_seconds": wall,
            "milliseconds_an_iteration": 1e3 * (wall - self.earlier[1]) / max(1, last - first),
            "curve_seconds": self.marks,
            "earlier_seconds": self.earlier[1],
            "earlier_cpu_seconds": self.earlier[2],
        }

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """A context in which no time counts."""
        before = self._spent()
        try:
            yield
        finally:
            now = self._spent()
            self._wall += now[0] - before[0]
            self._cpu += now[1] - before[1]
