"""The time left that a progress display tells."""

import pytest

from pipeline.run.progress import Progress, TimeLeft


def test_equal_steps_go_on_as_they_went():
    left = TimeLeft((1.0,) * 10)
    for _ in range(4):
        left.measured(1, 2.0)
    assert left.seconds() == pytest.approx(12.0)


def test_a_phase_ahead_is_expected_to_take_its_cost():
    left = TimeLeft((1.0,) * 10 + (4.0,) * 10)
    for _ in range(5):
        left.measured(1, 0.5)
    assert left.seconds() == pytest.approx(5 * 0.5 + 10 * 2.0)


def test_a_phase_that_was_measured_goes_on_at_its_own_speed():
    left = TimeLeft((1.0,) * 10 + (4.0,) * 10)
    for _ in range(10):
        left.measured(1, 0.5)
    for _ in range(5):
        left.measured(1, 7.0)
    assert left.seconds() == pytest.approx(5 * 7.0)


def test_what_is_compiled_in_a_first_step_is_not_expected_again():
    left = TimeLeft((1.0,) * 10)
    left.measured(1, 30.0)
    assert left.seconds() is None
    left.measured(1, 0.5)
    assert left.seconds() == pytest.approx(8 * 0.5)


def test_a_run_that_goes_on_from_a_checkpoint_tells_its_own_speed(capsys):
    seconds = iter([0.0, 100.0, 101.0, 103.0, 115.0])
    progress = Progress(20, "train:me training", clock=lambda: next(seconds))
    progress.skip(10)
    for _ in range(3):
        progress.advance()
    assert "13/20, 49 s left" in capsys.readouterr().out  # (2 + 12) / 2 seconds a step, seven steps
