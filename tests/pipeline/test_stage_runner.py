"""Stages whose code a loader has loaded: they run as any, and no process is left."""

import os
import signal
import subprocess
import sys
import time

import pytest

from pipeline.config.request import parse_request
from pipeline.run.process import INTERRUPTED, run_stage_process
from pipeline.run.stage_loader import StageLoader, can_load_ahead
from pipeline.run.stage_runner import StageRunner

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="loaders are of Linux")
TOYS = tuple(f"tests.pipeline.toy_stages.work:{name}" for name in ("bend", "paint"))


def request_of(toy, **words):
    return parse_request({"data": str(toy.data), "stages": "tests.pipeline.toy_stages", **words}, "ann")


@pytest.fixture
def loader():
    loader = StageLoader(TOYS)
    yield loader
    loader.close()
    assert not loader.alive


def test_stages_run_in_copies_of_the_loader(toy, loader):
    for stage in ("gather", "bend", "paint"):
        assert run_stage_process(stage, "ann", request_of(toy), start=loader.run) is None
        assert toy.ran() == [f"{stage}:ann"]
    painted = (toy.store / "ann" / "paint" / "latest" / "painted.txt").read_text()
    assert painted == "ann 1.0" * 3


def test_a_stage_in_a_copy_says_why_it_failed(toy, loader):
    assert "doit run gather:ann" in run_stage_process("bend", "ann", request_of(toy), start=loader.run)
    words = {"bend.fail": "killed"}
    assert run_stage_process("gather", "ann", request_of(toy), start=loader.run) is None
    reason = run_stage_process("bend", "ann", request_of(toy, **words), start=loader.run)
    assert "killed by signal 9" in reason
    assert run_stage_process("bend", "ann", request_of(toy), start=loader.run) is None  # it goes on


def test_lines_of_a_copy_go_where_those_of_a_process_go(toy, tmp_path, capfd):
    loader, log = StageLoader(TOYS), tmp_path / "log.txt"
    assert run_stage_process("gather", "ann", request_of(toy), log, loader.run) is None
    assert "gather:ann done" in log.read_text() and capfd.readouterr() == ("", "")
    assert run_stage_process("bend", "ann", request_of(toy), start=loader.run) is None
    assert "bend:ann done" in capfd.readouterr().out
    loader.close()


def test_no_process_is_forked_beside_a_gpu(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    for there in (False, True):
        monkeypatch.setattr("pipeline.run.stage_loader.GPUS", (tmp_path if there else tmp_path / "none",))
        assert can_load_ahead() is not there


def test_code_that_cannot_be_loaded_is_no_matter_until_it_is_needed(toy):
    loader = StageLoader(["no.such.module:run"])
    assert run_stage_process("gather", "ann", request_of(toy), start=loader.run) is None
    loader.close()


def test_a_loader_that_the_system_killed_is_done_without(toy, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setattr("pipeline.run.stage_loader.GPUS", ())
    runner = StageRunner(request_of(toy))
    assert runner.run("gather", "ann", TOYS) is None
    mine = ["-P", str(os.getpid()), "-f", "pipeline.run.stage_loader"]
    subprocess.run(["pkill", "-9", *mine], check=True)
    while subprocess.run(["pgrep", *mine], check=False, stdout=subprocess.DEVNULL).returncode == 0:
        time.sleep(0.02)
    assert runner.run("bend", "ann", TOYS[1:]) is None and toy.ran() == ["gather:ann", "bend:ann"]
    runner.close()


@pytest.mark.parametrize("status", [INTERRUPTED, -signal.SIGINT])
def test_a_stage_that_ctrl_c_stopped_stops_whoever_started_it(toy, status):
    """Also where the starter did not hear it itself: a run must not go on, nor call it a failure."""
    with pytest.raises(KeyboardInterrupt):
        run_stage_process("bend", "ann", request_of(toy), start=lambda *_: status)
