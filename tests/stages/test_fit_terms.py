"""The fit's parts: each term against a value worked out by hand, the masks, the schedule, the rotations."""

import dataclasses
import math

import numpy as np
import pytest
import roma
import torch

from pipeline.body import Identity, joint_index, joint_transforms, locate, pose_body
from pipeline.finite import NotFiniteError
from stages.fit import terms
from stages.fit.adam import finite_sum, rate
from stages.fit.face_offset import mirror_matrix, on_skin, spread_matrix
from stages.fit.initialise import continuous, torso_orientation
from stages.fit.joint_limits import joint_limits
from stages.fit.observations import drop_guesses, observe, visible
from stages.fit.parameters import landmark_model, movable_joints, parameters_of
from stages.fit.registration import views_of
from stages.fit.windows import bumps
from tests.made.body import open_body
from tests.made.detections import make_clip


def test_keypoint_loss():
    projected = torch.tensor([[[3.0, 4.0], [1.0, 1.0], [5.0, 5.0]]])
    target = torch.tensor([[[0.0, 0.0], [1.0, 1.0], [9.0, 9.0]]])
    mask = torch.tensor([[True, True, False]])
    plain = terms.keypoint_loss(projected, target, mask)
    assert plain[0].tolist() == pytest.approx([math.sqrt(26) - 1, 0.0, 0.0])
    saturated = terms.keypoint_loss(projected, target, mask, torch.tensor([20.0, 20.0, 20.0]))
    error = math.sqrt(26) - 1
    assert saturated[0, 0].item() == pytest.approx(20 * error / (20 + error))


def test_keypoint_loss_of_a_masked_point_has_no_gradient_even_where_it_is_not_finite():
    projected = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]], requires_grad=True)
    loss = terms.keypoint_loss(projected, torch.zeros(1, 2, 2), torch.tensor([[True, False]]))
    loss.sum().backward()
    assert projected.grad[0, 0].abs().sum() > 0 and projected.grad[0, 1].abs().sum() == 0


def test_losses_of_parameters():
    value, initial = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 0.0])
    assert terms.initial_loss(value, initial).tolist() == [0.25, 4.0]
    assert terms.shape_loss(value).tolist() == [1.0, 4.0]
    offset = torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    assert terms.joint_offset_loss(offset).tolist() == [25.0, 0.0]
    assert terms.face_offset_loss(offset).tolist() == [25.0, 0.0]


def test_symmetry_loss_is_zero_for_mirrored_offsets_only():
    mirror = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    mirrored = torch.tensor([[1.0, 2.0, 3.0], [-1.0, 2.0, 3.0]])
    assert terms.symmetry_loss(mirrored, mirror).tolist() == [0.0, 0.0]
    equal = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    assert terms.symmetry_loss(equal, mirror).tolist() == [4.0, 4.0]


def test_direction_loss():
    start, along = torch.zeros(1, 3, 3), torch.tensor([[[0.0, 0.0, 1.0]]]).expand(1, 3, 3)
    end = torch.tensor([[[0.0, 0.0, 5.0], [0.0, 0.0, -0.1], [2.0, 0.0, 0.0]]])
    assert terms.direction_loss(start, end, along)[0].tolist() == pytest.approx([0.0, 2.0, 1.0])


def test_in_front_loss():
    depth, chest = torch.tensor([[1.9, 1.7, 1.5]]), torch.tensor([2.0])
    assert terms.in_front_loss(depth, chest, 0.25)[0].tolist() == pytest.approx([0.15**2, 0.0, 0.0], abs=1e-6)


def test_joint_limit_loss():
    loss = terms.joint_limit_loss(torch.tensor([-0.5, 0.5, 2.0]), torch.zeros(3), torch.ones(3))
    assert loss.tolist() == [0.25, 0.0, 1.0]


