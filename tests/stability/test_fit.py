"""Registration of clips that say little, nothing, or the wrong thing."""

import dataclasses
import math

import numpy as np
import pytest
import roma
import torch

from pipeline.body import joint_index, pose_body
from pipeline.clip.camera import facing_camera
from pipeline.clip.keypoints import empty_keypoints
from pipeline.errors import UserError
from pipeline.finite import NotFiniteError
from stages.fit.adam import optimise
from stages.fit.objective import RegistrationObjective
from stages.fit.outlier_frames import BODY_PAIRS, mask_outlier_frames
from stages.fit.registration import register
from stages.fit.settings import FitSettings
from stages.fit.smoothing import smooth
from tests.made.detections import SIZE, make_clip, problem_of, whole_body

SHORT = FitSettings(iterations=12)
LEFT_RIGHT = [0, 4, 5, 6, 1, 2, 3, 8, 7, 10, 9] + [row + (1 if row % 2 else -1) for row in range(11, 33)]


@pytest.fixture(scope="module")
def clip(model):
    return make_clip(*model, count=3)


def changed(clip, change):
    """The clip after ``change`` of its pose points [T, 33, 4], in pixels and in metres."""
    image, world = clip.keypoints.pose_image.copy(), clip.keypoints.pose_world.copy()
    change(image, world)
    keypoints = dataclasses.replace(clip.keypoints, pose_image=image, pose_world=world)
    return dataclasses.replace(clip, keypoints=keypoints)


def scores(value, rows=slice(None), frames=slice(None)):
    def change(image, world):
        image[frames, rows, 3] = world[frames, rows, 3] = value

    return change


def only(*rows):
    def change(image, world):
        lost = [row for row in range(33) if row not in rows]
        image[:, lost, 3] = world[:, lost, 3] = 0

    return change


def one_wrist(image, world):
    only(15)(image, world)
    scores(0.0, 15, slice(1, None))(image, world)


def on_one_point(image, world):
    image[..., :2] = SIZE / 2
    world[..., :3] = 0


def on_one_pixel_each_frame(image, world):
    image[..., :2] = image[..., :2].mean(1, keepdims=True)


def wild_scores(image, world):
    rng = np.random.default_rng(0)
    image[..., 3] = rng.random(image.shape[:2])
    image[..., :2] = rng.uniform(1, SIZE - 1, image[..., :2].shape)
    world[..., 3] = 1


def mirrored_world(image, world):
    world[..., 2] *= -1


def swapped(image, world):
    image[2], world[2] = image[2, LEFT_RIGHT].copy(), world[2, LEFT_RIGHT].copy()


def one_upside_down(image, world):
    image[2, :, 1] = SIZE - image[2, :, 1]
    world[2, :, 1] *= -1


def one_nonsense(image, world):
    image[2, :, :2] = np.random.default_rng(0).uniform(1, SIZE - 1, (33, 2))
    world[2, :, :3] = np.random.default_rng(1).normal(size=(33, 3))


def one_elsewhere(image, world):
    image[2, :, :2] = 0.6 * image[2, :, :2] + [100, 5]


def upside_down(image, world):
    image[..., 1] = SIZE - image[..., 1]
    world[..., 1] *= -1


def shrunk(image, world):
    image[..., :2] = SIZE / 2 + 1e-3 * (image[..., :2] - SIZE / 2)


def on_a_line(image, world):
    image[..., 1] = SIZE / 2
    world[..., 1:3] = 0


HARD = {
    "nothing visible": scores(0.0),
    "scores of 1e-30": scores(1e-30),
    "scores just under the threshold": scores(0.3999),
    "one joint visible": only(13),
    "two joints visible": only(11, 12),
    "one wrist in one frame": one_wrist,
    "hips alone": only(23, 24),
    "all detections on one point": on_one_point,
    "each frame's detections on one point": on_one_pixel_each_frame,
    "detections on a line": on_a_line,
    "a body of a quarter pixel": shrunk,
    "random detections and scores": wild_scores,
    "depth with the wrong sign": mirrored_world,
    "left and right exchanged in a frame": swapped,
    "upside down": upside_down,
    "the person leaves and returns": scores(0.0, frames=slice(1, 2)),
    "the last frame alone is seen": scores(0.0, frames=slice(0, 2)),
}


def assert_sane(registration, cameras):
    """Finite, and the pelvis before the camera."""
    identity, poses = registration.identity, registration.poses
    for name in ("betas", "joint_offset", "face_offset"):
        assert getattr(identity, name).isfinite().all(), name
    smoothed = smooth(poses, 5)
    for found in (poses, smoothed):
        for name in ("rotation", "expression", "transl"):
            assert getattr(found, name).isfinite().all(), name
    assert identity.betas.abs().max() < 10 and identity.joint_offset.norm(dim=1).max() < 0.2
    error = registration.error[~registration.error.isnan()]
    assert error.isfinite().all()


