"""An avatar in a pose: its Gaussians and their sizes, the features of a pose, the shape before skinning."""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor

from pipeline.avatar.architecture import Architecture
from pipeline.avatar.canonical import Canonical
from pipeline.body import Pose
from pipeline.splat import Gaussians

LOG_SCALE_RANGE = (-2.0, 1.2)  # a Gaussian stays within 0.14 to 3.3 times its initial size
LARGEST_SCALE = 0.03  # metres


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


def rest_shape(canonical: Canonical, pose: Pose, moved: Tensor | None = None) -> Tensor:
    """The vertices before skinning: rest shape, expression and, if the body has them, correctives, [N, 3].

    Args:
        canonical: the mesh.
        pose: of the frame.
        moved: [N, 3], metres, by how much the learnt identity moves them; None where none is learnt.
    """
    expressed = canonical.expression_directions[..., : len(pose.expression)] @ pose.expression
    shape = canonical.vertices + expressed
    shape = shape if moved is None else shape + moved
    if canonical.pose_directions is None:
        return shape
    joints = pose.rotation[1:]
    matrices = roma.rotvec_to_rotmat(joints) - torch.eye(3, device=joints.device)
    corrected = canonical.pose_directions @ matrices.reshape(-1)
    rows = canonical.corrected
    return shape + corrected if rows is None else shape.index_add(0, rows, corrected)


def initial_scales(canonical: Canonical, sizes: Architecture) -> Tensor:
    """The Gaussians' standard deviations before anything is learnt, along their axes: [N, 3], metres."""
    across = canonical.spacing * sizes.scale
    return torch.cat([across, across.mean(1, keepdim=True) * sizes.thickness], 1)


def scales_of(
    canonical: Canonical,
    log_scale: Tensor,  # [N, 3]
    sizes: Architecture,
) -> Tensor:
    """The Gaussians' standard deviations, [N, 3], metres, within their limits.

    Args:
        canonical: the mesh.
        log_scale: relative to the initial ones.
        sizes: of the avatar.
    """
    scales = initial_scales(canonical, sizes) * torch.exp(log_scale.clamp(*LOG_SCALE_RANGE))
    return scales.clamp(max=LARGEST_SCALE)


def scaled_residual(answer: Tensor, share: Tensor) -> Tensor:
    """A share, [N, 2], of residual colours and moves: [N, 3] or [N, 6]."""
    return torch.cat([answer[:, :3] * share[:, :1], answer[:, 3:] * share[:, 1:]], 1)
