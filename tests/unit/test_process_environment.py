"""The environment that stages' processes get."""

import os

import pytest

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


@pytest.mark.parametrize(("load", "policy"), [(0.2, None), (100.0, "PASSIVE")])
def test_waiting_threads_sleep_where_others_want_the_cores(monkeypatch, load, policy):
    monkeypatch.setattr(os, "getloadavg", lambda: (load * os.cpu_count(), 0.0, 0.0))
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert process_environment().get("OMP_WAIT_POLICY") == policy
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    assert process_environment()["OMP_WAIT_POLICY"] == "ACTIVE"
