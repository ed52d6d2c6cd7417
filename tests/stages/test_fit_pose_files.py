"""Fits written for other programs and read back, and the start that pose files give the optimisation."""

import dataclasses
import json
import math

import numpy as np
import pytest
import roma
import torch

from pipeline.body import (
    Identity,
    Poses,
    joint_index,
    joint_transforms,
    linear_blend_skinning,
    pose_body,
    posed_joints,
    rest_joints,
    rest_vertices,
)
from pipeline.clip.camera import facing_camera, to_camera
from pipeline.clip.keypoints import empty_keypoints
from pipeline.pose_files import (
    is_official_smplx,
    read_hand_mean,
    read_smplx_json,
    tool_joints,
    write_peer_files,
)
from stages.fit.face_offset import on_skin, spread_matrix
from stages.fit.initialise_from_poses import initial_from_files
from stages.fit.observations import observe
from stages.fit.parameters import landmark_model
from stages.fit.registration import views_of
from tests.made.body import BODY_FILE
from tests.made.detections import make_clip

FRAMES = (3, 4, 7, 9)
COUNT = len(FRAMES)


def draw(*shape, seed=0, scale=1.0):
    return (scale * torch.from_numpy(np.random.default_rng(seed).normal(size=shape))).float()


@pytest.fixture(scope="module")
def identity(body):
    """Somebody with offsets everywhere, the root joint and the neck's skin included."""
    near = draw(len(body.v_template), 1, seed=1) > 1
    face = draw(len(body.v_template), 3, seed=2, scale=0.003) * near
    return Identity(draw(16, seed=3, scale=0.5), draw(55, 3, seed=4, scale=0.01), face)


@pytest.fixture(scope="module")
def poses():
    """A root that turns all the way round, and one frame that was not measured."""
    rotation = draw(COUNT, 55, 3, seed=5, scale=0.3)
    rotation[:, 0] = torch.linspace(0, 2, COUNT)[:, None] * math.pi * torch.tensor([[0.2, 0.95, 0.1]])
    transl = torch.tensor([0.2, 0.3, -3.0]) + draw(COUNT, 3, seed=6, scale=0.1)
    measured = torch.tensor([True, True, False, True])
    return Poses(FRAMES, rotation, draw(COUNT, 38, seed=7, scale=0.3), transl, measured)


@pytest.fixture(scope="module")
def moving():
    """Cameras that turn and travel."""
    still = facing_camera(320, 180, 300.0)
    turns = roma.rotvec_to_rotmat(draw(COUNT, 3, seed=8, scale=0.4))
    return {
        frame: dataclasses.replace(still, rotation=turn @ still.rotation, translation=place)
        for frame, turn, place in zip(FRAMES, turns, draw(COUNT, 3, seed=9, scale=0.2), strict=True)
    }


@pytest.fixture(scope="module")
def hand_mean():
    mean = read_hand_mean(BODY_FILE)
    assert mean.abs().max() > 0.1  # so that leaving it out is noticed
    return mean


def in_camera(cameras, points):
    return torch.stack([to_camera(cameras[frame], row) for frame, row in zip(FRAMES, points, strict=True)])


def loaded(path):
    return torch.tensor(json.loads(path.read_text()))


def as_the_tools_pose(folder, body, hand_mean, name="smplx_params"):
    """Vertices and joints in the camera, from the files alone and by the formulas of ExAvatar's tools.

    A template with face offsets, joints regressed from it plus joint_offset, whose root and locators have
    none, hands relative to the model's mean, and ``trans`` added to the posed body.
    """
    fitted = folder / "smplx_optimized"
    files = [json.loads((fitted / name / f"{frame}.json").read_text()) for frame in FRAMES]
    columns = {key: torch.tensor([file[key] for file in files]) for key in files[0]}
    hands = torch.cat([columns["lhand_pose"], columns["rhand_pose"]], 1) + hand_mean
    single = [columns[key][:, None] for key in ("jaw_pose", "leye_pose", "reye_pose")]
    rotation = torch.cat([columns["root_pose"][:, None], columns["body_pose"], *single, hands], 1)
    betas = loaded(fitted / "shape_param.json")
    expression = columns["expr"]
    assert len(betas) == 100 and expression.shape[1] == 50
    assert not betas[16:].any() and not expression[:, 38:].any()
    someone = Identity(betas[:16], torch.zeros(55, 3), loaded(fitted / "face_offset.json"))
    rest = rest_vertices(body, someone)
    joints = body.joint_regressor @ rest + loaded(fitted / "joint_offset.json")
    assert not loaded(fitted / "joint_offset.json")[0].any()
    assert loaded(fitted / "locator_offset.json").shape == (55, 3)
    assert not loaded(fitted / "locator_offset.json").any()
    moved = torch.einsum("vce,te->tvc", body.expression_directions, expression[:, :38])
    transforms = joint_transforms(rotation, joints, body.parents)
    vertices = linear_blend_skinning(transforms, body.skinning_weights, rest + moved)
    trans = columns["trans"][:, None]
    return vertices + trans, posed_joints(rotation, joints, body.parents) + trans


