"""The time of frames, and how many of them a filter of some seconds sees."""

import dataclasses

import numpy as np
import pytest

from pipeline.clip.clock import BREAK, RATE, frame_times, times_of_numbers, usual_step
from pipeline.clip.records import SHOT_STEP, Footage
from stages.fit.smoothing import window_of


def footage(seconds, fps=30.0, stills=False):
    count = len(seconds)
    return Footage(
        "clip",
        64,
        64,
        fps,
        1.0,
        count,
        count,
        {},
        1,
        tuple(round(one, 6) for one in seconds),
        {},
        stills=stills,
    )


@pytest.mark.parametrize("fps", [24.0, 25.0, 30.0, 60.0])
def test_a_second_is_a_second_at_any_rate(fps):
    count = round(fps) + 1
    times = frame_times(range(count), footage(np.arange(count) / fps, fps))
    assert times[0] == 0 and times[-1] == pytest.approx(RATE, abs=0.02)
    assert usual_step(times) == pytest.approx(RATE / fps, abs=1e-3)


def test_dropped_frames_leave_a_gap_and_a_clock_that_stands_still_goes_on():
    times = frame_times([0, 1, 7, 8], footage([0.0, 1 / 30, 7 / 30, 7 / 30]))
    np.testing.assert_allclose(times[:3], [0, 1, 7], atol=1e-3)
    assert times[3] > times[2]


def test_single_pictures_and_the_cameras_of_a_rig_lie_apart():
    single = frame_times(range(4), footage(range(4), fps=0.0, stills=True))
    assert (np.diff(single) >= BREAK).all()
    film = frame_times(range(4), footage(range(4), fps=0.0))
    np.testing.assert_array_equal(film, range(4))
    rig = frame_times([0, 1, SHOT_STEP, SHOT_STEP + 1], footage([0.0, 0.04, 0.0, 0.04], fps=25.0))
    np.testing.assert_allclose(np.diff(rig), [1.2, BREAK, 1.2])
    np.testing.assert_allclose(np.diff(times_of_numbers(np.array([0, 2, SHOT_STEP]))), [2, BREAK])


@pytest.mark.parametrize(
    ("fps", "window"),
    [(24.0, 5), (25.0, 5), (29.97, 5), (30.0, 5), (60.0, 11), (120.0, 21), (15.0, 3), (12.5, 3), (7.5, 0)],
)
def test_a_filter_of_some_seconds_sees_more_frames_of_a_faster_clip(fps, window):
    times = frame_times(range(40), footage(np.arange(40) / fps, fps))
    assert window_of(0.18, times) == window
    assert window_of(0.0, times) == 0


def test_single_pictures_and_one_frame_are_not_filtered():
    assert window_of(10.0, frame_times(range(9), footage(range(9), fps=0.0, stills=True))) == 0
    assert window_of(10.0, np.zeros(1)) == 0


def test_the_record_says_it(tmp_path):
    from pipeline.clip.records import read_footage, write_footage

    for stills in (True, False):
        record = dataclasses.replace(footage([0.0, 1.0], fps=0.0), stills=stills)
        write_footage(tmp_path / "footage.json", record)
        assert read_footage(tmp_path / "footage.json").stills == stills
