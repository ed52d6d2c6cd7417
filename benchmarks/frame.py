"""The frame that every benchmark shares: options, the machine, rows as a table, JSON, one headline.

A benchmark is a function ``measure(options, report)`` that returns its headline; ``run`` does the rest.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numba
import torch

from pipeline.config.assets import fetch, find_asset, is_ready
from pipeline.config.workspace import Workspace
from pipeline.errors import UserError
from pipeline.run.job import Job, run_stage
from pipeline.run.process import process_environment
from pipeline.store.artifact import Artifact

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
"""Seconds that have passed, and those of all the process's threads, which a busy machine changes less."""

Measured = TypeVar("Measured")


class Report:
    """A benchmark's rows: shown as they come, kept for the JSON file."""

    def __init__(self) -> None:
        """Starts empty."""
        self.tables: dict[str, list[dict[str, Any]]] = {}
        self._columns: tuple[str, ...] = ()
        self._widths: tuple[int, ...] = ()

    def add(self, row: Any, table: str = "rows") -> None:
        """Shows a row, under a heading where the columns are new.

        Args:
            row: a data class or a mapping, column -> value. Lists and mappings go to the JSON file alone.
            table: its name in the JSON file.
        """
        row = dict(row) if isinstance(row, Mapping) else dataclasses.asdict(row)
        self.tables.setdefault(table, []).append(row)
        scalars = {name: value for name, value in row.items() if not isinstance(value, dict | list | tuple)}
        cells = {name: _cell(value) for name, value in scalars.items()}
        if (table, *cells) != self._columns:
            self._columns = (table, *cells)
            self._widths = tuple(max(len(name), len(cell) + 2) for name, cell in cells.items())
            print()
            self._print(cells)
            print("|" + "|".join("-" * (width + 2) for width in self._widths) + "|")
        self._print(cells.values())

    def _print(self, cells: Any) -> None:
        padded = (f"{cell:<{width}}" for cell, width in zip(cells, self._widths, strict=True))
        print(f"| {' | '.join(padded)} |", flush=True)


def run(
    name: str,
    claim: str | None,
    measure: Callable[[argparse.Namespace, Report], str],
    arguments: list[str] | None = None,
    *,
    threads: int = 0,
    options: Callable[[argparse.ArgumentParser], object] | None = None,
) -> int:
    """Runs a benchmark from its command line; returns the exit status.

    Args:
        name: its module's, "step".
        claim: the text of ``--help``, which says where the claim stands that the benchmark holds.
        measure: takes the options and the report, returns the headline.
        arguments: the command line's if None, for which the process takes a stage's environment.
        threads: of torch and numba unless asked for; 0 for all.
        options: adds the benchmark's own.
    """
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=claim,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="few small cases: figures that mean little")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    parser.add_argument("--threads", type=int, default=threads, help="of torch and numba; 0 for all")
    if options is not None:
        options(parser)
    chosen = parser.parse_intermixed_args(arguments)
    if arguments is None:
        prepare(name, chosen.threads)
    print(machine())
    report = Report()
    try:
        headline = measure(chosen, report)
    except UserError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    if chosen.json is not None:
        record = {"benchmark": name, "machine": machine(), "headline": headline, **report.tables}
        text = json.dumps(_finite(record), indent=1, allow_nan=False)
        chosen.json.write_text(text + "\n", encoding="utf-8")
    print(f"\n{name}: {headline}")
    return 0


def prepare(name: str, threads: int) -> None:
    """Gives the process a stage's environment and ``threads`` threads (0 leaves torch's own number).

    The allocator reads its settings once, before Python starts, so the process starts itself again with
    them if they are not there yet.
    """
    environment = process_environment()
    if environment != dict(os.environ):
        os.execve(sys.executable, [sys.executable, "-m", f"benchmarks.{name}", *sys.argv[1:]], environment)
    numba.get_num_threads()  # its pool, when it starts, sets the number of OpenMP's threads, torch's too
    if threads:
        torch.set_num_threads(threads)
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


def machine() -> str:
    """One line that says what was measured on."""
    cores = f"{os.cpu_count()} cores, {torch.get_num_threads()} threads"
    return f"{platform.machine()}, {cores}, torch {torch.__version__}"


def in_turn(jobs: Mapping[str, Callable[[], Measured]], repeats: int) -> dict[str, list[Measured]]:
    """What each job returned, called in turn so that what else the machine does meets all alike.

    A first turn, which compiles and warms up, is left out.
    """
    found: dict[str, list[Measured]] = {name: [] for name in jobs}
    for turn in range(repeats + 1):
        for name, job in jobs.items():
            value = job()
            if turn:
                found[name].append(value)
    return found


def milliseconds(job: Callable[[], object], clock: str = "cpu") -> float:
    """What one call of a job takes."""
    now = CLOCKS[clock]
    start = now()
    job()
    return 1e3 * (now() - start)


def least(jobs: Mapping[str, Callable[[], object]], repeats: int, clock: str = "cpu") -> dict[str, float]:
    """The least milliseconds of each job, taken in turn."""
    timed = {name: lambda job=job: milliseconds(job, clock) for name, job in jobs.items()}
    return {name: min(times) for name, times in in_turn(timed, repeats).items()}


def stage_options(parser: argparse.ArgumentParser) -> None:
    """The options of a benchmark that runs stages."""
    parser.add_argument("--artifacts", type=Path, metavar="DIR", help="keep and reuse the stages' results")
    parser.add_argument("words", nargs="*", metavar="NAME=VALUE", help="settings, as fit.iterations=200")


@contextlib.contextmanager
def settings_of(options: argparse.Namespace, **defaults: str) -> Iterator[dict[str, str]]:
    """The settings of stages that run for a benchmark: its defaults (a__b for a.b), then the command line's.

    Results lie in the folder that the options name, else in one that is deleted in the end.
    """
    with contextlib.ExitStack() as stack:
        folder = options.artifacts or stack.enter_context(tempfile.TemporaryDirectory())
        own = {name.replace("__", "."): value for name, value in defaults.items()}
        given = dict(word.partition("=")[::2] for word in options.words)
        yield {"artifacts": str(folder), **own, **given}


def asset_folder(workspace: Workspace, name: str) -> Path:
    """Where an asset lies; it is fetched if it is not there."""
    asset = find_asset(workspace, name)
    if not is_ready(workspace, asset):
        fetch(workspace, asset)
    return workspace.assets / name


def made(job: Job, stage: str) -> dict[str, Artifact]:
    """A stage's result and those that it needs, by stage; what the store lacks is fetched and run."""
    found = {}
    for name in job.upstream_first([stage]):
        for asset in job.needed_assets(name):
            asset_folder(job.workspace, asset)
        found[name] = job.find(name) or run_stage(job, name)
    return found


def _cell(value: Any) -> str:
    """A value as a table shows it: four figures of a number."""
    if isinstance(value, float):
        return f"{value:.0f}" if 1000 <= abs(value) < math.inf else f"{value:.4g}"
    return "" if value is None else str(value)


def _finite(value: Any) -> Any:
    """The same with None for numbers that are not finite, which JSON does not have."""
    if isinstance(value, Mapping):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
