"""Single pictures are told from the frames of a film, and are neither followed nor smoothed."""

import dataclasses

import numpy as np
import pytest
import roma
import torch

from pipeline.body import pose_body
from pipeline.clip.clock import frame_times
from stages.fit import terms
from stages.fit.registration import paced, register
from stages.fit.settings import FitSettings
from stages.fit.smoothing import smooth, window_of
from stages.ingest.settings import IngestSettings
from stages.ingest.stills import are_stills, detects_singly
from stages.ingest.video import open_clip
from tests.made.detections import detected_poses, make_clip
from tests.made.published import simple_footage
from tests.made.videos import write_images


def walker(places):
    """A bright block at some places of a textured picture."""
    rng = np.random.default_rng(0)
    wall = rng.integers(60, 120, (240, 384, 1), np.uint8).repeat(3, axis=2)
    images = []
    for place in places:
        image = wall.copy()
        image[40:200, place : place + 64] = (230, 200, 180)
        images.append(image)
    return images


@pytest.mark.parametrize(
    ("places", "stills"),
    [
        (range(0, 288, 8), False),  # walks through the picture
        (np.random.default_rng(2).integers(100, 102, 20), False),  # hardly moves
        (np.random.default_rng(1).permutation(np.arange(0, 320, 40)), True),
    ],
)
def test_a_folder_of_pictures_is_a_film_or_not(tmp_path, places, stills):
    write_images(tmp_path, walker(places))
    clip = open_clip(tmp_path)
    assert are_stills(clip, IngestSettings()) == stills
    assert detects_singly(clip, IngestSettings(), stills) == stills
    timed = dataclasses.replace(clip, fps=30.0)
    assert not are_stills(timed, IngestSettings())  # a clock is believed


@pytest.mark.parametrize(
    ("fps", "stride", "singly"),
    [(30.0, 1, False), (30.0, 2, False), (30.0, 3, True), (60.0, 4, False), (10.0, 1, True)],
)
def test_frames_far_apart_in_time_are_detected_singly(tmp_path, fps, stride, singly):
    write_images(tmp_path, walker([1, 2]))
    clip = dataclasses.replace(open_clip(tmp_path), fps=fps)
    assert detects_singly(clip, IngestSettings(stride=stride), False) == singly


@pytest.fixture(scope="module")
def turning(model):
    """Somebody in eight pictures, turned by 45 degrees from each to the next."""
    clip = make_clip(*model, count=8)
    rotation = clip.poses.rotation.clone()
    angles = torch.arange(8) * torch.pi / 4
    rotation[:, 0] = roma.rotmat_to_rotvec(
        roma.rotvec_to_rotmat(torch.stack([0 * angles, angles, 0 * angles], 1))
    )
    return detected_poses(*model, dataclasses.replace(clip.poses, rotation=rotation), clip.cameras)


def joint_error(model, clip, fitted, poses):
    joints = pose_body(model[0], fitted.identity, poses.rotation, poses.expression, poses.transl)[1]
    return float((joints[:, :22] - clip.joints[:, :22])[..., :2].norm(dim=-1).mean())


@pytest.mark.slow
def test_eight_pictures_from_all_sides_are_fitted_as_well_as_without_smoothing(model, turning):
    settings = FitSettings(iterations=40, face="off")
    keypoints, cameras = turning.keypoints, turning.cameras
    record = dataclasses.replace(simple_footage(256, 256, 1.0, 8), fps=0.0, stills=True)
    stills, film = frame_times(keypoints.frames, record), None

    def fit(times, smoothness=1.0):
        one = dataclasses.replace(settings, smoothness=smoothness)
        return register(*model, keypoints, cameras, one, times=times)

    free, alone, together = fit(stills, 0.0), fit(stills), fit(film)
    assert window_of(settings.smoothing_seconds, stills) == 0
    smoothed = smooth(alone.poses, 0, times=stills)
    assert float(alone.error.nanmean()) < 1.1 * float(free.error.nanmean()) + 0.1
    assert joint_error(model, turning, alone, smoothed) < 1.2 * joint_error(model, turning, free, free.poses)
    assert float(together.error.nanmean()) > 2 * float(alone.error.nanmean())  # as a film it is far off


def test_priors_count_seconds_of_slow_clips_and_frames_of_fast_ones():
    for rate, step in ((60.0, 1.0), (30.0, 1.0), (15.0, 2.0), (7.5, 4.0)):
        times = np.arange(10) * 30 / rate
        np.testing.assert_allclose(np.diff(paced(times)), step)
    assert paced(np.zeros(1)).tolist() == [0.0]


def test_the_prior_costs_the_same_motion_the_same_at_any_rate():
    costs = []
    for rate in (1, 2):
        times = torch.arange(0, 20 * rate + 1, dtype=torch.float64) / rate
        place = torch.sin(times / 6)[:, None]
        velocity, acceleration = terms.velocity(place, times), terms.acceleration(place, times)
        costs.append((velocity.square().sum(), acceleration.square().mean()))
    for slow, fast in zip(*costs, strict=True):
        assert float(fast) == pytest.approx(float(slow), rel=0.05)
