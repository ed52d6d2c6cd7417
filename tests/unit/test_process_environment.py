"""The environment that stages' processes get."""

import os

from pipeline.config.workspace import REPOSITORY
from pipeline.run.process import process_environment


def test_the_environment_of_the_environment_is_itself(monkeypatch):
    """A benchmark starts itself again until its environment is a stage's: that must come to an end."""
    monkeypatch.setenv("PYTHONPATH", "/somewhere")
    first = process_environment()
    assert first["PYTHONPATH"].split(os.pathsep) == [str(REPOSITORY), "/somewhere"]
    for name, value in first.items():
        monkeypatch.setenv(name, value)
    assert process_environment() == first


def test_waiting_threads_sleep_unless_the_user_says_otherwise(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert process_environment()["OMP_WAIT_POLICY"] == "PASSIVE"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    assert process_environment()["OMP_WAIT_POLICY"] == "ACTIVE"
