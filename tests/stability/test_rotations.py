"""Rotations where their formulas divide by nothing, against float64 and finite differences."""

import itertools
import math

import numpy as np
import pytest
import roma
import torch
from scipy.spatial.transform import Rotation

from pipeline.body import Poses, joint_index, joint_transforms, mean_identity, pose_body
from stages.fit.initialise import continuous, shortest_turn
from stages.fit.parameters import parameters_of
from stages.fit.smoothing import nearest_branch, smooth
from tests.made.body import open_body

AXES = [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8), (-0.48, 0.6, 0.64)]
ANGLES = {
    "identity": 0.0,
    "1e-20": 1e-20,
    "1e-7": 1e-7,
    "where the formula changes, below": 1e-6 * (1 - 1e-7),
    "where the formula changes, above": 1e-6 * (1 + 1e-7),
    "1e-3": 1e-3,
    "quarter turn": math.pi / 2,
    "1e-3 before pi": math.pi - 1e-3,
    "1e-7 before pi": math.pi - 1e-7,
    "pi": math.pi,
    "1e-7 after pi": math.pi + 1e-7,
    "1e-7 before a whole turn": 2 * math.pi - 1e-7,
    "a whole turn": 2 * math.pi,
    "three and a half turns": 7 * math.pi,
    "a hundred turns": 200 * math.pi + 0.3,
}
CASES = [pytest.param(angle, axis, id=f"{name}-{axis}") for name, angle in ANGLES.items() for axis in AXES]
PARENTS = (-1, 0, 1)


def vector(angle, axis, dtype=torch.float64):
    return torch.tensor(axis, dtype=dtype) * angle


@pytest.mark.parametrize(("angle", "axis"), CASES)
def test_a_vector_is_the_matrix_that_scipy_makes_of_it(angle, axis):
    expected = torch.from_numpy(Rotation.from_rotvec(angle * np.array(axis)).as_matrix())
    exact = roma.rotvec_to_rotmat(vector(angle, axis))
    torch.testing.assert_close(exact, expected, rtol=0, atol=1e-12)
    single = roma.rotvec_to_rotmat(vector(angle, axis, torch.float32))
    # A float32 angle is itself known to 6e-8 of its size.
    torch.testing.assert_close(single.double(), expected, rtol=0, atol=1e-6 + 2e-7 * angle)
    torch.testing.assert_close(single @ single.mT, torch.eye(3), rtol=0, atol=1e-6)


@pytest.mark.parametrize(("angle", "axis"), CASES)
def test_slope_of_a_matrix_is_a_finite_difference(angle, axis):
    weight = torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(point):
        return (roma.rotvec_to_rotmat(point) * weight).sum()

    point = vector(angle, axis).requires_grad_()
    (slope,) = torch.autograd.grad(value(point), point)
    step = 1e-5
    moved = step * torch.eye(3, dtype=torch.float64)
    expected = torch.stack([(value(point + one) - value(point - one)) / (2 * step) for one in moved]).detach()
    torch.testing.assert_close(slope, expected, rtol=1e-5, atol=2e-5)
    single = vector(angle, axis, torch.float32).requires_grad_()
    (roma.rotvec_to_rotmat(single) * weight.float()).sum().backward()
    torch.testing.assert_close(single.grad.double(), expected, rtol=1e-3, atol=1e-4 + 1e-6 * angle)


@pytest.mark.parametrize(("angle", "axis"), CASES)
def test_a_matrix_gives_back_a_vector_of_the_same_rotation(angle, axis):
    for dtype, tolerance in ((torch.float64, 1e-7), (torch.float32, 2e-3)):
        matrix = roma.rotvec_to_rotmat(vector(angle, axis, dtype)).requires_grad_()
        found = roma.rotmat_to_rotvec(matrix)
        assert found.norm() <= math.pi + 1e-6
        # acos and friends lose half the digits at the identity and at pi; a quaternion must not.
        torch.testing.assert_close(roma.rotvec_to_rotmat(found), matrix, rtol=0, atol=tolerance)
        (slope,) = torch.autograd.grad(found.square().sum(), matrix)
        assert slope.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "turn", [0.0, math.pi / 2, -math.pi / 2, math.pi], ids=["none", "up", "down", "half"]
)
def test_gimbal_configurations_of_a_chain_have_the_slopes_of_finite_differences(turn, dtype):
    """Yaw, pitch, roll with the pitch at a right angle: where Euler angles lose a degree of freedom."""
    rotation = torch.tensor([[0.0, 0.3, 0.0], [turn, 0.0, 0.0], [0.0, 0.0, -0.4]], dtype=torch.float64)
    joints = torch.tensor([[0.0, 0, 0], [0, 0.3, 0], [0.1, 0.6, 0]], dtype=torch.float64)
    point = torch.tensor([0.2, 0.9, -0.1, 1.0], dtype=torch.float64)

    def place(pose):
        return (joint_transforms(pose[None], joints.to(pose), PARENTS)[0, 2] @ point.to(pose)).square().sum()

    pose = rotation.to(dtype).requires_grad_()
    (slope,) = torch.autograd.grad(place(pose), pose)
    step, expected = 1e-6, torch.zeros(3, 3, dtype=torch.float64)
    for joint, axis in itertools.product(range(3), range(3)):
        change = torch.zeros_like(rotation)
        change[joint, axis] = step
        expected[joint, axis] = (place(rotation + change) - place(rotation - change)) / (2 * step)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-8
    torch.testing.assert_close(slope.double(), expected, rtol=1e-4, atol=tolerance)


