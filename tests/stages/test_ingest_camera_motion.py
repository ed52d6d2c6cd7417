"""Whether the camera moves, how, and how many metres that is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import empty_keypoints
from stages.ingest.cameras.background_motion import MOVING, measure_motion
from stages.ingest.cameras.choose import choose_cameras
from stages.ingest.cameras.rotation_only import (
    MOSTLY_ROTATION,
    ROTATION_ONLY,
    chain_rotations,
    unexplained_by_rotation,
)
from stages.ingest.cameras.scale import metric_scale, person_positions
from stages.ingest.detect import DetectedClip
from stages.ingest.video import Clip
from tests.made.room import (
    FOCAL,
    HEIGHT,
    MATRIX,
    WIDTH,
    camera_path,
    centres_in_first,
    film,
    person_keypoints,
    rotation_error,
)
from tests.made.videos import ingest_context

CENTRE = (WIDTH / 2, HEIGHT / 2)


def filmed(folder: Path, **path: float):
    truth = camera_path(12, **path)
    film(folder, truth)
    return truth


def test_moving_and_static_cameras_are_told_apart(tmp_path: Path) -> None:
    filmed(tmp_path / "static", sideways=0, degrees=0)
    filmed(tmp_path / "orbit")
    filmed(tmp_path / "pan", sideways=0, degrees=20)
    measured = {name: measure_motion(tmp_path / name, range(12), 25.0) for name in ("static", "orbit", "pan")}
    assert measured["static"].displacement < 0.1 * MOVING  # although the person moves
    assert measured["orbit"].moving and measured["pan"].moving


def test_a_background_without_corners_counts_as_static(tmp_path: Path) -> None:
    for kind in ("frames", "masks"):
        (tmp_path / kind).mkdir()
    for frame in range(4):
        write_frame(tmp_path / "frames", frame, np.full((60, 80, 3), 90, np.uint8))
        write_mask(tmp_path / "masks", frame, np.zeros((60, 80), np.uint8))
    motion = measure_motion(tmp_path, range(4), 25.0)
    assert not motion.moving and motion.pairs == 0 and "too few corners" in str(motion)


def test_a_camera_that_only_turns_is_followed(tmp_path: Path) -> None:
    truth = filmed(tmp_path, sideways=0, degrees=20)
    assert unexplained_by_rotation(tmp_path, range(12), 25.0, MATRIX) < ROTATION_ONLY
    rotations = chain_rotations(tmp_path, range(12), MATRIX)
    assert rotations is not None
    assert rotation_error(np.stack(rotations), truth.rotations).max() < 0.1


def sfm_scene(folder: Path, **settings: object):
    """The context of a filmed orbit, its clip, what is seen of the person, and the truth."""
    context = ingest_context(folder, None, **settings)
    truth = filmed(context.output)
    keypoints = person_keypoints(truth, 0.5)
    seconds = tuple(k / 25 for k in range(12))
    detected = DetectedClip(keypoints, seconds, WIDTH, HEIGHT, 1.0, 12, {}, 1)
    return context, Clip(Path("clip.mp4"), WIDTH, HEIGHT, 25.0, 12), detected, truth


@pytest.mark.slow
def test_a_moving_camera_is_found_in_metres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    context, clip, detected, truth = sfm_scene(tmp_path, focal=FOCAL / WIDTH)
    assert unexplained_by_rotation(context.output, range(12), 25.0, MATRIX) > ROTATION_ONLY
    chosen = choose_cameras(context, clip, detected, None)
    assert chosen.record["source"] == "sfm" and chosen.record["displacement"] > MOVING
    assert chosen.record["placed"] == 12 and chosen.record["interpolated"] == 0
    assert not (context.work / "sfm").exists()
    cameras = [chosen.cameras[frame] for frame in range(12)]
    rotations = np.stack([camera.rotation.numpy() for camera in cameras])
    translations = np.stack([camera.translation.numpy() for camera in cameras])
    assert rotation_error(rotations, truth.rotations).max() < 0.5
    there = centres_in_first(rotations, translations)[-1]
    expected = centres_in_first(truth.rotations, truth.translations)[-1]
    cosine = there @ expected / np.linalg.norm(there) / np.linalg.norm(expected)
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 2
    assert np.linalg.norm(there) == pytest.approx(np.linalg.norm(expected), rel=0.2)  # metres
    assert cameras[0].intrinsics[0, 0] == pytest.approx(FOCAL, rel=0.1)
    assert "the camera moves" in capsys.readouterr().out


@pytest.mark.slow
def test_equal_frames_give_equal_cameras(tmp_path: Path) -> None:
    found = []
    for name in ("first", "second"):
        context, clip, detected, _ = sfm_scene(tmp_path / name, cameras="sfm")
        found.append(choose_cameras(context, clip, detected, None).cameras)
    for frame in range(12):
        first, second = (cameras[frame] for cameras in found)
        assert torch.equal(first.world_to_camera, second.world_to_camera)
        assert torch.equal(first.intrinsics, second.intrinsics)


def test_turns_do_not_pass_for_an_orbit(tmp_path: Path) -> None:
    filmed(tmp_path)
    assert unexplained_by_rotation(tmp_path, range(12), 25.0, MATRIX) > MOSTLY_ROTATION


# The metric scale


def test_the_scale_is_found_from_the_person(tmp_path: Path) -> None:
    truth = camera_path(40)
    unit = 0.37  # metres
    placed, places = person_positions(
        person_keypoints(truth, 0.3), np.full((40, 2), FOCAL), np.tile(CENTRE, (40, 1))
    )
    assert len(placed) == 40
    np.testing.assert_allclose(places[:, 2].mean(), 3.0, rtol=0.1)
    found = metric_scale(truth.rotations, truth.translations / unit, places, 25.0, float("nan"))
    assert found.metres == pytest.approx(unit, rel=0.1)


def test_the_scale_keeps_the_scene_behind_the_person() -> None:
    """A camera that travels with the person would shrink the world to nothing."""
    rotations = np.stack([np.eye(3)] * 30)
    translations = np.stack([[-0.1 * k, 0.0, 0.0] for k in range(30)])
    places = np.tile([0.0, 0.0, 3.0], (30, 1))
    found = metric_scale(rotations, translations, places, 25.0, scene_depth=6.0)
    assert found.metres == pytest.approx(0.7 * 3 / 6) and "would put the scene" in found.note


def test_a_clip_without_3d_landmarks_keeps_its_unit() -> None:
    keypoints = empty_keypoints(np.arange(5))
    placed, places = person_positions(keypoints, np.full((5, 2), FOCAL), np.tile(CENTRE, (5, 1)))
    found = metric_scale(np.stack([np.eye(3)] * 5)[placed], np.zeros((5, 3))[placed], places, 25.0, 4.0)
    assert found.metres == 1.0 and "no 3D landmarks" in found.note
