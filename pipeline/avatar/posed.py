"""An avatar in a pose: its Gaussians, the features that a pose is told as, and the shape before skinning."""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor

from pipeline.avatar.canonical import Canonical
from pipeline.body import Pose
from pipeline.splat import Gaussians


@dataclasses.dataclass(frozen=True)
class Posed:
    """One frame's Gaussians and the terms that regularisers look at.

    Attributes:
        gaussians: in world coordinates.
        pose_offset: [N, 3], Delta V_pose, metres; None while nothing follows the pose.
        log_scale: [N, 3], S_tri + Delta S_pose.
        color_logit: [N, 3], C_tri + Delta C_pose + Delta C_res.
        color_residual: [N, 3], Delta C_res; None while the residual heads are off.
        rows: [M] int64, the Gaussians that the pose and residual heads were asked for; None for all. Of
            the others their parts are zero.
    """

    gaussians: Gaussians
    pose_offset: Tensor | None
    log_scale: Tensor
    color_logit: Tensor
    color_residual: Tensor | None = None
    rows: Tensor | None = None


def pose_features(rotation: Tensor) -> Tensor:
    """The pose that heads are conditioned on, ``theta`` without the root.

    Two columns of each joint's rotation matrix, the identity's subtracted, so that the rest pose is
    zero: [55, 3] rotation vectors -> [54 * 6].
    """
    matrices = roma.rotvec_to_rotmat(rotation[1:])
    return (matrices - torch.eye(3, device=rotation.device))[:, :, :2].reshape(-1)


def rest_shape(canonical: Canonical, pose: Pose) -> Tensor:
    """The vertices before skinning: rest shape, expression and, if the body has them, correctives."""
    moved = canonical.expression_directions[..., : len(pose.expression)] @ pose.expression
    shape = canonical.vertices + moved
    if canonical.pose_directions is None:
        return shape
    joints = pose.rotation[1:]
    matrices = roma.rotvec_to_rotmat(joints) - torch.eye(3, device=joints.device)
    return shape + canonical.pose_directions @ matrices.reshape(-1)