def test_the_tools_pose_the_same_body(tmp_path, body, identity, poses, moving, hand_mean):
    smoothed = dataclasses.replace(poses, rotation=poses.rotation * 0.9, transl=poses.transl + 0.1)
    write_peer_files(tmp_path, body, identity, poses, smoothed, moving, hand_mean)
    for name, fit in (("smplx_params", poses), ("smplx_params_smoothed", smoothed)):
        vertices, joints = pose_body(body, identity, fit.rotation, fit.expression, fit.transl)
        theirs = as_the_tools_pose(tmp_path, body, hand_mean, name)
        assert (theirs[0] - in_camera(moving, vertices)).norm(dim=-1).max() < 2e-5  # metres
        # The root joint has no offset there: it alone lies elsewhere.
        assert (theirs[1] - in_camera(moving, joints))[:, 1:].norm(dim=-1).max() < 2e-5


def test_what_was_written_is_read_back(tmp_path, body, identity, poses, moving, hand_mean):
    write_peer_files(tmp_path, body, identity, poses, poses, moving, hand_mean)
    start = read_smplx_json(tmp_path / "smplx_optimized" / "smplx_params", FRAMES, hand_mean)
    torch.testing.assert_close(start.rotation[:, 1:], poses.rotation[:, 1:], rtol=0, atol=1e-6)
    torch.testing.assert_close(start.expression[:, :38], poses.expression, rtol=0, atol=1e-6)
    joints = rest_joints(body, identity)
    joints[0] = tool_joints(body, identity)[0]
    there = posed_joints(start.rotation, joints, body.parents) + start.transl[:, None]
    _, ours = pose_body(body, identity, poses.rotation, poses.expression, poses.transl)
    assert (there - in_camera(moving, ours))[:, 1:].norm(dim=-1).max() < 1e-4  # metres


def test_cameras_are_relative_to_the_first(tmp_path, body, identity, poses, moving, hand_mean):
    write_peer_files(tmp_path, body, identity, poses, poses, moving, hand_mean)
    files = [json.loads((tmp_path / "cam_params" / f"{frame}.json").read_text()) for frame in FRAMES]
    points = draw(20, 3, seed=11)
    anchored = to_camera(moving[FRAMES[0]], points)
    for frame, file in zip(FRAMES, files, strict=True):
        there = anchored @ torch.tensor(file["R"]).mT + torch.tensor(file["t"])
        torch.testing.assert_close(there, to_camera(moving[frame], points), rtol=0, atol=1e-5)
        assert file["focal"] == [300, 300] and file["princpt"] == [160, 90]
    still = dict.fromkeys(FRAMES, moving[FRAMES[0]])
    write_peer_files(tmp_path / "still", body, identity, poses, poses, still, hand_mean)
    for frame in FRAMES:
        file = json.loads((tmp_path / "still" / "cam_params" / f"{frame}.json").read_text())
        np.testing.assert_allclose(file["R"], np.eye(3), atol=1e-6)
        np.testing.assert_allclose(file["t"], np.zeros(3), atol=1e-6)


def test_the_list_holds_measured_frames_and_equal_fits_give_equal_bytes(
    tmp_path, body, identity, poses, moving, hand_mean
):
    for name in "ab":
        write_peer_files(tmp_path / name, body, identity, poses, poses, moving, hand_mean)
    assert (tmp_path / "a" / "frame_list_all.txt").read_text() == "3\n4\n9\n"
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 3 * COUNT + 6  # body.json says whose coefficients they are
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_numbers_that_are_not_finite_are_not_written(tmp_path, body, identity, poses, moving, hand_mean):
    broken = dataclasses.replace(poses, transl=poses.transl * math.nan)
    with pytest.raises(ValueError):
        write_peer_files(tmp_path, body, identity, broken, poses, moving, hand_mean)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A clip as the registration sees it."""

    clip: object
    observations: object
    landmarks: object
    views: object


def scene_of(model, clip):
    body, landmarks = model
    views = views_of(clip.keypoints, clip.cameras)
    observations = observe(clip.keypoints, landmarks, 0.4, views.size.numpy())
    on_face = observations.of("face") & on_skin(body, observations.points)
    spread = spread_matrix(body, observations.points[on_face])
    return Scene(clip, observations, landmark_model(body, observations.points, 16, spread), views)


@pytest.fixture(scope="module")
def scene(model):
    return scene_of(model, make_clip(*model, count=4, face=True))


@pytest.fixture(scope="module")
def exported(model, scene, hand_mean, tmp_path_factory):
    """The clip's true poses as files."""
    folder, truth = tmp_path_factory.mktemp("peers"), scene.clip.poses
    mean = Identity(torch.zeros(16), torch.zeros(55, 3), torch.zeros_like(model[0].v_template))
    write_peer_files(folder, model[0], mean, truth, truth, scene.clip.cameras, hand_mean)
    return read_smplx_json(folder / "smplx_optimized" / "smplx_params", truth.frames, hand_mean)