def test_acceleration_and_velocity():
    times = torch.tensor([0.0, 1.0, 2.0, 5.0])
    steady = (3 * times[:, None]).expand(4, 2)
    assert terms.acceleration(steady, times).abs().max() == 0
    bump = torch.tensor([0.0, 1.0, 0.0])
    assert terms.acceleration(bump, times[:3]).tolist() == [-2.0]
    # x = t^2 / 2 has acceleration 1 wherever it is sampled.
    assert terms.acceleration(times.square() / 2, times).tolist() == pytest.approx([1.0, 1.0])
    # A gap of three frames costs what three single steps of the same motion cost.
    assert terms.velocity(steady, times).square().sum(1).tolist() == pytest.approx([18.0, 18.0, 54.0])
    assert terms.acceleration(bump[:2], times[:2]).shape == (0,)
    assert terms.velocity(bump[:1], times[:1]).shape == (0,)


def test_rotation_vectors_have_finite_gradients_at_zero():
    body = open_body()
    joints = body.joint_regressor @ body.v_template
    rotation = torch.zeros(2, 55, 3, requires_grad=True)
    transforms = joint_transforms(rotation, joints, body.parents)
    (transforms * torch.arange(12.0).reshape(3, 4)).sum().backward()
    assert torch.isfinite(rotation.grad).all() and rotation.grad.abs().max() > 0
    # against a central difference
    for joint, axis in ((0, 0), (16, 2)):
        value = []
        for step in (1e-3, -1e-3):
            moved = torch.zeros(2, 55, 3, dtype=torch.float64)
            moved[0, joint, axis] = step
            carried = joint_transforms(moved, joints.double(), body.parents)
            value.append((carried * torch.arange(12.0, dtype=torch.float64).reshape(3, 4)).sum())
        expected = ((value[0] - value[1]) / 2e-3).item()
        assert rotation.grad[0, joint, axis].item() == pytest.approx(expected, rel=1e-3)


def test_visible():
    points = np.array(
        [[[5, 5, 1], [5, 5, 0.39], [5, 5, 0.4], [-1, 5, 1], [5, 21, 1], [np.nan, 5, 1]]], np.float32
    )
    assert visible(points, 0.4, np.array([[30.0, 20.0]])).tolist() == [
        [True, False, True, False, False, False]
    ]
    assert not visible(np.zeros((1, 2, 3), np.float32), 0.0, np.array([[9.0, 9.0]])).any()


def test_hips_are_dropped_only_where_knees_are_unseen():
    mask = np.ones((80, 33), bool)
    mask[:40, 25:27] = False
    drop_guesses(mask, (23, 24), (25, 26))
    assert not mask[:25, 23:25].any() and mask[45:, 23:25].all()
    assert mask[:, 11].all()


def test_threshold_masks_points(model):
    clip = make_clip(*model, count=2)
    clip.keypoints.pose_image[:, 13, 3] = 0.39
    sizes = views_of(clip.keypoints, clip.cameras).size.numpy()
    observed = observe(clip.keypoints, model[1], 0.4, sizes)
    assert not observed.mask[:, 13].any() and observed.mask[:, 11].all()
    assert observe(clip.keypoints, model[1], 0.3, sizes).mask[:, 13].all()


def test_landmarks_skin_as_the_mesh_does(model):
    """Mixing a triangle before skinning it is as good as after: under a tenth of a millimetre."""
    body, landmarks = model
    clip = make_clip(body, landmarks, count=2)
    spread = torch.zeros(len(body.v_template), 0)
    for points in (landmarks.pose, landmarks.face_mesh, landmarks.hands):
        small = landmark_model(body, points, 4, spread)
        parameters = parameters_of(clip.poses.rotation, clip.poses.transl, (4, 3, 0))
        generator = torch.Generator().manual_seed(1)
        parameters.betas.copy_(torch.randn(4, generator=generator))
        parameters.expression.copy_(torch.randn(2, 3, generator=generator))
        parameters.joint_offset.copy_(0.01 * torch.randn(55, 3, generator=generator))
        identity = Identity(parameters.betas, parameters.joint_offset, torch.zeros_like(body.v_template))
        vertices, joints = pose_body(
            body, identity, clip.poses.rotation, parameters.expression, parameters.transl
        )
        expected = locate(points, joints, vertices)
        found, moved = narrowed(small, 3).posed(parameters, parameters.matrices)
        assert (moved - joints).norm(dim=-1).max() < 1e-5
        assert (found - expected).norm(dim=-1).max() < 1e-4


