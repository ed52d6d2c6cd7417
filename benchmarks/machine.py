"""The process that a benchmark runs in: its allocator, its threads, and what it says of the machine."""

from __future__ import annotations

import os
import platform
import sys

import numba
import torch

from pipeline.run.process import process_environment


def prepare(module: str, threads: int) -> None:
    """Gives the process a stage's environment and ``threads`` threads (0 leaves torch's own number).

    The allocator reads its settings once, before Python starts, so the process starts itself again with
    them if they are not there yet.

    Args:
        module: the name to start again, "benchmarks.step".
        threads: of torch and numba.
    """
    environment = process_environment()
    if environment != dict(os.environ):
        os.execve(sys.executable, [sys.executable, "-m", module, *sys.argv[1:]], environment)
    numba.get_num_threads()  # its pool, when it starts, sets the number of OpenMP's threads, torch's too
    if threads:
        torch.set_num_threads(threads)


def described() -> str:
    """One line for the head of a table."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads"
    return f"{machine}, torch {torch.__version__}"
