"""A run in a session of its own that is watched, and killed at a given moment."""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.config.workspace import REPOSITORY
from pipeline.store.artifact import LATEST, MANIFEST, RUN, SCRATCH
from pipeline.store.record_digests import SEAL
from tests.faults.project import Project

TARGETS = ("group", "stage", "doit")
# What is waited for in a stage's folder, and then the run is killed: the steps of publishing.
MOMENTS = (RUN, MANIFEST, SEAL, "visible", LATEST)
POLL = 0.0005


@dataclasses.dataclass(frozen=True)
class Kill:
    """One kill that is planned.

    Attributes:
        stage: in which stage; empty: while doit starts.
        moment: one of ``MOMENTS``, or empty: after a part of the stage's time.
        part: of the stage's time, or of four milliseconds after the moment.
        target: the whole group, the stage's process alone (as the system does when memory is short), or
            doit alone.
    """

    stage: str
    moment: str
    part: float
    target: str


class Run:
    """The command, started; its lines and when each stage began."""

    def __init__(self, project: Project, *tasks: str):
        self.project = project
        self.lines: list[str] = []
        self.killed = ""  # who was, in the end
        self.began: dict[str, float] = {}
        self.start = time.monotonic()
        self.process = subprocess.Popen(
            project.command(*tasks), cwd=REPOSITORY, env=project.environment(), start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
        )  # fmt: skip
        atexit.register(self.kill, "group")  # whoever stops the campaign stops its run too
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        # doit says ". fit:tiny" when it starts a stage and "-- fit:tiny" when there is nothing to do.
        begins = re.compile(rf"^\.\s+(\w+):{re.escape(self.project.subject)}$")
        for line in self.process.stdout or ():
            if match := begins.match(line.rstrip()):
                self.began[match[1]] = time.monotonic()
            self.lines.append(line.rstrip())

    @property
    def over(self) -> bool:
        return self.process.poll() is not None

    @property
    def stage(self) -> str:
        """The stage that began last; empty before any."""
        return list(self.began)[-1] if self.began else ""

    def wait_for(self, there: Callable[[], bool], poll: float = POLL) -> bool:
        """Until something is there or the run is over; whether it is there."""
        while not self.over:
            if there():
                return True
            time.sleep(poll)
        return False

    def finish(self) -> int:
        """Waits for the end; returns the exit status."""
        status = self.process.wait()
        self.reader.join(timeout=10)
        return status

    def text(self) -> str:
        return "\n".join(self.lines)

    def durations(self) -> dict[str, float]:
        """Seconds of every stage of a run that is over, and of doit before the first."""
        marks = [("", self.start), *self.began.items(), ("end", time.monotonic())]
        return {name: after - at for (name, at), (_, after) in zip(marks, marks[1:], strict=False)}

    def wait_and_kill(self, kill: Kill, seconds: float) -> bool:
        """Waits for a kill's moment and kills; false where the run was over before.

        Args:
            seconds: that the stage takes when nothing disturbs it.
        """
        if kill.stage and not self.wait_for(lambda: kill.stage in self.began, poll=0.002):
            return False
        if kill.moment:
            folder = self.project.store.folder(self.project.subject, kill.stage)
            if not self.wait_for(lambda: reached(folder, kill.moment)):
                return False
            time.sleep(0.004 * kill.part)
        else:
            until = (self.began.get(kill.stage) or self.start) + kill.part * seconds
            self.wait_for(lambda: time.monotonic() >= until, poll=0.002)
        return self.kill(kill.target)

    def kill(self, target: str) -> bool:
        """SIGKILL to the group, to doit alone or to its stage alone; false where it was over."""
        if self.over:
            return False
        victims = children(self.process.pid) if target == "stage" else [self.process.pid]
        if not victims:  # between two stages there is none to kill
            target = "group"
        with contextlib.suppress(ProcessLookupError):
            if target == "group":
                os.killpg(self.process.pid, signal.SIGKILL)
            for victim in victims if target != "group" else ():
                os.kill(victim, signal.SIGKILL)
        self.killed = target
        return True

    def gone(self, seconds: float) -> bool:
        """Whether nothing of the session is left within so many seconds."""
        until = time.monotonic() + seconds
        while alive(self.process.pid):
            if time.monotonic() > until:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self.process.pid, signal.SIGKILL)
                return False
            time.sleep(0.01)
        return True


def reached(folder: Path, moment: str) -> bool:
    """Whether a stage's folder shows this step of publishing, or a later one."""
    try:
        names = os.listdir(folder)
    except OSError:
        return False
    if moment == LATEST:
        return LATEST in names
    visible = any(not name.startswith(".") and name != LATEST for name in names)
    if moment == "visible" or visible:
        return visible
    return any(
        os.path.exists(folder / name / "output" / moment) for name in names if name.startswith(SCRATCH)
    )


def stat_of(pid: str) -> list[str]:
    """The fields of /proc/PID/stat from the state on; empty where there is none."""
    try:
        return Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def children(parent: int) -> list[int]:
    """The processes that a process has started and that still run."""
    found = []
    for pid in (name for name in os.listdir("/proc") if name.isdigit()):
        stat = stat_of(pid)
        if stat and stat[0] != "Z" and int(stat[1]) == parent:
            found.append(int(pid))
    return found


def alive(session: int) -> list[int]:
    """The processes of a session that still run."""
    found = []
    for pid in (name for name in os.listdir("/proc") if name.isdigit()):
        stat = stat_of(pid)
        if stat and stat[0] not in "ZX" and int(stat[3]) == session:
            found.append(int(pid))
    return found
