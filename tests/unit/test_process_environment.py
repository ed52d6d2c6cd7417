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
