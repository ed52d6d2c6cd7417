"""Where keypoints lie on the open body."""

import numpy as np
import pytest
import torch

from pipeline.body import (
    joint_index,
    load_body,
    load_landmarks,
    locate,
    mean_identity,
    part_labels,
    pose_body,
    vertex_normals,
)
from pipeline.body.landmarks import SIZES, join, landmarks_file
from pipeline.body.parts import PARTS
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from tests.made.fake_body import write_official

FOLDER = REPOSITORY / "data/body"

# Pairs that swap under mirroring: COCO's order alternates left and right, MediaPipe's too after the nose.
COCO_BODY = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]
FEET = [3, 4, 5, 0, 1, 2]
IBUG = [
    *range(16, -1, -1), *range(26, 16, -1), 27, 28, 29, 30, 35, 34, 33, 32, 31, 45, 44, 43, 42, 47, 46,
    39, 38, 37, 36, 41, 40, 54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65,
]  # fmt: skip
MEDIAPIPE_POSE = [0, 4, 5, 6, 1, 2, 3, *(k + 1 if k % 2 else k - 1 for k in range(7, 33))]
HANDS = [*range(21, 42), *range(21)]


@pytest.fixture(scope="module")
def places(body, landmarks):
    """Each set's places in T pose: name -> [K, 3]."""
    joints = body.joint_regressor @ body.v_template
    return {name: locate(getattr(landmarks, name), joints, body.v_template) for name in SIZES}


def test_sets_are_complete_and_index_the_body(body, landmarks):
    triangles = {tuple(sorted(face)) for face in body.faces.tolist()}
    for name, count in SIZES.items():
        points = getattr(landmarks, name)
        assert len(points) == count
        surface = points.joint < 0
        assert (points.barycentrics[surface] >= 0).all()
        torch.testing.assert_close(points.barycentrics[surface].sum(1), torch.ones(int(surface.sum())))
        for corners in points.vertices[surface].tolist():
            assert len(set(corners)) == 1 or tuple(sorted(corners)) in triangles


def test_left_mirrors_right(places):
    pairs = {
        "whole_body": COCO_BODY + [17 + k for k in FEET] + [23 + k for k in IBUG] + [91 + k for k in HANDS],
        "pose": MEDIAPIPE_POSE,
        "hands": HANDS,
    }
    for name, mirror in pairs.items():
        assert sorted(mirror) == list(range(SIZES[name]))
        error = places[name] - places[name][mirror] * torch.tensor([-1.0, 1, 1])
        assert error.norm(dim=1).max() < 2e-3, (name, error.norm(dim=1).argmax())


def test_face_mesh_is_symmetric_and_outside(body, landmarks, places):
    mesh = places["face_mesh"][:468]
    mirrored = torch.cdist(mesh * torch.tensor([-1.0, 1, 1]), mesh).min(1).values
    assert mirrored.max() < 2e-3
    at_vertices = vertex_normals(body.v_template, body.faces)
    normals = locate(landmarks.face_mesh, torch.zeros(55, 3), at_vertices)[:468]
    head = torch.tensor([0.0, 0.32, 0.02])
    outward = torch.nn.functional.normalize(mesh - head, dim=1)
    assert ((normals * outward).sum(1) > -0.2).float().mean() > 0.98, "none lies inside the head"


def test_face_points_stand_in_the_order_of_a_face(places):
    mesh = places["face_mesh"]
    midline = mesh[[10, 151, 9, 168, 6, 4, 2, 0, 13, 14, 17, 152]]
    assert midline[:, 0].abs().max() < 1e-3 and (midline[:-1, 1] >= midline[1:, 1]).all()
    assert mesh[:468, 2].argmax() in (1, 4), "the nose is foremost"
    across = mesh[[234, 33, 133, 362, 263, 454], 0]
    assert (across[1:] > across[:-1]).all()
    for pupil, corners in ((468, (33, 133)), (473, (362, 263))):
        assert mesh[corners[0], 0] < mesh[pupil, 0] < mesh[corners[1], 0]
        ring = mesh[pupil + 1 : pupil + 5, :2] - mesh[pupil, :2]
        assert ring[0, 0] > 0.004 and ring[1, 1] > 0.004 and ring[2, 0] < -0.004 and ring[3, 1] < -0.004


