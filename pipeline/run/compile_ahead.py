"""Kernels compiled beforehand, in a process of low priority beside the first stages of a job.

Otherwise a newcomer's first training waits for numba. A stage names a function that calls its kernels once
(``Stage.compile_ahead``), and doit starts this module when a stage before it begins. No stage waits for it,
and none fails with it: one that comes to a kernel which is not there yet compiles it itself. numba replaces
the files of its cache whole, so that this may be killed at any moment.

A record beside numba's cache names the source files that were compiled, with their times and sizes: numba's
own rule for what is out of date. doit, which imports nothing heavy, sees there that nothing is to be done.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import importlib
import json
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import filelock

from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.run.job import Job
from pipeline.run.process import ending_with_this_process, process_environment
from pipeline.run.versions import package_version

LOWEST_PRIORITY = 19
LOCK = "compile_ahead.lock"
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}  # a compiler has no more


def kernels_ahead(job: Job, stages: Iterable[str], begins: str) -> tuple[str, ...]:
    """The functions that compile what will be needed after a stage, each once, as "module:function".

    Args:
        job: whose, and under which settings.
        stages: those that are asked for, with all that they need; in their order.
        begins: the stage that runs now. Its own kernels it would compile at the same time.
    """
    found = []
    for name in stages:
        with contextlib.suppress(UserError, OSError):  # the stage itself reports it
            if name != begins and job.find(name) is None:
                found.append(job.stages[name].kernels_of(job.settings[name]))
    return tuple(dict.fromkeys(one for one in found if one))


def start_compiling(functions: tuple[str, ...]) -> subprocess.Popen[bytes] | None:
    """Starts the process that compiles what numba's cache lacks; it ends with this one.

    Args:
        functions: as of ``kernels_ahead``.

    Returns:
        None where nothing is lacking, where there is one core, which a stage needs, or where no process can
        be started.
    """
    lacking = [one for one in functions if not is_compiled(one)]
    if not lacking or cores() < 2:
        return None
    command = [sys.executable, "-P", "-m", "pipeline.run.compile_ahead", *lacking]
    environment = {**process_environment(), **ONE_THREAD}
    with contextlib.suppress(OSError):
        process = subprocess.Popen(command, env=environment, preexec_fn=ending_with_this_process())
        atexit.register(process.terminate)  # where the kernel does not
        return process
    return None


def cores() -> int:
    """The processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def is_compiled(function: str) -> bool:
    """True where a function's record is there and no file has changed since."""
    try:
        known = json.loads(record_file(function).read_text(encoding="utf-8"))
        return bool(known) and all(stamp(Path(path)) == found for path, found in known.items())
    except (OSError, ValueError, AttributeError):  # none, or damaged
        return False


def record_file(function: str) -> Path:
    """The place of a function's record, another for each numba, Python and machine."""
    machine = platform.node(), platform.machine()  # numba compiles for one processor
    made_by = (function, package_version("numba"), platform.python_version(), *machine)
    name = hashlib.sha256(repr(made_by).encode()).hexdigest()[:16]
    return cache_folder() / f"compiled-{name}.json"


def cache_folder() -> Path:
    """The folder where numba keeps its cache, or one of them."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen) if chosen else Path(__file__).parent / "__pycache__"


def stamp(path: Path) -> list[int]:
    """The time of a file's last change, ns, and its size, bytes."""
    status = path.stat()
    return [status.st_mtime_ns, status.st_size]


def loaded_sources() -> list[Path]:
    """The files of the modules of this project that are loaded: kernels, and what calls them."""
    files = {getattr(module, "__file__", None) for module in list(sys.modules.values())}
    return sorted(Path(file) for file in files if file and Path(file).is_relative_to(REPOSITORY))


def compile_and_record(function: str) -> None:
    """Calls a function that compiles kernels, and writes its record."""
    module, _, name = function.partition(":")
    getattr(importlib.import_module(module), name)()
    sources = {str(path): stamp(path) for path in loaded_sources()}
    record_file(function).write_text(json.dumps(sources, indent=1), encoding="utf-8")


def main(functions: list[str]) -> int:
    """Calls the functions whose record is not there, unless another process is at it; returns 0."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # whoever stops the job wants no traceback of this
    with contextlib.ExitStack() as stack:
        try:
            cache_folder().mkdir(parents=True, exist_ok=True)
            stack.enter_context(filelock.FileLock(cache_folder() / LOCK).acquire(timeout=0))
        except (OSError, filelock.Timeout):  # of a read-only installation, or held
            return 0
        from pipeline.run.compile_timer import compile_timer  # numba, for whoever has work

        if hasattr(os, "nice"):
            os.nice(LOWEST_PRIORITY)
        compiled = stack.enter_context(compile_timer(say))
        for function in functions:
            try:
                if not is_compiled(function):
                    compile_and_record(function)
            except Exception as error:  # whatever it is, the stage reports it if it meets it, too
                say(f"not compiled beforehand ({type(error).__name__}: {error}); the stages do it themselves")
                return 0
    if compiled.seconds:
        say(f"compiled in {compiled.seconds:.0f} s, once for all runs")
    return 0


def say(message: str) -> None:
    """One line to the terminal."""
    print(f"kernels: {message}", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
