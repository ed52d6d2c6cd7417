"""Stages run in processes of their own, and why one failed."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NoReturn, Protocol

from pipeline.config.request import Request
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.run.job import Job
from pipeline.run.stage import usual
from pipeline.store.artifact import Artifact

REASON = "FLEXIAVATAR_REASON"
"""Environment variable: the file in which a failing stage leaves its reason for whoever started it."""

INTERRUPTED = 130  # exit status of a stage that Ctrl-C stopped, as the shell's
CROWDED = 1.5  # running processes a core
_PARENT_DEATH = 1  # PR_SET_PDEATHSIG of prctl(2)


class Starts(Protocol):
    """Starts a stage, waits for it, and returns its exit status, negative where a signal ended it."""

    def __call__(self, arguments: list[str], environment: Mapping[str, str], log: Path | None) -> int:
        """See ``start_process`` for the arguments."""


def stage_arguments(stage: str, subject: str, request: Request) -> list[str]:
    """The arguments with which ``python -m pipeline`` runs one stage."""
    words = request.about(subject).words()
    words.pop("subject", None)
    return [stage, "--subject", subject, *(f"{name}={value}" for name, value in words.items())]


def run_stage_process(
    stage: str, subject: str, request: Request, log: Path | None = None, start: Starts | None = None
) -> str | None:
    """Runs a stage in a process that ends with this one; returns why it failed, None where it did not.

    Args:
        stage: its name.
        subject: whose.
        request: the command line's.
        log: a file that gets the stage's lines in place of this terminal.
        start: ``start_process`` if None.

    Raises:
        KeyboardInterrupt: the stage was stopped by Ctrl-C, whether or not this process heard it.
    """
    with tempfile.TemporaryDirectory(prefix="flexiavatar-") as folder:
        reason = Path(folder) / "reason"
        arguments = stage_arguments(stage, subject, request)
        status = (start or start_process)(arguments, {REASON: str(reason)}, log)
        said = reason.read_text(encoding="utf-8") if reason.is_file() else ""
    if status in (INTERRUPTED, -signal.SIGINT):
        raise KeyboardInterrupt
    if status < 0:
        return killed_by(-status)
    if status:
        where = "its own lines above say why" if log is None else f"{log} says why"
        return said or f"stopped with status {status}; {where}"
    return None


def start_process(arguments: list[str], environment: Mapping[str, str], log: Path | None) -> int:
    """Runs a stage in a new Python; returns its exit status, negative where a signal ended it.

    Args:
        arguments: of ``stage_arguments``.
        environment: variables besides those of this process.
        log: a file that gets the stage's lines in place of this terminal.
    """
    # -P: a folder called pipeline where the user stands is not taken for this package.
    command = [sys.executable, "-P", "-m", "pipeline", *arguments]
    with contextlib.ExitStack() as stack:
        out = None if log is None else stack.enter_context(log.open("a", encoding="utf-8"))
        return subprocess.call(
            command,
            env={**process_environment(), **environment},
            stdout=out,
            stderr=out,
            preexec_fn=ending_with_this_process(),
        )


def end_process(status: int) -> NoReturn:
    """Ends this process at once: to take down torch and all that was loaded takes one to two seconds."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # closed, or the reader has gone
            stream.flush()
    os._exit(status)


def leave_reason(message: str) -> None:
    """Leaves the reason of a failure where the starter looks for it, if there is one."""
    if os.environ.get(REASON):
        with contextlib.suppress(OSError):
            Path(os.environ[REASON]).write_text(message, encoding="utf-8")


def process_environment() -> dict[str, str]:
    """The environment of a stage's process, which finds the packages from wherever the user stands.

    A process that has it is given the same again. The malloc thresholds keep large activations on the heap
    instead of asking the kernel for fresh zeroed pages at every step; they must be set before Python starts.
    Threads that wait sleep on a crowded machine: one that spins there holds the core that its partner waits
    for, and a training step takes up to twenty times as long; on an idle one spinning is a third faster
    (docs/results.md, "Crowded machines").
    """
    defaults = {
        "MALLOC_MMAP_THRESHOLD_": "4294967296",
        "MALLOC_TRIM_THRESHOLD_": "4294967296",
        "MALLOC_TOP_PAD_": "268435456",
        **({"OMP_WAIT_POLICY": "PASSIVE"} if is_crowded() else {}),
    }
    # Once only: a process that starts itself again until its environment is this one must come to an end.
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    places = [str(REPOSITORY), *(place for place in given if place and place != str(REPOSITORY))]
    return {**defaults, **os.environ, "PYTHONPATH": os.pathsep.join(places)}


def is_crowded() -> bool:
    """Whether other jobs want the cores, by the last minute's load; False where nobody counts it."""
    counted = hasattr(os, "getloadavg")
    return counted and os.getloadavg()[0] > CROWDED * (os.cpu_count() or 1)


def killed_by(number: int) -> str:
    """Why a process ended that a signal ended."""
    try:
        name = f" ({signal.Signals(number).name})"
    except ValueError:
        name = ""
    likely = ""
    if name == " (SIGKILL)":
        likely = ", often the system's when memory runs out: run fewer subjects at once or a smaller preset"
    return f"killed by signal {number}{name}{likely}; the same command goes on from here"


def ending_with_this_process() -> Callable[[], None] | None:
    """The function that a started process calls first, so that it ends with this one; None off Linux."""
    return functools.partial(_end_with, os.getpid()) if sys.platform == "linux" else None


def _end_with(parent: int) -> None:
    """Lets the kernel end this process if the one that started it is killed."""
    with contextlib.suppress(OSError, AttributeError):  # a C library without it
        ctypes.CDLL(None).prctl(_PARENT_DEATH, signal.SIGTERM)
        if os.getppid() != parent:  # it was killed before the kernel knew
            os._exit(1)


def make_results(
    job: Job, stages: Iterable[str] | None = None, log: Path | None = None
) -> dict[str, Artifact]:
    """The results of some stages and of all that they need; what the store lacks is run first.

    ``latest`` is left pointing where it pointed before.

    Args:
        job: whose, and under which settings.
        stages: names; all that run without being asked for if None.
        log: a file that gets the stages' own lines in place of this terminal.

    Raises:
        UserError: a stage stopped.
    """
    found = {}
    with _latest_kept(job):
        for stage in job.upstream_first(usual(job.stages) if stages is None else stages):
            if job.find(stage) is None:
                reason = run_stage_process(stage, job.subject.name, job.request, log)
                if reason:
                    raise UserError(f"{stage}:{job.subject.name} {reason}")
            artifact = job.find(stage)
            if artifact is None:
                raise UserError(f"{stage}:{job.subject.name} ran, and its result is not in the store")
            found[stage] = artifact
    return found


@contextlib.contextmanager
def _latest_kept(job: Job) -> Iterator[None]:
    """Puts every stage's ``latest`` back to what it was."""
    before = {stage: job.store.latest(job.subject.name, stage) for stage in job.stages}
    try:
        yield
    finally:
        for artifact in before.values():
            if artifact is not None and artifact.folder.is_dir():
                job.store.select(artifact)
