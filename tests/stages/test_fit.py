"""Registration on clips whose truth is known, and the stage's files."""

import dataclasses
import math

import numpy as np
import pyarrow.parquet as pq
import pytest
import roma
import torch
import trimesh

from pipeline.body import joint_index, pose_body, read_identity, read_poses, rest_vertices
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import write_keypoints
from pipeline.clip.records import Footage, write_cameras, write_footage
from pipeline.errors import UserError
from stages.fit.adam import optimise
from stages.fit.registration import register
from stages.fit.run import run
from stages.fit.settings import FitSettings
from tests.made.context import stage_context
from tests.made.detections import QUICK, SIZE, make_clip, problem_of, true_poses, whole_body

LEFT_ARM = ("left_shoulder", "left_elbow", "left_wrist")


@pytest.fixture(scope="module")
def clip(model):
    return make_clip(*model)


@pytest.fixture(scope="module")
def masked(clip):
    """The right arm is never seen, and in one frame nothing is."""
    pose = clip.keypoints.pose_image.copy()
    pose[:, [14, 16, 18, 20, 22], 3] = 0.1
    pose[3, :, 3] = 0.1
    world = clip.keypoints.pose_world.copy()
    world[..., 3] = pose[..., 3]
    keypoints = dataclasses.replace(clip.keypoints, pose_image=pose, pose_world=world)
    return dataclasses.replace(clip, keypoints=keypoints)


@pytest.fixture(scope="module")
def fitted(model, masked):
    return register(*model, masked.keypoints, masked.cameras, QUICK)


def joints_of(model, registration):
    poses = registration.poses
    return pose_body(model[0], registration.identity, poses.rotation, poses.expression, poses.transl)[1]


def test_known_pose_is_recovered(model, masked, fitted):
    assert fitted.error[~fitted.error.isnan()].mean() < 1.0  # pixels; the person is some 200 tall
    names = (*LEFT_ARM, "head", "left_hip", "right_hip", "left_knee", "right_ankle")
    rows = [joint_index(name) for name in names]
    away = joints_of(model, fitted)[:, rows] - masked.joints[:, rows]
    across = away[[0, 1, 2, 4, 5]][..., :2].norm(dim=-1)
    assert across.mean() < 0.03
    assert across.max() < 0.10


def test_never_seen_hands_and_arm_stay_where_they_started(fitted):
    rotation = fitted.poses.rotation
    assert (rotation[:, 25:] == 0).all()
    for name in ("right_elbow", "right_wrist", "jaw", "left_eye"):
        assert (rotation[:, joint_index(name)] == 0).all(), name
    assert (fitted.poses.expression == 0).all()
    shoulder = rotation[:, joint_index("right_shoulder")]
    torch.testing.assert_close(shoulder, torch.tensor([0.0, 0.0, 1.1]).expand_as(shoulder), atol=1e-6, rtol=0)


def test_frame_without_keypoints_lies_between_its_neighbours(model, masked, fitted):
    assert fitted.error[3].isnan().all()
    for values in (fitted.poses.rotation, fitted.poses.transl, fitted.poses.expression):
        assert torch.isfinite(values).all()
    moved = joints_of(model, fitted)
    between = (moved[2] + moved[4]) / 2
    assert (moved[3] - between)[:22].norm(dim=-1).max() < 0.03


def test_clip_without_any_keypoint_stays_finite(model, clip):
    keypoints = dataclasses.replace(
        clip.keypoints, pose_image=0 * clip.keypoints.pose_image, pose_world=0 * clip.keypoints.pose_world
    )
    fitted = register(*model, keypoints, clip.cameras, FitSettings(iterations=3))
    assert torch.isfinite(fitted.poses.transl).all() and (fitted.poses.transl[:, 2] < 0).all()
    assert (fitted.identity.betas == 0).all()


def test_equal_input_gives_equal_parameters(model, masked):
    settings = FitSettings(iterations=12)
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            results.append(register(*model, masked.keypoints, masked.cameras, settings))
        finally:
            torch.set_num_threads(before)
    first, second = results
    assert torch.equal(first.poses.rotation, second.poses.rotation)
    assert torch.equal(first.poses.transl, second.poses.transl)
    assert torch.equal(first.identity.face_offset, second.identity.face_offset)


def test_body_seen_from_behind_turns_through_pi(model, clip):
    """Root rotations of the start lie on both sides of pi; matrices have no seam there."""
    objective, initial, frozen = problem_of(model, clip)
    away = torch.zeros(6, 55, 3)
    away[:, 0, 1] = torch.linspace(-0.05, 0.05, 6)
    flip = roma.rotvec_to_rotmat(torch.tensor([0.0, math.pi, 0.0])) @ roma.rotvec_to_rotmat(away)
    matrices = initial.matrices.clone()
    matrices[:, 0] = flip[:, 0] @ matrices[:, 0]
    found = optimise(objective, initial.with_matrices(matrices), 30, frozen)
    for value in found.named().values():
        assert torch.isfinite(value).all()
    assert roma.rotmat_geodesic_distance(found.matrices[1:, 0], found.matrices[:-1, 0]).max() < 0.5


@pytest.mark.parametrize("count", [1, 2])
def test_shortest_clips(model, count):
    clip = make_clip(*model, count=count)
    fitted = register(*model, clip.keypoints, clip.cameras, QUICK)
    assert len(fitted.poses) == count
    assert fitted.error[~fitted.error.isnan()].mean() < 1.5