def narrowed(model, expressions):
    return dataclasses.replace(model, expression=model.expression[..., :expressions])


def test_only_joints_behind_seen_landmarks_move(model):
    body, landmarks = model
    points = landmarks.pose
    small = landmark_model(body, points, 1, torch.zeros(len(body.v_template), 0))
    seen = torch.zeros(33, dtype=torch.bool)
    seen[15] = True  # the left wrist
    moved = movable_joints(small, seen, torch.zeros(33, dtype=torch.bool))
    names = {body.joint_names[j] for j in torch.nonzero(moved)[:, 0].tolist()}
    spine = {"pelvis", "spine1", "spine2", "spine3"}
    assert names == spine | {"left_collar", "left_shoulder", "left_elbow"}
    seen[19] = seen[10] = True  # a knuckle, a corner of the mouth
    vague = torch.zeros(33, dtype=torch.bool)
    assert movable_joints(small, seen, vague)[joint_index("jaw")]
    vague[19] = vague[10] = True
    moved = movable_joints(small, seen, vague)
    assert moved[joint_index("left_wrist")] and moved[joint_index("head")] and not moved[22:].any()


def test_spread_follows_its_controls_and_leaves_the_rest(model):
    body, landmarks = model
    controls = landmarks.face_mesh[on_skin(body, landmarks.face_mesh)]
    assert len(controls) == 468  # the irises lie on the eyeballs
    spread = spread_matrix(body, controls)
    rows = spread.sum(1)
    assert rows.max() <= 1 + 1e-5 and spread.min() >= 0
    assert (rows[body.v_template[:, 1] < 0.1] == 0).all()  # nothing below the neck
    shift = torch.tensor([0.0, 0.0, 0.01]).expand(len(controls), 3)
    moved = (spread @ shift)[controls.vertices].mean(1)
    assert (moved[:, 2] > 0.007).float().mean() > 0.95
    ends = body.faces[:, [0, 1]]
    step = ((spread @ shift)[ends[:, 0]] - (spread @ shift)[ends[:, 1]]).norm(dim=1)
    eyes = body.skinning_weights[:, 23:25].sum(1) > 0.5
    assert step[~eyes[ends].any(1)].max() < 0.006  # no tear, of an offset of 10 mm
    assert spread_matrix(body, controls[:0]).shape == (len(body.v_template), 0)


def test_lips_move_apart(model):
    body, landmarks = model
    lips = landmarks.face_mesh[[13, 14]]  # the middle of the upper and of the lower lip, which touch
    spread = spread_matrix(body, lips)
    upper, lower = (spread[lips.vertices[k]].mean(0) for k in (0, 1))
    assert upper[0] > 0.8 * upper.sum() and lower[1] > 0.8 * lower.sum()


def test_mirror_matrix():
    places = torch.tensor([[1.0, 0.0, 0.0], [-1.1, 0.0, 0.0], [0.0, 2.0, 0.0]])
    assert mirror_matrix(places).argmax(1).tolist() == [1, 0, 2]
    assert mirror_matrix(torch.zeros(0, 3)).shape == (0, 0)