def begin(model, scene, start, notes=None):
    note = (lambda text: None) if notes is None else notes.append
    return initial_from_files(start, model[0], scene.observations, scene.landmarks, scene.views, note)


def test_true_poses_are_the_start(model, scene, exported):
    found = begin(model, scene, exported)
    truth = scene.clip.poses
    expected = roma.rotvec_to_rotmat(truth.rotation)
    torch.testing.assert_close(found.matrices, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.transl, truth.transl, rtol=0, atol=1e-4)
    assert not found.betas.any() and not found.joint_offset.any() and not found.face_control.any()


def test_without_a_place_the_keypoints_give_one(model, scene, exported):
    found = begin(model, scene, dataclasses.replace(exported, transl=None))
    assert (found.transl - scene.clip.poses.transl).norm(dim=1).max() < 0.15  # metres, of 3


def test_a_place_of_another_camera_is_not_used(model, scene, exported):
    notes = []
    nearer = dataclasses.replace(exported, transl=exported.transl * torch.tensor([1.0, 1.0, 0.6]))
    found = begin(model, scene, nearer, notes)
    assert (found.transl - scene.clip.poses.transl).norm(dim=1).max() < 0.15
    assert sum("translations" in note for note in notes) == 1


def test_where_nothing_was_detected_the_files_place_stands(model, scene, exported):
    blank = dataclasses.replace(scene.clip, keypoints=empty_keypoints(scene.clip.keypoints.frames))
    found = begin(model, scene_of(model, blank), exported)
    torch.testing.assert_close(found.transl, scene.clip.poses.transl, rtol=0, atol=1e-4)


def test_a_moving_camera_does_not_turn_the_body(model, scene, exported):
    """Both cameras see the same, so the world differs by how they stand."""
    turn = roma.rotvec_to_rotmat(torch.tensor([0.1, 0.5, -0.2]))
    shift = torch.tensor([0.3, -0.1, 0.5])
    turned = dataclasses.replace(
        scene.views, rotation=scene.views.rotation @ turn, translation=scene.views.translation + shift
    )
    found = begin(model, dataclasses.replace(scene, views=turned), exported)
    points = scene.landmarks.posed(found, found.matrices)[0]
    assert (turned.to_pixels(turned.to_camera(points)) - scene.observations.pixels)[
        scene.observations.mask
    ].norm(dim=-1).median() < 0.5


def test_coefficients_are_used_by_the_official_body_alone(model, scene, exported):
    start = dataclasses.replace(exported, betas=torch.ones(10), expression=torch.ones(4, 10))
    notes = []
    found = begin(model, scene, start, notes)
    assert not found.betas.any() and not found.expression.any()
    assert sum("SMPL-X's" in note for note in notes) == 1
    official = official_twin(model[0])
    assert is_official_smplx(official) and not is_official_smplx(model[0])
    found = initial_from_files(start, official, scene.observations, scene.landmarks, scene.views)
    assert found.betas.tolist() == [1.0] * 10 + [0.0] * 6
    assert (found.expression[:, :10] == 1).all() and not found.expression[:, 10:].any()
    fewer = dataclasses.replace(official, expression_directions=official.expression_directions[..., :9])
    assert not is_official_smplx(fewer)


def official_twin(body):
    """A body with the official model's counts; nothing but its counts is looked at."""
    return dataclasses.replace(
        body,
        v_template=torch.zeros(10_475, 3),
        faces=torch.zeros(20_908, 3, dtype=torch.int64),
        shape_directions=torch.zeros(1).expand(10_475, 3, 300),
        expression_directions=torch.zeros(1).expand(10_475, 3, 100),
    )


def test_poses_of_other_frames_are_refused(model, scene, exported):
    with pytest.raises(ValueError, match="frames"):
        begin(model, scene, dataclasses.replace(exported, frames=(1, 2, 3, 4)))


def test_left_stays_left(model, scene, exported):
    """A mirrored convention would pass every round trip."""
    found = begin(model, scene, exported)
    joints = scene.landmarks.posed(found, found.matrices)[1]
    pixels = scene.views.to_pixels(scene.views.to_camera(joints))
    left, right = (pixels[:, joint_index(f"{side}_wrist"), 0] for side in ("left", "right"))
    assert (left > right).all()