SIX = {
    "parallel": [[1.0, 2.0], [0.0, 0.0], [0.0, 0.0]],
    "opposite": [[1.0, -1.0], [0.0, 0.0], [0.0, 0.0]],
    "1e-9 apart": [[1.0, 1.0], [0.0, 1e-9], [0.0, 0.0]],
    "1e-5 apart": [[1.0, 1.0], [0.0, 1e-5], [0.0, 0.0]],
    "first is zero": [[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]],
    "second is zero": [[0.3, 0.0], [0.4, 0.0], [0.0, 0.0]],
    "both are zero": [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]],
    "denormal": [[1e-42, 0.0], [0.0, 1e-42], [0.0, 0.0]],
    "huge": [[1e18, 1e18], [0.0, 1e18], [0.0, 0.0]],
}


def with_six(columns):
    """Parameters of two frames, one joint of the first of which has these six numbers."""
    parameters = parameters_of(torch.zeros(2, 55, 3), torch.zeros(2, 3), (1, 1, 1))
    parameters.body_pose[0, 4] = torch.tensor(columns).flatten()
    return parameters


@pytest.mark.parametrize("case", SIX)
def test_six_numbers_are_always_a_rotation(case):
    parameters = with_six(SIX[case]).leaves()
    matrices = parameters.matrices
    away = matrices.detach() @ matrices.detach().mT - torch.eye(3)
    assert away.abs().max() < 1e-5
    assert torch.linalg.det(matrices.detach()).min() > 0.99
    matrices.square().sum().backward()
    (matrices[0] * torch.arange(9.0).view(3, 3)).sum()
    weight = torch.arange(9.0).view(3, 3)
    for leaf in parameters.named().values():
        leaf.grad = None
    (parameters.matrices * weight).sum().backward()
    assert parameters.body_pose.grad.isfinite().all()


def test_ordinary_six_numbers_are_what_gram_and_schmidt_say():
    six = torch.randn(2, 55, 3, 2, generator=torch.Generator().manual_seed(0))
    parameters = parameters_of(torch.zeros(2, 55, 3), torch.zeros(2, 3), (1, 1, 1))
    flat = six.flatten(-2)
    groups = {"global_orient": slice(0, 1), "body_pose": slice(1, 22), "jaw": slice(22, 23)}
    for name, part in (groups | {"eyes": slice(23, 25), "hands": slice(25, 55)}).items():
        getattr(parameters, name).copy_(flat[:, part])
    assert torch.equal(parameters.matrices, roma.special_gramschmidt(six))


# Over time


def clip(rotation, valid=None):
    count = len(rotation)
    valid = {} if valid is None else {"valid": torch.tensor(valid)}
    whole = torch.zeros(count, 55, 3)
    whole[:, 0] = rotation
    return Poses(tuple(range(count)), whole, torch.zeros(count, 2), torch.zeros(count, 3), **valid)


@pytest.mark.parametrize("speed", [0.3, 1.0, math.pi - 1e-3, math.pi, 4.0], ids=str)
@pytest.mark.parametrize("window", [3, 5, 9])
def test_smoothing_turns_of_any_speed_stays_finite(speed, window):
    turning = torch.arange(24.0)[:, None] * torch.tensor([0.0, speed, 0.0])
    for valid in (None, [row % 3 > 0 for row in range(24)]):
        found = smooth(clip(turning, valid), window)
        for values in (found.rotation, found.expression, found.transl):
            assert values.isfinite().all()


def test_smoothing_many_turns_keeps_the_branch():
    turning = torch.arange(200.0)[:, None] * torch.tensor([0.0, 0.2, 0.0])  # six turns
    found = smooth(clip(turning), 5).rotation[:, 0]
    assert (found - turning).abs().max() < 1e-2


def test_smoothing_half_turns_back_and_forth_stays_finite():
    """Quaternions at right angles to each other: neither sign is nearer."""
    flips = torch.zeros(20, 3)
    flips[1::2, 1] = math.pi
    found = smooth(clip(flips), 5)
    assert found.rotation.isfinite().all()


def test_continuous_and_nearest_branch_keep_the_rotation():
    generator = torch.Generator().manual_seed(3)
    rotation = 4 * torch.randn(40, 5, 3, generator=generator)
    rotation[7] = 0
    for found in (continuous(rotation), nearest_branch(rotation, rotation.roll(1, 0))):
        assert found.isfinite().all()
        same = roma.rotvec_to_rotmat(rotation.double())
        torch.testing.assert_close(roma.rotvec_to_rotmat(found.double()), same, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "end",
    [[0.0, 1, 0], [0.0, -1, 0], [1e-12, -1, 0], [0.0, 1e-30, 0], [0.0, 0, 0], [0.0, -1e18, 1]],
    ids=["same", "opposite", "just off the opposite", "tiny", "none", "huge"],
)
def test_the_shortest_turn_between_directions_is_a_rotation(end):
    turn = shortest_turn(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([end]))
    assert turn.isfinite().all() and (turn @ turn.mT - torch.eye(3)).abs().max() < 1e-5


def test_a_pose_of_many_turns_is_the_pose_without_them():
    """In float32: a hundred turns cost a tenth of a millimetre, not the pose."""
    body = open_body()
    pose = torch.zeros(2, 55, 3)
    pose[:, joint_index("left_elbow"), 1] = -0.7
    pose[1, joint_index("left_elbow"), 1] += 200 * math.pi
    vertices, _ = pose_body(body, mean_identity(body), pose, torch.zeros(2, 1), torch.zeros(2, 3))
    assert (vertices[0] - vertices[1]).norm(dim=-1).max() < 1e-4