def test_joint_limits_are_mirrored_and_hold_a_relaxed_hand():
    limits = joint_limits()
    rows = {(int(j), int(a)): k for k, (j, a) in enumerate(zip(limits.joint, limits.axis, strict=True))}
    for name in ("index2", "elbow", "wrist"):
        for axis in range(3):
            left = rows.get((joint_index(f"left_{name}"), axis))
            right = rows.get((joint_index(f"right_{name}"), axis))
            if left is None:
                assert right is None
            elif axis == 0:
                assert limits.low[left] == limits.low[right]
            else:
                assert limits.low[left] == -limits.high[right]
    assert ((limits.low <= 0) & (limits.high >= 0)).all()


def test_knees_and_fingers_bend_the_possible_way(model):
    """What the limits allow moves a foot back, a hand forward, a fingertip to the palm."""
    body = model[0]
    joints = body.joint_regressor @ body.v_template
    cases = (("left_knee", 0, 1.0, "left_ankle", 2, -1), ("right_elbow", 1, 1.0, "right_wrist", 2, 1))
    cases += (("left_index1", 2, -1.0, "left_index3", 1, -1), ("right_index1", 2, 1.0, "right_index3", 1, -1))
    limits = joint_limits()
    for name, axis, angle, end, along, sign in cases:
        rotation = torch.zeros(1, 55, 3)
        rotation[0, joint_index(name), axis] = angle
        outside = terms.joint_limit_loss(limits.of(rotation), limits.low, limits.high)
        assert outside.sum() == 0, name
        transforms = joint_transforms(rotation, joints, body.parents)[0, joint_index(end)]
        moved = transforms[:, :3] @ joints[joint_index(end)] + transforms[:, 3] - joints[joint_index(end)]
        assert moved[along] * sign > 0.01, name


def test_torso_orientation_of_a_turned_body(model):
    clip = make_clip(*model, count=4)
    views = views_of(clip.keypoints, clip.cameras)
    observed = observe(clip.keypoints, model[1], 0.4, views.size.numpy())
    turned = torso_orientation(clip.keypoints, observed, views)
    away = roma.rotmat_geodesic_distance(
        roma.rotvec_to_rotmat(turned), roma.rotvec_to_rotmat(clip.poses.rotation[:, 0])
    )
    assert away.max() < 0.1


def test_continuous_rotation_vectors_turn_the_same():
    angle = torch.linspace(0, 15, 40)  # more than two whole turns
    spun = torch.stack([torch.zeros(40), angle, torch.zeros(40)], dim=1)
    shortest = roma.rotmat_to_rotvec(roma.rotvec_to_rotmat(spun))
    assert shortest.diff(dim=0).norm(dim=1).max() > 3
    smooth = continuous(shortest)
    assert (smooth - spun).norm(dim=1).max() < 1e-4


def test_bumps_keep_a_common_step_and_end_with_single_frames():
    times = torch.tensor([0.0, 1.0, 2.0, 9.0])
    assert torch.allclose(bumps(times, 2.0)[0].sum(1), torch.ones(4))
    assert torch.equal(bumps(times, 0.0)[0], torch.eye(4))
    assert bumps(times, 2.0)[0][0, 3] == 0 < 1e-3 < bumps(times, 2.0)[0][0, 1]
    part, first, last = bumps(times, 2.0, 1, 3)
    assert (first, last) == (0, 3)
    assert torch.equal(part, bumps(times, 2.0)[0][1:3, :3])


def test_rate_is_coarse_to_fine():
    assert rate("hands", 0.1) == 0 and rate("transl", 0.1) > 0
    assert rate("joint_offset", 0.3) == 0 and rate("joint_offset", 0.5) > 0
    assert rate("joint_offset", 0.5, frozenset({"joint_offset"})) == 0
    assert rate("body_pose", 0.5) > rate("body_pose", 0.7) > rate("body_pose", 0.9) > 0


def test_loss_that_is_not_finite_is_named():
    with pytest.raises(NotFiniteError, match="step 7: smooth"):
        finite_sum({"keypoints": torch.ones(()), "smooth": torch.tensor(math.nan)}, 7)
