"""The eyes benchmark's error measures on eyes that are known to be right, shut, or turned."""

import dataclasses
import math

import pytest
import torch

from benchmarks.eyes import eye_errors, mean_errors
from benchmarks.fit_truth import load_stage
from pipeline.body import Poses, mean_identity
from pipeline.body.eyes import shut_expressions

FRAMES = 4


@pytest.fixture(scope="module")
def stage():
    return load_stage()


@pytest.fixture(scope="module")
def true(stage):
    """Somebody who shuts both eyes in the last frame and looks 0.2 radians aside in the first."""
    shut = shut_expressions(stage.body, stage.landmarks.face_mesh).sum(0)
    rotation, expression = torch.zeros(FRAMES, 55, 3), torch.zeros(FRAMES, len(shut))
    expression[-1], rotation[0, 23:25, 1] = shut, 0.2
    return mean_identity(stage.body), Poses(
        tuple(range(FRAMES)), rotation, expression, torch.zeros(FRAMES, 3)
    )


def test_the_truth_has_no_error(stage, true):
    errors = eye_errors(stage, true, true)
    assert errors.opening == 0 and errors.gaze == pytest.approx(0, abs=1e-4)
    assert errors.in_blinks == pytest.approx(0, abs=1e-3)
    assert errors.still == pytest.approx(math.degrees(0.2) / (FRAMES - 1), rel=1e-3)


def test_eyes_that_stare_are_as_wrong_as_the_truth_moves(stage, true):
    identity, poses = true
    stare = dataclasses.replace(poses, rotation=0 * poses.rotation, expression=0 * poses.expression)
    errors = eye_errors(stage, (identity, stare), true)
    assert errors.opening == pytest.approx(1 / FRAMES, abs=1e-3)
    assert errors.in_blinks == pytest.approx(1, abs=1e-3) and errors.gaze == pytest.approx(errors.still)


def test_means_leave_out_clips_without_a_blink(stage, true):
    errors = eye_errors(stage, true, true)
    without = dataclasses.replace(errors, in_blinks=float("nan"))
    assert mean_errors([errors, without]).in_blinks == errors.in_blinks