@pytest.mark.parametrize("case", HARD)
def test_a_hard_clip_has_a_finite_fit(model, clip, case):
    hard = changed(clip, HARD[case])
    fitted = register(*model, hard.keypoints, hard.cameras, SHORT)
    assert_sane(fitted, hard.cameras)


@pytest.mark.parametrize("focal", [10.0, 100.0, 1e4, 1e5])
def test_any_focal_length_has_a_finite_fit_before_the_camera(model, clip, focal):
    cameras = dict.fromkeys(clip.cameras, facing_camera(SIZE, SIZE, focal))
    fitted = register(*model, clip.keypoints, cameras, SHORT)
    assert_sane(fitted, cameras)
    # The picture says how large the person is: the distance follows the focal length.
    assert (fitted.poses.transl[:, 2] < 0).all()
    if focal >= 100:
        expected = 3.0 * focal / (1.2 * SIZE)
        assert 0.4 * expected < float(-fitted.poses.transl[:, 2].mean()) < 2.5 * expected


@pytest.mark.parametrize(
    "change",
    [
        swapped,
        one_nonsense,
        pytest.param(one_upside_down, marks=pytest.mark.soak),
        pytest.param(one_elsewhere, marks=pytest.mark.soak),
    ],
)
def test_one_wrong_frame_does_not_move_the_body_in_any(model, change):
    """One frame in eight: before such frames were masked 140 degrees off, and 60 in all the others."""
    clip, said = make_clip(*model, count=8), []
    hard = changed(clip, change)
    settings = FitSettings(iterations=50)
    fitted = register(*model, hard.keypoints, hard.cameras, settings, log=said.append)
    assert "frame 5: left and right are exchanged" in said[0]
    pelvis = roma.rotvec_to_rotmat(fitted.poses.rotation[:, 0])
    truth = roma.rotvec_to_rotmat(clip.poses.rotation[:, 0])
    assert torch.rad2deg(roma.rotmat_geodesic_distance(pelvis, truth)).max() < 10
    assert (fitted.poses.transl - clip.poses.transl).norm(dim=1).max() < 0.05


def test_a_stretch_of_swapped_frames_is_masked_and_what_turns_round_is_not(model):
    """Up to five frames; somebody who is seen from behind from then on has turned round."""
    clip = make_clip(*model, count=16)

    def exchanged(rows):
        def change(image, world):
            image[rows], world[rows] = image[rows][:, LEFT_RIGHT], world[rows][:, LEFT_RIGHT]

        return mask_outlier_frames(changed(clip, change).keypoints)[1]

    assert exchanged(slice(0, 0)) == []
    assert exchanged(slice(4, 8)) == [7, 8, 9, 10]  # the clip's first frame is number 3
    assert exchanged(slice(0, 2)) == [3, 4]
    assert exchanged(slice(13, 16)) == [16, 17, 18]
    assert exchanged(slice(8, 16)) == []
    sparse = dataclasses.replace(clip, keypoints=make_clip(*model, count=16, gap=10).keypoints)

    def turned(image, world):
        image[4], world[4] = image[4, LEFT_RIGHT], world[4, LEFT_RIGHT]

    assert mask_outlier_frames(changed(sparse, turned).keypoints)[1] == []


def test_what_an_estimator_of_133_points_swaps_is_masked_too(model):
    clip = whole_body(make_clip(*model, count=8), *model)
    assert mask_outlier_frames(clip.keypoints)[1] == []
    points = clip.keypoints.whole_body.copy()
    pairs = [row for pair in BODY_PAIRS for row in pair]
    points[3, pairs] = points[3, [row for left, right in BODY_PAIRS for row in (right, left)]]
    keypoints, outliers = mask_outlier_frames(dataclasses.replace(clip.keypoints, whole_body=points))
    assert outliers == [6] and not keypoints.whole_body[3, 5:17, 2].any()


def test_a_person_who_leaves_and_returns_is_where_the_frames_around_say(model):
    clip = make_clip(*model, count=9)
    hard = changed(clip, scores(0.0, frames=slice(3, 6)))
    fitted = register(*model, hard.keypoints, hard.cameras, FitSettings(iterations=60))
    assert fitted.poses.valid.tolist() == [True] * 3 + [False] * 3 + [True] * 3
    transl = fitted.poses.transl
    low, high = transl[[2, 6]].amin(0) - 0.05, transl[[2, 6]].amax(0) + 0.05
    assert ((transl[3:6] >= low) & (transl[3:6] <= high)).all()


