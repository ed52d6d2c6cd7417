"""The filming benchmark's takes: what a camera does to pictures, and how gains are told."""

import dataclasses

import numpy as np
import pytest

from benchmarks.filming import headline
from benchmarks.takes import GOOD, TAKES, Take, exposed_ticks, seen_from, through_the_camera
from pipeline.clip.camera import facing_camera

ROOM = np.random.default_rng(0).uniform(40, 200, (48, 64, 3)).astype(np.float32)


def test_the_good_take_leaves_pictures_as_they_are():
    assert np.abs(through_the_camera(ROOM, TAKES[GOOD], 3) - ROOM).max() <= 0.5


@pytest.mark.parametrize("name", ["dim", "exposure drifts", "held in the hand", "small file"])
def test_a_worse_take_changes_them_and_equal_ones_give_equal_bytes(name):
    first, again = (through_the_camera(ROOM, TAKES[name], 7) for _ in range(2))
    assert first.dtype == np.uint8 and np.array_equal(first, again)
    assert np.abs(first - ROOM).mean() > 1


def test_noise_has_the_deviation_that_is_said():
    grey = np.full((96, 96, 3), 128, np.float32)
    assert through_the_camera(grey, Take(noise=8.0), 0).std() == pytest.approx(8, rel=0.1)


def test_a_shutter_exposes_as_many_ticks_as_the_motion_is_fast():
    assert [*exposed_ticks(Take(), 2)] == [12]
    assert [*exposed_ticks(Take(pace=3, shutter=1 / 30), 1)] == [18, 19, 20, 21, 22, 23]


def test_twice_as_far_is_half_as_large():
    camera = facing_camera(100, 80, 120.0)
    far = seen_from(camera, 2.0)
    assert far.intrinsics[0, 0] == 60 and far.intrinsics[0, 2] == camera.intrinsics[0, 2]


def test_the_headline_is_the_gain_over_the_good_take_of_the_same_person():
    rows = [
        {"person": person, "take": take, "front": front, "turned": front - 1}
        for person, take, front in ((1, GOOD, 20), (1, "dim", 19), (4, GOOD, 30), (4, "dim", 28))
    ]
    assert "dim -1.5 / -1.5 dB" in headline(rows)


def test_every_take_but_another_day_differs_in_one_thing():
    good = dataclasses.asdict(TAKES[GOOD])
    for name, take in TAKES.items():
        changed = {field for field, value in dataclasses.asdict(take).items() if value != good[field]}
        assert len(changed) == (0 if name == GOOD else 2 if name == "fast, blurred" else 1), name
