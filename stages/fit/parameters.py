"""The parameters that are optimised, and the landmarks that they pose.

Only the landmarks are posed, not the mesh. Every landmark is a point with skinning weights: a joint is
a point that moves rigidly with it, and a point on the surface mixes rest position and weights of its
triangle's corners. (Posing the corners and mixing afterwards differs by under a tenth of a millimetre
on triangles of this size.) So all of them are one small skinning, linear in shape, expression and
offsets.
"""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from pipeline.body import BodyModel, forward_kinematics, linear_blend_skinning, mean_identity, rest_joints
from pipeline.body.joints import BODY_POSE, GLOBAL_ORIENT, JAW
from pipeline.body.landmarks import PointSet

EYES, HANDS = slice(23, 25), slice(25, 55)
ROTATIONS = ("global_orient", "body_pose", "jaw", "eyes", "hands")
PER_FRAME = (*ROTATIONS, "expression", "transl")
_ORTHOGONAL = 1e-3  # by how much the third column's squared length may differ from 1


@dataclasses.dataclass(frozen=True)
class Parameters:
    """The unknowns of a clip of T frames: leaves of the optimisation.

    Rotations are six numbers each, the first two columns of a matrix before orthonormalisation: unlike
    angles they have no seam that a turning body would have to cross (Zhou et al. 2019).

    Attributes:
        global_orient: [T, 1, 6], as are the next four.
        body_pose: [T, 21, 6].
        jaw: [T, 1, 6].
        eyes: [T, 2, 6].
        hands: [T, 30, 6].
        expression: psi, [T, E].
        transl: [T, 3], metres.
        betas: beta, [B].
        joint_offset: Delta J, [55, 3], metres.
        face_control: [C, 3], metres; spread over the face it is Delta V_face.
    """

    global_orient: Tensor
    body_pose: Tensor
    jaw: Tensor
    eyes: Tensor
    hands: Tensor
    expression: Tensor
    transl: Tensor
    betas: Tensor
    joint_offset: Tensor
    face_control: Tensor

    @property
    def matrices(self) -> Tensor:
        """Theta, [T, 55, 3, 3], rotation matrices relative to the parent, in the order of the schema."""
        six = torch.cat([getattr(self, name) for name in ROTATIONS], dim=1)
        return orthonormalised(six.unflatten(-1, (3, 2)))

    def orthonormal(self) -> Parameters:
        """The same rotations with unit and orthogonal columns."""
        return self.with_matrices(self.matrices)

    def with_matrices(self, matrices: Tensor) -> Parameters:
        """The same with other rotations, [T, 55, 3, 3]."""
        return dataclasses.replace(self, **_rotation_groups(matrices))

    def rows(self, low: int, high: int) -> Parameters:
        """The frames from ``low`` to ``high`` - 1; what all frames share stays as it is."""
        return dataclasses.replace(self, **{name: getattr(self, name)[low:high] for name in PER_FRAME})

    def named(self) -> dict[str, Tensor]:
        """Every tensor by its name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def zeros(self) -> Parameters:
        """Zeros of the same shapes."""
        return Parameters(**{name: torch.zeros_like(value) for name, value in self.named().items()})

    def leaves(self) -> Parameters:
        """Copies that an optimiser can change."""
        copies = self.detached().named()
        return Parameters(**{name: value.requires_grad_() for name, value in copies.items()})

    def detached(self) -> Parameters:
        """Copies of the values alone."""
        return Parameters(**{name: value.detach().clone() for name, value in self.named().items()})


def orthonormalised(columns: Tensor) -> Tensor:
    """The rotations whose first two columns are nearest to given ones, one after the other.

    Columns that are parallel, or zero, say no rotation: the second is then any that stands upright on the
    first, and neither has a gradient.

    Args:
        columns: [..., 3, 2].

    Returns:
        [..., 3, 3].
    """
    matrices = roma.special_gramschmidt(columns)
    upright = (matrices[..., 2].detach().square().sum(-1, keepdim=True) - 1).abs() < _ORTHOGONAL
    if bool(upright.all()):
        return matrices
    with torch.no_grad():
        first = columns[..., 0]
        length = first.norm(dim=-1, keepdim=True)
        first = torch.where(length > 0, first / length, first.new_tensor([1.0, 0.0, 0.0]))
        second = one_hot(first.abs().argmin(-1), 3).to(first)  # of the axes the one least along the first
    # Gradients of what is not used are asked for too, so Gram and Schmidt must not see it.
    safe = torch.where(upright[..., None], columns, torch.stack([first, second], dim=-1))
    return roma.special_gramschmidt(safe)


def parameters_of(rotation: Tensor, transl: Tensor, sizes: tuple[int, int, int]) -> Parameters:
    """Parameters with a pose and a place, everything else zero.

    Args:
        rotation: [T, 55, 3], rotation vectors.
        transl: [T, 3].
        sizes: the numbers of betas, expressions and face controls.
    """
    betas, expressions, controls = sizes
    new = rotation.new_zeros
    return Parameters(
        **_rotation_groups(roma.rotvec_to_rotmat(rotation)),
        expression=new(len(rotation), expressions), transl=transl, betas=new(betas),
        joint_offset=new(55, 3), face_control=new(controls, 3),
    )  # fmt: skip


def _rotation_groups(matrices: Tensor) -> dict[str, Tensor]:
    """[T, 55, 3, 3] as the six numbers of each rotation, by group."""
    six = matrices[..., :2].flatten(-2)
    parts = (GLOBAL_ORIENT, BODY_POSE, slice(JAW, JAW + 1), EYES, HANDS)
    return {name: six[:, part] for name, part in zip(ROTATIONS, parts, strict=True)}


@dataclasses.dataclass(frozen=True)
class LandmarkModel:
    """N landmarks of a body as points to be skinned.

    Attributes:
        rest: [N, 3], metres, T pose.
        shape: [N, 3, B]; expression: [N, 3, E].
        weights: [N, 55], skinning.
        joint: [N, 55], 1 where the landmark is that joint.
        face: [N, C], how far each face control moves each landmark.
        joints: [55, 3], rest joints; joint_shape: [55, 3, B].
        parents: the kinematic tree.
    """

    rest: Tensor
    shape: Tensor
    expression: Tensor
    weights: Tensor
    joint: Tensor
    face: Tensor
    joints: Tensor
    joint_shape: Tensor
    parents: tuple[int, ...]

    def posed(self, parameters: Parameters, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Landmarks [T, N, 3] and joints [T, 55, 3] in the world, metres.

        Args:
            parameters: everything but the pose is read from there.
            matrices: theta, [T, 55, 3, 3].
        """
        rest = self.rest + self.shape @ parameters.betas + self.joint @ parameters.joint_offset
        rest = rest + self.face @ parameters.face_control
        flat = self.expression.flatten(0, 1)
        points = rest + (parameters.expression @ flat.mT).unflatten(1, self.rest.shape)
        joints = self.joints + self.joint_shape @ parameters.betas + parameters.joint_offset
        transforms, moved = forward_kinematics(matrices, joints, self.parents)
        place = parameters.transl[:, None]
        return linear_blend_skinning(transforms, self.weights, points) + place, moved + place


