"""A motion stood on another person's legs: scaled, faced to the front, and with the feet on the ground."""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor

from pipeline.body import (
    BodyModel,
    Identity,
    Pose,
    joint_index,
    joint_transforms,
    linear_blend_skinning,
    rest_joints,
    rest_vertices,
)
from pipeline.motion.retarget import yaw
from stages.animate.motions.motion import Motion, leg_length

_CHUNK = 64  # frames that are posed at once, which bounds the memory
_FEET = ("left_ankle", "right_ankle", "left_foot", "right_foot")


@dataclasses.dataclass(frozen=True)
class PlacedMotion:
    """A motion of one person in the world, T frames, float32. Y is up, the ground is y = 0.

    Attributes:
        rotation: [T, 55, 3], rotation vectors, radians.
        expression: [T, E].
        transl: [T, 3], metres, as SMPL-X has it: the pelvis is at ``transl`` plus its place at rest.
        scale: what the motion's way was multiplied with.
    """

    rotation: Tensor
    expression: Tensor
    transl: Tensor
    scale: float

    def __len__(self) -> int:
        return len(self.rotation)

    def pose(self, row: int) -> Pose:
        """The pose of one of the T frames, counted from 0."""
        return Pose(self.rotation[row], self.expression[row], self.transl[row])


def place(motion: Motion, body: BodyModel, identity: Identity, in_place: bool = False) -> PlacedMotion:
    """Gives a motion to a person.

    Rotations are kept as they are. The pelvis' way is scaled by the ratio of the legs' lengths, so that feet
    that stand still on the ground keep doing so. The pelvis begins above the world's origin; unless a camera
    says where front is, the body faces +Z in the first frame. The lowest point that the feet reach in the
    whole motion is on the ground.

    Args:
        motion: as it was captured.
        identity: the person's.
        in_place: the pelvis stays where it is; the body's turns are kept.
    """
    rotation, scale = motion.rotation.clone(), leg_length(body, identity=identity) / motion.leg
    way = (motion.root - motion.root[:1]) * scale
    if not motion.faces_camera:
        turn = yaw(roma.rotvec_to_rotmat(rotation[0, 0])).mT
        rotation[:, 0] = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(rotation[:, 0]))
        way = way @ turn.mT
    if in_place:
        way = torch.zeros_like(way)
    transl = way - rest_joints(body, identity)[0]
    transl[:, 1] -= lowest_point(body, identity, rotation, transl)
    known = body.expression_directions.shape[2]
    expression = torch.zeros(len(rotation), known)
    if motion.expression is not None:
        width = min(known, motion.expression.shape[1])
        expression[:, :width] = motion.expression[:, :width]
    return PlacedMotion(rotation, expression, transl, scale)


@torch.no_grad()
def lowest_point(body: BodyModel, identity: Identity, rotation: Tensor, transl: Tensor) -> float:
    """The least height that a foot's surface reaches in any frame, metres; [T, 55, 3] and [T, 3]."""
    feet = body.skinning_weights[:, [joint_index(name) for name in _FEET]].sum(1) > 0.5
    points, weights = rest_vertices(body, identity)[feet], body.skinning_weights[feet]
    joints = rest_joints(body, identity)
    lowest = []
    for start in range(0, len(rotation), _CHUNK):
        some = slice(start, start + _CHUNK)
        transforms = joint_transforms(rotation[some], joints, body.parents)
        lowest.append(
            float((linear_blend_skinning(transforms, weights, points)[..., 1] + transl[some, None, 1]).min())
        )
    return min(lowest)
