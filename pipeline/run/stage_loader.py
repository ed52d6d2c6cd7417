"""Stages that start at once: one process loads the code of all that are still to run, and forks for each.

Loading a stage's code takes two to four seconds, most of it torch's. While the first stage works, which
keeps one of two cores idle for most of its time, this process loads what the others need, once for all.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.run.process import end_process, ending_with_this_process, process_environment

OF_OPTIMIZERS = "torch._dynamo"  # the first one of a process loads it, which takes more than a second
LAST_WORDS = 0.25  # seconds
GPUS = Path("/dev/nvidiactl"), Path("/dev/kfd")  # there with a driver of NVIDIA's or of AMD's


def can_load_ahead() -> bool:
    """Whether a process can be forked after its libraries were loaded, and a core is free to load them.

    Not where there is a GPU: what a library has begun with its driver does not survive a fork.
    """
    return sys.platform == "linux" and (os.cpu_count() or 1) > 1 and not any(one.exists() for one in GPUS)


class StageLoader:
    """Runs stages in copies of a process that has loaded their code."""

    def __init__(self, functions: Iterable[str]):
        """Starts to load; it ends with this process.

        Args:
            functions: the stages' ``Stage.run``.
        """
        reading, writing = os.pipe()
        self._answers = os.fdopen(reading, "rb")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "pipeline.run.stage_loader", str(writing), *functions],
            env=process_environment(),
            stdin=subprocess.PIPE,
            pass_fds=[writing],
            preexec_fn=ending_with_this_process(),
        )
        os.close(writing)

    def run(self, arguments: list[str], environment: Mapping[str, str], log: Path | None) -> int:
        """Runs a stage and returns its exit status, negative where a signal ended it.

        Args:
            arguments: as ``python -m pipeline`` takes them.
            environment: variables besides those of this process.
            log: a file that gets the stage's lines in place of this terminal.
        """
        asked = {
            "arguments": arguments,
            "environment": dict(environment),
            "log": None if log is None else str(log),
        }
        assert self._process.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError):  # the system has killed it
                self._process.stdin.write(json.dumps(asked).encode() + b"\n")
                self._process.stdin.flush()
            answer = self._answers.readline()
        except BaseException:
            self.close()
            raise
        return int(answer) if answer else self._process.wait()

    @property
    def alive(self) -> bool:
        """False once it was ended, by whomever."""
        return self._process.poll() is None

    def close(self) -> None:
        """Ends it, and what it runs, after a moment in which that may say that it was stopped."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(LAST_WORDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._answers.close()


def load(functions: Iterable[str]) -> None:
    """Imports stages' code, and what torch would load later; what fails the stage itself reports."""
    for function in functions:
        with contextlib.suppress(Exception):
            importlib.import_module(function.partition(":")[0])
    if "torch" in sys.modules:
        importlib.import_module(OF_OPTIMIZERS)


def run_forked(asked: dict[str, Any]) -> int:
    """Runs a stage in this process, which is the copy; returns its exit status."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(os.open(os.devnull, os.O_RDONLY), sys.stdin.fileno())
    if asked["log"] is not None:
        with open(asked["log"], "ab") as log:
            os.dup2(log.fileno(), sys.stdout.fileno())
            os.dup2(log.fileno(), sys.stderr.fileno())
    os.environ.update(asked["environment"])
    from pipeline.__main__ import main as run_stage

    return run_stage(asked["arguments"])


def main(answers_to: int, functions: list[str]) -> int:
    """Loads stages' code, then runs one stage a line of standard input until that ends.

    Args:
        answers_to: the file descriptor that gets each stage's exit status, a line each.
        functions: the stages' ``Stage.run``.

    Returns:
        0.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the stage hears it, too, and says that it stopped
    load(functions)
    end_with_this = ending_with_this_process()
    for line in sys.stdin.buffer:
        child = os.fork()
        if not child:
            os.close(answers_to)
            if end_with_this is not None:
                end_with_this()
            end_process(run_forked(json.loads(line)))
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.write(answers_to, b"%d\n" % status)
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))
