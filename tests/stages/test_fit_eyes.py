"""Lids and gaze against known truth: blinks, winks, jumps of the gaze, eyes that nothing is seen of."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.body import Identity, Poses, joint_index, locate, mean_identity, pose_body, rest_vertices
from pipeline.body.eyes import eyeball, lid_directions, lid_openings, shut_expressions, with_eyeballs
from pipeline.clip.camera import facing_camera, project
from pipeline.clip.keypoints import empty_keypoints
from pipeline.numba_kernels import threads
from stages.fit.eyes import fit_eyes
from stages.fit.observations import observe
from stages.fit.parameters import EYES, landmark_model, parameters_of
from stages.fit.registration import views_of
from stages.fit.terms import tie_of_two
from tests.made.detections import load

COUNT, SIZE = 12, 512
BLINK, WINK, JUMP, RIGHT = slice(3, 5), 8, 6, 0.3
UP = torch.tensor([0.0, 1.0, 0.0])


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    with threads(1):
        yield


@pytest.fixture(scope="module")
def stage():
    return load()


@pytest.fixture(scope="module")
def true(stage):
    """Shuts both eyes in two frames and the left in one, and looks elsewhere from the sixth on."""
    shut = shut_expressions(stage[0], stage[1].face_mesh)
    rotation, expression = torch.zeros(COUNT, 55, 3), torch.zeros(COUNT, shut.shape[1])
    rotation[:, joint_index("head"), 1] = torch.linspace(-0.2, 0.2, COUNT)
    rotation[JUMP:, EYES] = torch.tensor([0.1, RIGHT, 0.0])
    expression[BLINK] = shut.sum(0)
    expression[WINK] = shut[0]
    transl = torch.tensor([0.0, -0.3, -1.0]).expand(COUNT, 3)
    return Poses(tuple(range(COUNT)), rotation, expression, transl)


def fitted(stage, true, weights=(1.0, 1.0), hidden=None, noise=0.0):
    """The eyes that are found where the fit has all but the eyes right."""
    body, landmarks = stage
    camera = facing_camera(SIZE, SIZE, 2.5 * SIZE)
    vertices, joints = pose_body(body, mean_identity(body), true.rotation, true.expression, true.transl)
    pixels = project(camera, locate(landmarks.face_mesh, joints, vertices)).numpy()
    pixels = pixels + noise * np.random.default_rng(0).standard_normal(pixels.shape)
    mesh = np.concatenate([pixels, np.zeros_like(pixels[..., :1]), np.ones_like(pixels[..., :1])], -1)
    keypoints = dataclasses.replace(empty_keypoints(np.arange(COUNT)), face_mesh=mesh.astype(np.float32))
    keypoints.pose_image[:, 0, 3] = 1e-3  # an estimator with a face mesh
    if hidden is not None:
        keypoints.face_mesh[hidden] = 0
    views = views_of(keypoints, dict.fromkeys(range(COUNT), camera))
    seen = observe(keypoints, landmarks, 0.4, views.size.numpy())
    model = landmark_model(body, seen.points, 4, torch.zeros(len(body.v_template), 0))
    start = true.rotation.clone()
    start[:, EYES] = 0
    parameters = parameters_of(start, true.transl, (4, true.expression.shape[1], 0))
    shut = shut_expressions(body, landmarks.face_mesh)
    return fit_eyes(model, seen, views, parameters, parameters.matrices, shut, weights)


def openings(stage, expression):
    """Left and right, of the opening at rest: [T, 2]."""
    body, landmarks = stage
    rest = locate(landmarks.face_mesh, torch.zeros(55, 3), body.v_template)
    opens = lid_directions(body, landmarks.face_mesh)
    return 1 + expression @ opens.mT / lid_openings(rest, UP)


def test_the_open_body_shuts_either_eye_by_itself(stage):
    shut = shut_expressions(stage[0], stage[1].face_mesh)
    torch.testing.assert_close(
        openings(stage, shut), torch.tensor([[0.0, 1.0], [1.0, 0.0]]), atol=1e-4, rtol=0
    )


def test_a_body_without_such_expressions_has_no_lids(stage):
    bare = dataclasses.replace(stage[0], expression_directions=0 * stage[0].expression_directions)
    assert not shut_expressions(bare, stage[1].face_mesh).any()


def test_blinks_of_two_frames_and_a_wink_are_found(stage, true):
    found = openings(stage, fitted(stage, true).lids)
    torch.testing.assert_close(found, openings(stage, true.expression), atol=0.12, rtol=0)


def test_the_gaze_follows_a_jump_within_its_frame(stage, true):
    gaze = fitted(stage, true).gaze
    assert (gaze - true.rotation[:, EYES]).abs()[[0, 1, 5, 6, 7, 10, 11]].max() < 0.05


def test_a_shut_eye_looks_as_in_the_frames_around(stage, true):
    gaze = fitted(stage, true).gaze
    assert gaze[BLINK].abs().max() < 0.05


def test_noise_of_open_eyes_is_no_blink(stage, true):
    still = dataclasses.replace(true, expression=0 * true.expression)
    found = openings(stage, fitted(stage, still, noise=0.7).lids)
    assert (found - 1).abs().max() < 0.25


def test_frames_without_a_face_take_their_eyes_from_those_around(stage, true):
    found = fitted(stage, true, hidden=slice(9, COUNT))
    assert (found.gaze[9:] - found.gaze[8]).abs().max() < 0.1
    assert torch.isfinite(found.lids).all()


def test_each_weight_switches_its_term_off(stage, true):
    assert fitted(stage, true, (0.0, 0.0)) is None
    lids = fitted(stage, true, (1.0, 0.0))
    assert lids.gaze is None and lids.lid_columns.any()
    gaze = fitted(stage, true, (0.0, 1.0))
    assert gaze.gaze is not None and not gaze.lid_columns.any()


def test_a_clip_without_a_face_has_no_eyes(stage, true):
    assert fitted(stage, true, hidden=slice(None)) is None


def test_the_tie_of_two_is_the_least_of_its_sum():
    seen, weight, tie = (
        torch.tensor([[0.2, 0.9]]).double(),
        torch.tensor([[3.0, 0.5]]).double(),
        torch.tensor([1.7]),
    )
    pair = tie_of_two(seen, weight, tie).requires_grad_()
    loss = (weight * (pair - seen).square()).sum() + tie * (pair[:, 0] - pair[:, 1]).square().sum()
    (slope,) = torch.autograd.grad(loss, pair)
    assert slope.abs().max() < 1e-9


def test_eyeballs_go_in_one_piece_with_their_joints_and_stay_behind_the_lids(stage):
    body, mean = stage[0], mean_identity(stage[0])
    assert torch.equal(with_eyeballs(body, mean).face_offset, mean.face_offset)
    offset = torch.zeros_like(mean.face_offset)
    offset[:, 1] = 0.003
    offset[:, 2] = 0.01 * body.v_template[:, 0].abs()
    found = with_eyeballs(body, Identity(mean.betas, mean.joint_offset, offset))
    shape = rest_vertices(body, found)
    for eye, joint in enumerate(range(EYES.start, EYES.stop)):
        ball = eyeball(body, eye)
        moved = shape[ball] - body.v_template[ball]
        assert (moved - found.joint_offset[joint]).abs().max() < 1e-6
        assert (
            moved[0, 1] == pytest.approx(0.003, abs=1e-6) and moved[0, 2] <= offset[ball][:, 2].min() + 1e-6
        )