def test_dropped_frames_do_not_matter_to_a_steady_motion(model):
    clip = make_clip(*model, count=4, gap=7)
    fitted = register(*model, clip.keypoints, clip.cameras, QUICK)
    assert fitted.poses.frames == (3, 10, 17, 24)
    assert fitted.error[~fitted.error.isnan()].mean() < 1.5


def test_face_points_replace_those_of_the_pose(model):
    clip = make_clip(*model, count=2, face=True)
    fitted = register(*model, clip.keypoints, clip.cameras, QUICK)
    face = fitted.observations.of("face")
    assert fitted.observations.mask[:, :11].sum() == 0
    assert fitted.observations.mask[:, face].float().mean() > 0.9
    assert fitted.error[:, face].nanmean() < 1.0


def test_whole_body_points_alone_are_enough(model, clip):
    alone = whole_body(clip, *model)
    fitted = register(*model, alone.keypoints, alone.cameras, QUICK)
    error = fitted.error[:, fitted.observations.of("body")]
    assert error[~error.isnan()].mean() < 2.0


def test_expressions_are_as_many_as_the_setting_says(model):
    clip = make_clip(*model, count=2, face=True)
    fitted = register(*model, clip.keypoints, clip.cameras, FitSettings(iterations=1, expressions=7))
    assert fitted.poses.expression.shape == (2, 7)
    posed = pose_body(
        model[0], fitted.identity, *(getattr(fitted.poses, n) for n in ("rotation", "expression", "transl"))
    )
    assert torch.isfinite(posed[0]).all()


def test_whole_body_points_alone_have_a_face_to_align_with(model):
    """L_sface is active, and the face counts as registered, without any face mesh."""
    near = dataclasses.replace(make_clip(*model, count=4), poses=true_poses((3, 4, 5, 6), distance=1.6))
    alone = whole_body(near, *model)
    said, losses = [], []
    for weight in (1.0, 0.0):
        settings = FitSettings(iterations=2, lambda_sface=weight)
        fitted = register(*model, alone.keypoints, alone.cameras, settings, log=said.append)
        losses.append([value for _, name, value in fitted.curve.rows if name == "loss"][-1])
    assert fitted.face_frames == 4 and "(points): fitted in 4 of 4" in said[0]
    assert losses[0] > losses[1]


def test_camera_of_its_own_moves_the_world_not_the_picture(model, clip):
    """A calibrated camera may stand anywhere: the fit is the same one, seen from there."""
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    shift = torch.tensor([0.4, -0.2, 1.0])
    moved = {
        frame: dataclasses.replace(camera, rotation=camera.rotation @ turn, translation=shift)
        for frame, camera in clip.cameras.items()
    }
    few = FitSettings(iterations=40)
    here = register(*model, clip.keypoints, clip.cameras, few)
    there = register(*model, clip.keypoints, moved, few)
    camera = moved[clip.poses.frames[0]]
    seen = joints_of(model, there) @ camera.rotation.mT + shift
    expected = joints_of(model, here) * torch.tensor([1.0, -1.0, -1.0])
    assert (seen - expected).norm(dim=-1).mean() < 0.03


def test_missing_camera_is_said(model, clip):
    cameras = dict(list(clip.cameras.items())[1:])
    with pytest.raises(UserError, match="no camera for frame 3"):
        register(*model, clip.keypoints, cameras, FitSettings(iterations=1))


@pytest.fixture
def ingest(tmp_path, model):
    folder = tmp_path / "ingest"
    for name in ("frames", "masks"):
        (folder / name).mkdir(parents=True)
    clip = make_clip(*model, count=2)
    write_keypoints(folder / "keypoints.parquet", clip.keypoints)
    write_cameras(folder / "cameras.parquet", clip.cameras)
    write_footage(
        folder / "footage.json",
        Footage("clip.mp4", SIZE, SIZE, 25.0, 1.0, 2, 2, {}, 1, (0.0, 0.04), {"keypoints": "x"}),
    )
    for frame in clip.poses.frames:
        write_frame(folder / "frames", frame, np.full((SIZE, SIZE, 3), 40, np.uint8))
        write_mask(folder / "masks", frame, np.zeros((SIZE, SIZE), np.uint8))
    return folder


def test_stage_publishes_its_files_twice_alike(tmp_path, model, ingest):
    contexts = [
        stage_context("fit", FitSettings(iterations=5), tmp_path / name, {"ingest": ingest})
        for name in ("a", "b")
    ]
    for context in contexts:
        run(context)
    files = sorted(path.name for path in contexts[0].output.iterdir())
    assert files == [
        "curve.parquet", "face.json", "fit_quality.parquet", "identity.safetensors", "overlay.mp4",
        "overlay.png", "poses.parquet", "poses_raw.parquet", "residuals.parquet", "template.ply",
    ]  # fmt: skip
    for name in files:
        first, second = ((context.output / name).read_bytes() for context in contexts)
        assert first == second, name
    body, output = model[0], contexts[0].output
    identity, poses = (
        read_identity(output / "identity.safetensors", body),
        read_poses(output / "poses.parquet"),
    )
    assert poses.frames == (3, 4)
    mesh = trimesh.load(output / "template.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, rest_vertices(body, identity).numpy(), atol=1e-6)
    table = pq.read_table(output / "residuals.parquet").to_pydict()
    assert set(table["frame"]) == {3, 4} and set(table["group"]) == {"body"}
    rows = list(zip(table["frame"], table["point"], strict=True))
    assert len(set(rows)) == len(rows) > 40  # a row a keypoint
    assert all(0 <= pixels < 100 for pixels in table["pixels"])
    assert "body" in contexts[0].logged[-1]