def landmark_model(body: BodyModel, points: PointSet, betas: int, spread: Tensor) -> LandmarkModel:
    """The landmarks of a body.

    Args:
        points: N landmarks.
        betas: B, how many shape coefficients are used.
        spread: [V, C], Delta V_face at each vertex for each face control.
    """
    on_joint = points.joint >= 0
    joint = one_hot(points.joint.clamp_min(0), len(body.parents)).float() * on_joint[:, None]
    share = points.barycentrics * ~on_joint[:, None]
    joints = rest_joints(body, mean_identity(body))
    shape = body.shape_directions[..., :betas]
    joint_shape = torch.einsum("jv,vck->jck", body.joint_regressor, shape)

    def mixed(attribute: Tensor) -> Tensor:  # [V, ...] -> [N, ...]
        return torch.einsum("nk,nk...->n...", share, attribute[points.vertices])

    return LandmarkModel(
        rest=mixed(body.v_template) + joint @ joints,
        shape=mixed(shape) + torch.einsum("nj,jck->nck", joint, joint_shape),
        expression=mixed(body.expression_directions),
        weights=mixed(body.skinning_weights) + joint,
        joint=joint,
        face=mixed(spread),
        joints=joints,
        joint_shape=joint_shape,
        parents=body.parents,
    )


def movable_joints(model: LandmarkModel, seen: Tensor, vague: Tensor) -> Tensor:
    """The joints whose rotation some seen landmark depends on: [55] bool.

    What no landmark depends on stays where it was initialised: a hand that is never seen never moves.

    Args:
        model: N landmarks.
        seen: [N] bool, seen in any frame.
        vague: [N] bool, landmarks that turn head and wrist but move no jaw, eye or finger.
    """
    moved = _moved_by(model, seen)
    moved[JAW:] = _moved_by(model, seen & ~vague)[JAW:]
    return moved


def _moved_by(model: LandmarkModel, chosen: Tensor) -> Tensor:
    """The joints that move any of the chosen landmarks: [55] bool."""
    moved = torch.zeros(len(model.parents), dtype=torch.bool)
    for weights, is_joint in zip(model.weights[chosen], model.joint[chosen].any(1).tolist(), strict=True):
        for joint in torch.nonzero(weights > 1e-4)[:, 0].tolist():
            # A joint's own rotation does not move the joint.
            above = model.parents[joint] if is_joint else joint
            while above >= 0 and not moved[above]:
                moved[above] = True
                above = model.parents[above]
    return moved
