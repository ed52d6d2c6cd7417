"""Posing against an independent formulation: homogeneous matrices multiplied down the tree, in scipy."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.body import (
    expression_offsets,
    joint_index,
    joint_orientations,
    joint_transforms,
    linear_blend_skinning,
    load_body,
    mean_identity,
    pose_body,
    pose_offsets,
    posed_joints,
    rest_joints,
    rest_vertices,
)
from tests.made.fake_body import write_official


@pytest.fixture
def fake(tmp_path):
    """A tiny body with pose correctives, in double precision."""
    return load_body(write_official(tmp_path / "b.npz")).to(torch.float64)


def draw(shape, scale=1.0, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape) * scale)


def homogeneous(rotation, joints, parents):
    """World matrices [55, 4, 4] by recursion from each joint to the root."""

    def world(j):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(rotation[j]).as_matrix()
        local[:3, 3] = joints[j] - (joints[parents[j]] if parents[j] >= 0 else 0)
        return world(parents[j]) @ local if parents[j] >= 0 else local

    return np.stack([world(j) for j in range(len(parents))])


def skin_slowly(rotation, joints, parents, weights, points):
    """Each point through each joint's matrix, minus that joint's rest matrix, then the weighted sum."""
    world = homogeneous(rotation, joints, parents)
    rest = homogeneous(np.zeros_like(rotation), joints, parents)
    carried = []
    for point, row in zip(points, weights, strict=True):
        there = [m @ np.linalg.inv(r) @ np.append(point, 1) for m, r in zip(world, rest, strict=True)]
        carried.append(row @ np.stack(there)[:, :3])
    return np.stack(carried)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_skinning_equals_the_independent_formulation(body, seed):
    rotation = draw((2, 55, 3), 0.6, seed)
    joints = rest_joints(body, mean_identity(body)).double()
    some = torch.arange(0, len(body.v_template), 97)
    weights, points = body.skinning_weights[some].double(), body.v_template[some].double()
    skinned = linear_blend_skinning(joint_transforms(rotation, joints, body.parents), weights, points)
    for frame in range(2):
        arguments = (rotation[frame].numpy(), joints.numpy(), body.parents)
        np.testing.assert_allclose(
            skinned[frame], skin_slowly(*arguments, weights.numpy(), points.numpy()), atol=1e-12
        )
        world = homogeneous(*arguments)
        np.testing.assert_allclose(
            posed_joints(rotation, joints, body.parents)[frame], world[:, :3, 3], atol=1e-12
        )
        np.testing.assert_allclose(
            joint_orientations(rotation, body.parents)[frame], world[:, :3, :3], atol=1e-12
        )


def test_zero_pose_is_the_template(body):
    expressions = torch.zeros(3, body.expression_directions.shape[2])
    vertices, joints = pose_body(
        body, mean_identity(body), torch.zeros(3, 55, 3), expressions, torch.zeros(3, 3)
    )
    torch.testing.assert_close(vertices, body.v_template.expand(3, -1, -1), atol=1e-6, rtol=0)
    torch.testing.assert_close(joints[1], body.joint_regressor @ body.v_template, atol=1e-6, rtol=0)


def test_global_orientation_turns_the_body_about_its_pelvis(fake):
    rotation = torch.zeros(1, 55, 3, dtype=torch.float64)
    rotation[0, 0] = torch.tensor([0.3, -1.1, 0.4])
    transl = torch.tensor([[0.5, 0.1, -2.0]], dtype=torch.float64)
    vertices, joints = pose_body(fake, mean_identity(fake), rotation, draw((1, 5)), transl)
    rest = rest_vertices(fake, mean_identity(fake)) + expression_offsets(fake, draw((1, 5)))
    pelvis = rest_joints(fake, mean_identity(fake))[0]
    turn = torch.from_numpy(Rotation.from_rotvec(rotation[0, 0].numpy()).as_matrix())
    torch.testing.assert_close(vertices, (rest - pelvis) @ turn.mT + pelvis + transl)
    torch.testing.assert_close(joints[0, 0], pelvis + transl[0])


def test_a_bent_elbow_leaves_the_other_side_alone(body):
    rotation = torch.zeros(1, 55, 3)
    rotation[0, joint_index("left_elbow"), 1] = -1.5  # forwards
    joints = rest_joints(body, mean_identity(body))
    moved = posed_joints(rotation, joints, body.parents)[0]
    wrist = joint_index("left_wrist")
    assert moved[wrist, 2] > joints[wrist, 2] + 0.2
    others = [j for j, name in enumerate(body.joint_names) if not name.startswith("left_")]
    torch.testing.assert_close(moved[others], joints[others])


def test_pose_correctives_are_linear_in_the_rotation_matrices(fake):
    rotation = draw((55, 3), 0.5)
    matrices = Rotation.from_rotvec(rotation[1:].numpy()).as_matrix() - np.eye(3)
    expected = fake.pose_directions.numpy() @ matrices.ravel()
    np.testing.assert_allclose(pose_offsets(fake, rotation), expected, atol=1e-12)


def test_identity_moves_vertices_and_joints_as_the_paper_says(fake):
    identity = dataclasses.replace(
        mean_identity(fake),
        betas=draw(4),
        joint_offset=draw((55, 3), 0.1, 1),
        face_offset=draw((24, 3), 0.1, 2),
    )
    blend = np.einsum("vck,k->vc", fake.shape_directions[..., :4].numpy(), identity.betas.numpy())
    shaped = fake.v_template.numpy() + blend
    np.testing.assert_allclose(rest_vertices(fake, identity), shaped + identity.face_offset.numpy())
    np.testing.assert_allclose(
        rest_joints(fake, identity), fake.joint_regressor.numpy() @ shaped + identity.joint_offset.numpy()
    )


def test_too_many_coefficients_are_an_error(fake):
    with pytest.raises(ValueError, match="101 coefficients, but the body has 100"):
        expression_offsets(fake, torch.zeros(101, dtype=torch.float64))


@pytest.mark.parametrize("scale", [0.0, 0.7])
def test_gradients_of_a_pose(fake, scale):
    identity = mean_identity(fake)
    rotation = (draw((1, 55, 3), scale) if scale else torch.zeros(1, 55, 3).double()).requires_grad_()

    def posed(r, joints):
        return linear_blend_skinning(
            joint_transforms(r, joints, fake.parents), fake.skinning_weights[:2], fake.v_template[:2]
        )

    joints = rest_joints(fake, identity)
    if scale:
        inputs = (rotation, joints.clone().requires_grad_())
        assert torch.autograd.gradcheck(posed, inputs, fast_mode=True)
    else:  # roma's first-order branch: finite differences leave it, so only the value is compared
        (gradient,) = torch.autograd.grad(posed(rotation, joints).sum(), rotation)
        nudge = torch.zeros_like(rotation)
        nudge[0, 18, 1] = 1e-4
        with torch.no_grad():
            slope = (posed(nudge, joints).sum() - posed(-nudge, joints).sum()) / 2e-4
        torch.testing.assert_close(gradient[0, 18, 1], slope, atol=1e-6, rtol=1e-5)


def test_gradients_of_an_identity(fake):
    identity = mean_identity(fake)
    arguments = [draw(3), draw((55, 3), 0.1)[:2], draw((1, 4))]

    def vertices(betas, two_offsets, expression):
        offsets = torch.cat([two_offsets, identity.joint_offset[2:]])
        who = dataclasses.replace(identity, betas=betas, joint_offset=offsets)
        return pose_body(fake, who, draw((1, 55, 3), 0.5), expression, torch.zeros(1, 3).double())[0][:, :2]

    assert torch.autograd.gradcheck(vertices, [a.requires_grad_() for a in arguments])


def test_any_leading_dimensions(fake):
    rotation = draw((2, 3, 55, 3), 0.5)
    joints = rest_joints(fake, mean_identity(fake))
    transforms = joint_transforms(rotation, joints, fake.parents)
    flat = joint_transforms(rotation.reshape(6, 55, 3), joints, fake.parents)
    assert transforms.shape == (2, 3, 55, 3, 4)
    torch.testing.assert_close(transforms.reshape(6, 55, 3, 4), flat)
