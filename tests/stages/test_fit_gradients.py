"""Every term of the registration objective by gradcheck in float64, and rotations where they are hard."""

import math

import pytest
import roma
import torch

from pipeline.body import forward_kinematics
from stages.fit import terms
from stages.fit.joint_limits import joint_limits
from stages.fit.parameters import parameters_of
from tests.made.body import open_body

T, N = 3, 4


def random(*shape, seed=0, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(*shape, generator=generator, dtype=torch.float64)


MASK = torch.tensor([[True, False, True, True]] * T)
TIMES = torch.tensor([0.0, 1.0, 4.0], dtype=torch.float64)
MIRROR = torch.eye(N, dtype=torch.float64)[[1, 0, 3, 2]]
CASES = {
    "keypoint_loss": lambda x: terms.keypoint_loss(x[..., :2], random(T, N, 2, seed=1), MASK),
    "keypoint_loss, saturating": lambda x: terms.keypoint_loss(
        x[..., :2], random(T, N, 2, seed=1), MASK, torch.full((N,), 2.0, dtype=torch.float64)
    ),
    "outline_loss": lambda x: terms.outline_loss(x, 20.0),
    "initial_loss": lambda x: terms.initial_loss(x, random(T, N, 3, seed=1)),
    "rotation_loss": lambda x: terms.rotation_loss(
        roma.rotvec_to_rotmat(x), roma.rotvec_to_rotmat(random(T, N, 3, seed=1))
    ),
    "shape_loss": terms.shape_loss,
    "joint_offset_loss": terms.joint_offset_loss,
    "symmetry_loss": lambda x: terms.symmetry_loss(x[0], MIRROR),
    "face_offset_loss": terms.face_offset_loss,
    "direction_loss": lambda x: terms.direction_loss(
        x, random(T, N, 3, seed=1), torch.nn.functional.normalize(random(T, N, 3, seed=2), dim=-1)
    ),
    "in_front_loss": lambda x: terms.in_front_loss(x[..., 2], x[:, 0, 0], 0.2),
    "joint_limit_loss": lambda x: terms.joint_limit_loss(
        x, torch.full((3,), -0.5).double(), torch.full((3,), 0.4).double()
    ),
    "velocity": lambda x: terms.velocity(x, TIMES),
    "acceleration": lambda x: terms.acceleration(x, TIMES),
}


@pytest.mark.parametrize("name", CASES)
def test_gradient(name):
    values = random(T, N, 3).requires_grad_()
    assert torch.autograd.gradcheck(CASES[name], (values,))


def test_gradient_of_six_numbers_a_rotation():
    """6D -> matrix -> the skinning transforms of a chain of joints."""
    body = open_body()
    joints = (body.joint_regressor @ body.v_template).double()
    six = roma.rotvec_to_rotmat(random(1, 55, 3, scale=0.3))[..., :2].requires_grad_()
    # The sum over joints keeps gradcheck's numerical Jacobian small.
    weights = random(55, 3, 4, seed=3)

    def posed(columns):
        transforms, moved = forward_kinematics(roma.special_gramschmidt(columns), joints, body.parents)
        return (transforms * weights).sum((1, 2, 3)), (moved * weights[..., 0]).sum((1, 2))

    assert torch.autograd.gradcheck(posed, (six,))


@pytest.mark.parametrize(
    "angle", [0.0, 1e-8, math.pi - 1e-4, math.pi, math.pi + 1e-4, 2 * math.pi, 7 * math.pi]
)
def test_rotations_come_back_as_they_went_in(angle):
    """Theta as rotation vectors -> six numbers -> matrices, at and near the seams of angles."""
    axis = torch.nn.functional.normalize(random(1, 55, 3, seed=4), dim=-1)
    rotation = (angle * axis).float()
    parameters = parameters_of(rotation, torch.zeros(1, 3), (1, 1, 0))
    away = roma.rotmat_geodesic_distance(
        parameters.matrices.double(), roma.rotvec_to_rotmat(rotation.double())
    )
    assert away.max() < 1e-5
    back = roma.rotmat_to_rotvec(parameters.matrices)
    assert torch.isfinite(back).all()
    again = roma.rotmat_geodesic_distance(roma.rotvec_to_rotmat(back.double()), parameters.matrices.double())
    assert again.max() < 2e-3 if abs(angle - math.pi) < 1e-3 else again.max() < 1e-5


def test_priors_stay_finite_where_a_limited_joint_turns_by_pi():
    rotation = torch.zeros(2, 55, 3)
    rotation[0, :, 1] = math.pi
    rotation[1, :, 2] = math.pi - 1e-6
    parameters = parameters_of(rotation, torch.zeros(2, 3), (1, 1, 0)).leaves()
    limits = joint_limits()
    vectors = roma.rotmat_to_rotvec(parameters.matrices)
    loss = terms.joint_limit_loss(limits.of(vectors), limits.low, limits.high).sum() + vectors.square().sum()
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(parameters.hands.grad).all()
    assert torch.isfinite(parameters.body_pose.grad).all()
