"""Thresholds of visibility scores: where one is found, and where none is."""

import cv2
import numpy as np
import pytest
import torch

from pipeline.avatar.otsu_threshold import (
    LARGEST_LOSS,
    evidence_threshold,
    fixed_threshold,
    histogram,
    otsu_threshold,
    plain_threshold,
    share_below,
)
from pipeline.avatar.visibility import in_frame
from pipeline.clip.camera import facing_camera

RNG = np.random.default_rng(0)
TWO = np.repeat([0.0, 1.0], [500, 500])
UNIMODAL = {
    "normal": np.clip(RNG.normal(0.5, 0.12, 4000), 0, 1),
    "uniform": RNG.random(4000),
    "turning": np.clip(RNG.normal(0.9, 0.06, 4000), 0, 1),
    "all zero": np.zeros(500),
    "all one": np.ones(500),
    "half": np.full(500, 0.5),
}


def modes(*parts: tuple[float, int]) -> np.ndarray:
    return np.concatenate([np.full(count, value) for value, count in parts])


@pytest.mark.parametrize("scores", [RNG.random(3000), RNG.beta(0.3, 0.6, 3000), RNG.normal(0.5, 0.1, 3000)])
def test_otsu_agrees_with_opencv(scores):
    scores = scores.clip(0, 1)
    levels = np.minimum((scores * 256).astype(np.uint8), 255)[None]
    level, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_OTSU)
    # OpenCV's level is the last one of the lower class, ours is the one above it.
    assert otsu_threshold(histogram(scores))[0] == pytest.approx((level + 1) / 256, abs=1.5 / 256)


def test_otsu_takes_the_middle_of_a_gap():
    tau, separability, low = otsu_threshold(histogram(TWO))
    assert tau == pytest.approx(0.5, abs=0.01) and separability == pytest.approx(1) and low < 0.01


@pytest.mark.parametrize("name", UNIMODAL)
def test_gate_stays_open_on_one_mode(name):
    assert not evidence_threshold(UNIMODAL[name]).closed


def test_two_spikes_are_told_apart():
    found = evidence_threshold(TWO)
    assert found.closed and (found.cut, found.lost) == (0.5, 0.0)


def test_separability_of_one_mode_is_that_of_its_distribution():
    """2 / pi for a normal distribution, 3 / 4 for a uniform one: as high as that of many a pair of modes."""
    for name, expected in (("normal", 2 / np.pi), ("uniform", 0.75)):
        assert otsu_threshold(histogram(UNIMODAL[name]))[1] == pytest.approx(expected, abs=0.02)


def test_hands_that_come_and_go_stay_whatever_the_legs_do():
    """Otsu alone cuts the hands off as soon as enough legs are out of the picture."""
    for legs in (200, 2000):
        scores = modes((0.0, legs), (0.4, 100), (1.0, 400))
        found = evidence_threshold(scores)
        assert found.closed and 0 < found.tau < 0.4 and found.lost == 0
    assert found.otsu > 0.4 and share_below(scores, found.otsu)[1] == pytest.approx(40 / 440)


def test_three_modes_are_cut_under_the_lowest_valley():
    scores = modes((0.0, 260), (0.45, 250), (1.0, 490))
    found = evidence_threshold(scores)
    assert found.closed and found.cut == pytest.approx(0.26) and found.lost == 0


def test_close_up_of_a_face_is_gated():
    scores = modes((0.0, 970), (1.0, 30))
    assert evidence_threshold(scores).closed


def test_what_one_frame_in_a_hundred_shows_is_below_the_threshold():
    scores = modes((0.0, 300), (0.01, 100), (1.0, 600))
    found = evidence_threshold(scores)
    assert found.tau > 0.01 and found.lost == pytest.approx(1 / 601)
    many = modes((0.0, 300), (0.3, 100), (1.0, 600))
    assert evidence_threshold(many).tau <= 0.3


@pytest.mark.parametrize("seed", range(8))
def test_a_threshold_never_takes_more_than_it_may(seed):
    rng = np.random.default_rng(seed)
    scores = np.concatenate([rng.beta(*rng.uniform(0.2, 4, 2), rng.integers(1, 800)) for _ in range(3)])
    found = evidence_threshold(scores)
    if found.closed:
        assert share_below(scores, found.tau) == (found.cut, found.lost)
        assert found.lost <= LARGEST_LOSS and found.cut >= 0.05
    missing = float(scores[scores < 0.4].sum() / scores.sum())
    assert fixed_threshold(scores, 0.4).lost == pytest.approx(missing)


def test_in_frame_is_inside_the_picture_and_before_the_camera():
    camera = facing_camera(40, 20, 40.0)
    points = torch.tensor(
        [[0.0, 0, -1], [0.45, 0, -1], [0.55, 0, -1], [0, 0.3, -1], [0, 0, 1], [0, 0, -0.1], [0, 0, 0]]
    )
    assert in_frame(camera, points).tolist() == [True, True, False, False, False, False, False]


def test_plain_threshold_cuts_whatever_lies_under_it():
    scores = np.concatenate([np.linspace(0, 1, 500), np.full(500, 1.0)])
    assert not evidence_threshold(scores).closed
    found = plain_threshold(scores)
    assert (
        found.closed and found.tau == found.otsu and found.cut == pytest.approx((scores < found.tau).mean())
    )
    assert not plain_threshold(np.ones(50)).closed
