"""What compiling costs is told apart from what a run costs."""

import numba
import numpy as np
import pytest

from pipeline.run.compile_timer import CompileTimer, compile_timer
from pipeline.studies.variants import cpu_seconds
from stages.train.timer import TrainingTimer


def sums(values):
    """The sum of squares by a function that calls another."""

    @numba.njit
    def square(value):
        return value * value

    @numba.njit
    def total(values):
        found = 0.0
        for value in values:
            found += square(value)
        return found

    return total(values), total


def test_only_what_is_compiled_while_it_listens_is_counted():
    with compile_timer() as timer:
        found, total = sums(np.ones(3))
        first = timer.seconds, timer.cpu_seconds
        total(np.ones(5))  # compiled already
        assert (timer.seconds, timer.cpu_seconds) == first
        total(np.ones(5, np.float32))  # not for these numbers
        assert timer.seconds > first[0] and timer.cpu_seconds > first[1]
    last = timer.seconds
    total(np.ones(5, np.int64))  # nobody listens
    assert found == 3 and min(first) > 0 and timer.seconds == last


def test_a_study_does_not_charge_its_first_run_for_compiling():
    killed_once = {"earlier_cpu_seconds": 10.0, "compile_cpu_seconds": 25.0}
    assert cpu_seconds({"cpu_seconds": 50.0, "timings": killed_once}) == 35
    assert cpu_seconds({"cpu_seconds": 50.0, "timings": {}}) == 50  # a version from before, or another stage


def test_the_training_timer_leaves_out_what_was_compiled(tmp_path):
    compiled = CompileTimer()
    timer = TrainingTimer(tmp_path, compiled)
    compiled.seconds, compiled.cpu_seconds = 50.0, 40.0  # on the way
    assert timer.now(1)[1:] == pytest.approx((-50, -40), abs=5)
    with timer.paused():
        compiled.seconds, compiled.cpu_seconds = 150.0, 140.0  # while it was only looked at
    assert timer.now(2)[1:] == pytest.approx((-50, -40), abs=5)
