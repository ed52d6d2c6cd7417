"""Stages that load their code ahead: run when it is their turn, and gone when it never comes."""

from pipeline.config.request import parse_request
from pipeline.run.process import StageProcess
from pipeline.run.stage_runner import StageRunner


def request_of(toy, **words):
    return parse_request({"data": str(toy.data), "stages": "tests.pipeline.toy_stages", **words}, "ann")


def test_a_waiting_stage_runs_when_told(toy):
    waiting = StageProcess("gather", "ann", request_of(toy), waits=True)
    assert toy.ran() == []
    assert waiting.finish() is None and toy.ran() == ["gather:ann"]


def test_a_waiting_stage_that_is_not_needed_ends_and_does_nothing(toy, capfd):
    waiting = StageProcess("gather", "ann", request_of(toy), waits=True)
    waiting.close()
    assert toy.ran() == []
    assert capfd.readouterr() == ("", "")


def test_a_waiting_stage_says_why_it_failed(toy):
    waiting = StageProcess("bend", "ann", request_of(toy), waits=True)
    assert "doit run gather:ann" in waiting.finish()


def test_stages_of_a_run_wait_for_their_turn_and_none_is_left(toy, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    runner = StageRunner(request_of(toy))
    assert runner.run("gather", "ann", "bend") is None and toy.ran() == ["gather:ann"]
    assert runner.run("bend", "ann", "paint") is None and toy.ran() == ["bend:ann"]
    runner.close()
    assert toy.ran() == []
