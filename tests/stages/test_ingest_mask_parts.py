"""Hands and feet completed: gained where the picture shows them, never lost, nothing where it does not."""

import numpy as np
import pytest

from pipeline.clip.keypoints import LEFT_HAND
from stages.ingest.mask_parts import body_parts, complete_parts

SIDE = 120
HAND = (slice(70, 90), slice(70, 84))
SKIN, WALL, SHIRT = (200, 150, 120), (40, 60, 40), (180, 140, 115)


@pytest.fixture
def picture():
    """A shirt and a hand beside it before a dark wall, with a little grain."""
    image = np.empty((SIDE, SIDE, 3), np.float32)
    image[:] = WALL
    image[20:110, 30:60] = SHIRT
    image[70:74, 56:74] = SKIN
    image[HAND] = SKIN
    grain = np.random.default_rng(0).normal(0, 4, image.shape)
    return np.clip(image + grain, 0, 255).astype(np.uint8)


@pytest.fixture
def points():
    """133 points of which those of the left hand are seen."""
    found = np.zeros((133, 3), np.float32)
    rows, columns = np.meshgrid(np.linspace(72, 88, 5), np.linspace(72, 82, 4), indexing="ij")
    fingers = np.stack([columns.T.ravel(), rows.T.ravel()], axis=1)
    found[LEFT_HAND] = np.c_[np.concatenate([[[77, 71]], fingers]), np.ones(21)]
    return found


def faint(level):
    """A mask that is sure of the shirt and has ``level`` at the hand."""
    alpha = np.zeros((SIDE, SIDE), np.float32)
    alpha[20:110, 30:60] = 1
    alpha[HAND] = level
    return alpha


def test_a_hand_that_the_mask_half_lost_is_completed(picture, points):
    found = complete_parts(faint(0.3), picture, points)
    assert (found[HAND] > 0.5).mean() > 0.95
    beside = np.ones((SIDE, SIDE), bool)
    beside[66:94, 50:88] = False
    assert np.array_equal(found[beside], faint(0.3)[beside])


def test_a_part_gains_and_never_loses(picture, points):
    for level in (0.0, 0.3, 1.0):
        assert (complete_parts(faint(level), picture, points) >= faint(level)).all()


def test_a_hand_that_the_picture_does_not_show_is_not_made(picture, points):
    picture[:, 60:] = WALL
    found = complete_parts(faint(0.0), picture, points)
    assert (found[HAND] > 0.5).mean() < 0.05


def test_the_same_picture_gives_the_same_mask(picture, points):
    first, second = (complete_parts(faint(0.3), picture, points) for _ in range(2))
    assert np.array_equal(first, second)


def test_nothing_seen_is_nothing_changed(picture):
    assert np.array_equal(complete_parts(faint(0.3), picture, np.zeros((133, 3), np.float32)), faint(0.3))


def test_a_hand_without_points_goes_on_from_the_forearm(points):
    points[:] = 0
    points[7], points[9] = (40, 40, 1), (60, 40, 1)
    (part,) = body_parts(points)
    np.testing.assert_allclose(part.points, [[60, 40], [69, 40]])


def test_points_far_outside_the_picture_are_no_trouble(picture, points):
    points[LEFT_HAND, :2] += 1e6
    assert np.array_equal(complete_parts(faint(0.3), picture, points), faint(0.3))