def test_lips_part_when_the_jaw_opens(body, landmarks):
    rotation = torch.zeros(1, 55, 3)
    rotation[0, joint_index("jaw"), 0] = 0.3
    expression = torch.zeros(1, body.expression_directions.shape[2])
    vertices, joints = pose_body(body, mean_identity(body), rotation, expression, torch.zeros(1, 3))
    mesh = locate(landmarks.face_mesh, joints, vertices)[0]
    rest = locate(landmarks.face_mesh, joints[0], body.v_template)
    assert (rest[13] - rest[14]).norm() < 0.004 and (mesh[13] - mesh[14]).norm() > 0.02
    assert (mesh[[0, 13, 4]] - rest[[0, 13, 4]]).norm(dim=1).max() < 2e-3, "the upper lip stays"
    assert ((rest - mesh)[[14, 17, 152], 1] > 0.015).all(), "the lower lip and the chin go down"


def test_points_lie_on_the_parts_that_they_name(body, landmarks, places):
    labels = part_labels(body).long()
    hands = landmarks.hands
    tips = [4, 8, 12, 16, 20]
    assert {PARTS[k] for k in labels[hands.vertices[tips, 0]].tolist()} == {"left_hand"}
    assert {PARTS[k] for k in labels[hands.vertices[[21 + t for t in tips], 0]].tolist()} == {"right_hand"}
    lengths = (places["hands"][[8, 12, 16, 20]] - places["hands"][0]).norm(dim=1)
    assert ((lengths > 0.13) & (lengths < 0.23)).all()
    whole = places["whole_body"]
    left_foot, ankle = whole[17:20], whole[15]
    assert (left_foot[:2, 2] > ankle[2] + 0.1).all() and left_foot[2, 2] < ankle[2]
    assert left_foot[1, 0] > left_foot[0, 0] + 0.05, "the small toe is outside the big one"
    assert whole[3, 0] > whole[1, 0] and whole[3, 2] < whole[1, 2] - 0.05, "ears are beside and behind eyes"


def test_sets_agree_with_each_other(places):
    torch.testing.assert_close(places["whole_body"][91:], places["hands"])
    torch.testing.assert_close(places["whole_body"][23 + 30], places["face_mesh"][4])
    coco_to_pose = {5: 11, 6: 12, 7: 13, 9: 15, 11: 23, 13: 25, 15: 27, 3: 7, 0: 0}
    for coco, pose in coco_to_pose.items():
        torch.testing.assert_close(places["whole_body"][coco], places["pose"][pose])


def test_compact_sets_give_the_same_places(body, landmarks):
    points = join(landmarks.whole_body, landmarks.face_mesh)
    ids, compact = points.compact()
    rotation = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 55, 3)) * 0.3).float()
    expression = torch.zeros(2, body.expression_directions.shape[2])
    vertices, joints = pose_body(body, mean_identity(body), rotation, expression, torch.zeros(2, 3))
    assert len(ids) < 2000
    torch.testing.assert_close(locate(compact, joints, vertices[:, ids]), locate(points, joints, vertices))


def test_locate_passes_gradients(body, landmarks):
    vertices = body.v_template.clone().requires_grad_()
    joints = torch.zeros(55, 3, requires_grad=True)
    locate(landmarks.whole_body, joints, vertices).sum().backward()
    assert joints.grad[joint_index("left_wrist")].sum() > 0
    assert (vertices.grad != 0).any(1).sum() > 50


def test_a_body_without_landmarks_names_the_tool(tmp_path):
    other = load_body(write_official(tmp_path / "b.npz"))
    with pytest.raises(UserError, match="tools/build_landmarks.py"):
        load_landmarks(other, FOLDER)


def test_damaged_landmarks_are_refused(body, tmp_path):
    whole = landmarks_file(body, FOLDER)
    path = landmarks_file(body, tmp_path)
    path.write_bytes(whole.read_bytes()[:1000])
    with pytest.raises(UserError, match="cannot be read as landmarks"):
        load_landmarks(body, tmp_path)
    arrays = dict(np.load(whole))
    arrays["pose_vertices"] = arrays["pose_vertices"] + len(body.v_template)
    np.savez(path, **arrays)
    with pytest.raises(UserError, match="indices that the body has not"):
        load_landmarks(body, tmp_path)
