"""Kernels are compiled beside the first stages: once, and never longer than the job runs."""

import importlib
import os
import signal
import subprocess
import sys

import pytest

from pipeline.config.workspace import REPOSITORY
from pipeline.run import compile_ahead
from pipeline.run.job import open_job, run_stage
from tests.faults.runs import alive
from tests.pipeline.test_faults import LINUX, start, wait_until

WORK = "tests.pipeline.toy_stages.work"
SLOWLY, QUICKLY, BADLY = (f"{WORK}:compile_{how}" for how in ("slowly", "quickly", "badly"))
TRAINING_STEP = """
import sys
from pathlib import Path
from pipeline.run.compile_timer import compile_timer
from stages.train import run
from tests.made.portrait import context_for
with compile_timer() as compiled:
    context = context_for(Path(sys.argv[1]), Path(sys.argv[2]), iterations=2, representation=sys.argv[3])
    run.run(context)
print(compiled.cpu_seconds)
"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    return folder


def compilers(cache):
    """Process number -> priority of those that compile."""
    return {int(path.name.split("-")[1]): path.read_text() for path in cache.glob("compiles-*")}


def program(*words):
    return subprocess.run(
        [sys.executable, *words], cwd=REPOSITORY, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    ).stdout  # fmt: skip


# When


def test_what_later_stages_lack_is_compiled_and_nothing_of_others(toy):
    def ahead(begins, *words):
        job = open_job("ann", toy.request(*words))
        return compile_ahead.kernels_ahead(job, job.upstream_first(["paint"]), begins)

    assert ahead("gather", "paint.kernels=true") == (SLOWLY,)
    assert ahead("paint", "paint.kernels=true") == ahead("gather") == ()
    for stage in ("gather", "bend", "paint"):
        run_stage(open_job("ann", toy.request("paint.kernels=true")), stage)
    assert ahead("gather", "paint.kernels=true") == ()  # there is no painting to be done


@LINUX
@pytest.mark.skipif(compile_ahead.cores() < 2, reason="needs two cores")
def test_a_job_compiles_once_at_low_priority_and_not_longer_than_it_lives(toy, cache):
    run = start(toy, "subject=ann,bob", "paint.kernels=true", "paint.iterations=1000", "paint.rate=0.05")
    try:
        wait_until(lambda: "" not in (compilers(cache).values() or {""}))
        wait_until(lambda: (toy.store / "ann" / "paint").exists())
        ((process, priority),) = compilers(cache).items()
        assert priority == "19" and process in alive(run.pid)
    finally:
        os.kill(run.pid, signal.SIGKILL)
    run.communicate()
    wait_until(lambda: not alive(run.pid), seconds=10)
    assert not list(cache.glob("compiled-*.json"))  # nothing says that it is done


def test_nothing_is_started_on_one_core_or_for_what_is_there(cache, monkeypatch):
    monkeypatch.setattr(compile_ahead, "cores", lambda: 1)
    assert compile_ahead.start_compiling((SLOWLY,)) is None
    monkeypatch.setattr(compile_ahead, "cores", lambda: 8)
    assert compile_ahead.start_compiling(()) is None
    compile_ahead.compile_and_record(QUICKLY)
    assert compile_ahead.start_compiling((QUICKLY,)) is None


# The record


def test_a_record_holds_until_a_source_or_a_version_changes(cache, tmp_path, monkeypatch):
    monkeypatch.setattr(compile_ahead, "REPOSITORY", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    source = tmp_path / "toy_kernels.py"
    source.write_text("def compile():\n    pass\n")
    function = "toy_kernels:compile"
    assert not compile_ahead.is_compiled(function)
    compile_ahead.compile_and_record(function)
    assert compile_ahead.is_compiled(function)
    with monkeypatch.context() as patch:
        patch.setattr(compile_ahead, "package_version", lambda name: "0.0")
        assert not compile_ahead.is_compiled(function)
    source.write_text("def compile():\n    return 1\n")
    assert not compile_ahead.is_compiled(function)
    importlib.invalidate_caches()
    sys.modules.pop("toy_kernels")


@pytest.mark.parametrize("damage", ["", "{", "[]", "7", '{"a": 1}'])
def test_a_damaged_record_counts_as_none(cache, damage):
    compile_ahead.record_file(QUICKLY).write_text(damage)
    assert not compile_ahead.is_compiled(QUICKLY)


# The process


def test_what_another_process_compiles_is_left_to_it(cache):
    code = f"from pipeline.run.compile_ahead import main; print(main(['{QUICKLY}']))"
    with compile_ahead.filelock.FileLock(cache / compile_ahead.LOCK):
        assert program("-c", code) == "0\n"
    assert not (cache / "compiled").exists()


def test_one_that_fails_says_so_in_a_line_and_spoils_nothing(cache):
    said = program("-m", "pipeline.run.compile_ahead", QUICKLY, BADLY)
    assert len(said.splitlines()) == 1 and "ZeroDivisionError: ours" in said
    assert compile_ahead.is_compiled(QUICKLY) and not compile_ahead.is_compiled(BADLY)
    assert program("-m", "pipeline.run.compile_ahead", QUICKLY) == ""  # and no second time
    assert (cache / "compiled").read_text() == "once\n"


@pytest.mark.slow
@pytest.mark.parametrize("representation", ["bases", "triplane"])
def test_training_finds_its_kernels(cache, subject, tmp_path, representation):
    code = "import sys; from pipeline.run.compile_ahead import compile_and_record as c; c(sys.argv[1])"
    program("-c", code, f"stages.train.compile_ahead:compile_{representation}")
    said = program("-c", TRAINING_STEP, str(subject), str(tmp_path / "out"), representation)
    assert float(said.split()[-1]) < 0.5