def test_what_the_detector_says_wildly_wrong_does_not_move_the_others(model):
    """One elbow thrown across the picture in every frame, with the best score."""
    clip = make_clip(*model, count=4)

    def thrown(image, world):
        image[:, 14, :2] = [3.0, 3.0]

    settings = FitSettings(iterations=25)
    right = register(*model, clip.keypoints, clip.cameras, settings)
    hard = changed(clip, thrown)
    wrong = register(*model, hard.keypoints, hard.cameras, settings)
    joints = [
        pose_body(model[0], one.identity, one.poses.rotation, one.poses.expression, one.poses.transl)[1]
        for one in (right, wrong)
    ]
    rows = [joint_index(name) for name in ("left_elbow", "left_knee", "right_knee", "head", "pelvis")]
    assert (joints[0] - joints[1])[:, rows, :2].norm(dim=-1).mean() < 0.06


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
def test_detections_that_are_not_finite_are_masked(model, clip, value):
    def change(image, world):
        image[1, 13, :2] = value
        image[2, :, 3] = value
        world[1, 12, :3] = value

    hard = changed(clip, change)
    fitted = register(*model, hard.keypoints, hard.cameras, SHORT)
    assert_sane(fitted, hard.cameras)
    assert not fitted.observations.mask[1, 13]


def test_one_frame(model):
    clip = make_clip(*model, count=1)
    fitted = register(*model, clip.keypoints, clip.cameras, SHORT)
    assert_sane(fitted, clip.cameras)
    assert smooth(fitted.poses, 5).rotation.shape == (1, 55, 3)


def test_no_frame_is_said(model, clip):
    with pytest.raises(UserError, match="holds no frame: run the ingest stage"):
        register(*model, empty_keypoints(np.zeros(0, np.int64)), clip.cameras, SHORT)


def test_tiny_and_wide_pictures(model, clip):
    for width, height in ((1, 1), (4000, 3)):
        camera = facing_camera(width, height, 1.2 * max(width, height))

        def scaled(image, world, size=(width, height)):
            image[..., :2] *= np.array(size) / SIZE

        hard = changed(clip, scaled)
        fitted = register(*model, hard.keypoints, dict.fromkeys(clip.cameras, camera), SHORT)
        assert_sane(fitted, clip.cameras)


# What is not finite stops it, with the frame


def test_a_camera_that_is_not_finite_stops_the_fit_and_is_named(model, clip):
    frame = clip.poses.frames[2]
    camera = clip.cameras[frame]
    broken = dataclasses.replace(camera, translation=camera.translation * math.nan)
    with pytest.raises(NotFiniteError, match=f"not finite at step .*frame {frame}"):
        register(*model, clip.keypoints, {**clip.cameras, frame: broken}, SHORT)


def test_a_slope_that_is_not_finite_stops_the_fit_and_is_named(model, clip, monkeypatch):
    """A loss that is finite where its slope is not: the root of nothing."""
    objective, initial, frozen = problem_of(model, clip)
    original = RegistrationObjective.__call__

    def rooted(self, parameters, robust, window=None):
        losses = original(self, parameters, robust, window)
        window = self.whole if window is None else window
        row = 2 - window.low
        if 0 <= row < len(parameters.transl):
            nothing = (parameters.transl[row] - parameters.transl[row].detach()).square().sum()
            losses["init"] = losses["init"] + nothing.sqrt()
        return losses

    monkeypatch.setattr(RegistrationObjective, "__call__", rooted)
    with pytest.raises(NotFiniteError, match=r"gradient of transl is not finite at step .*frame .*5"):
        optimise(objective, initial, 10, frozen)


def test_six_numbers_that_became_parallel_do_not_stop_the_fit(model, clip):
    """Adam moves columns freely between the phases; two that meet are no rotation any more."""
    objective, initial, frozen = problem_of(model, clip)
    spoilt = initial.detached()
    spoilt.body_pose[1, 3] = torch.tensor([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    found = optimise(objective, spoilt, 10, frozen)
    assert all(value.isfinite().all() for value in found.named().values())


# Long


@pytest.mark.soak
@pytest.mark.timeout(3000)
def test_five_thousand_frames_fit_in_bounded_memory(model):
    import resource
    import time

    clip = make_clip(*model, count=5000)
    settings = FitSettings(iterations=40)
    start = time.process_time()
    fitted = register(*model, clip.keypoints, clip.cameras, settings)
    spent = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # making the clip poses 5,000 meshes
    error = fitted.error[~fitted.error.isnan()].mean()
    print(f"5,000 frames, {spent:.0f} s of processor time, {peak:.0f} MiB at most, {error:.2f} px")
    assert_sane(fitted, clip.cameras)
    assert peak < 2000


def test_windows_bound_the_memory_of_a_long_clip(model, clip):
    """The largest tensors of a step are of a window's frames, however long the clip is."""
    settings = FitSettings(iterations=2, minibatch=4)
    long = make_clip(*model, count=24)
    seen = []
    original = RegistrationObjective.predict

    def watched(self, parameters, window):
        seen.append(len(parameters.transl))
        return original(self, parameters, window)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RegistrationObjective, "predict", watched)
        register(*model, long.keypoints, long.cameras, settings)
    assert max(seen) <= 4 + 2


def test_the_start_alone_is_finite_for_hard_clips(model, clip):
    for case in list(HARD)[::2]:
        hard = changed(clip, HARD[case])
        fitted = register(*model, hard.keypoints, hard.cameras, FitSettings(iterations=0))
        assert_sane(fitted, hard.cameras)
