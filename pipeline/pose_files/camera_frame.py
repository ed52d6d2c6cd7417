"""Conversion between the axes of pose files (each frame's camera) and the world.

The files describe a body in the axes of the frame's own camera, which are OpenCV's: X right, Y down, Z
ahead. Somebody upright who faces the camera has a ``root_pose`` of pi about X. A point x of the body at
rest, moved by the root alone, is at

    x_camera = R_root (x - J_0) + J_0 + trans,

where J_0 is the root joint of the shaped body at rest: SMPL-X turns about its pelvis, which is not the
origin. ``trans`` is thus the pelvis' place in the camera minus J_0 (ExAvatar's fit holds the pelvis'
place and subtracts the root joint when it saves). Here the same point is in the world, Y up for an
uncalibrated clip (``pipeline.clip.camera.facing_camera``):

    x_world = G (x - J_0) + J_0 + transl,    x_camera = R x_world + t,

so R_root = R G, and trans = R (J_0 + transl) + t - J_0. (SMPLest-X looks at a crop as if it were the
middle of the picture. The small turn that makes is left to the fit.)

The hands' rotation vectors in the files are relative to the model file's ``hands_meanl`` and
``hands_meanr``, to which the smplx package adds them number by number (``flat_hand_mean=False``, its
default, which all of the programs above leave as it is).
"""

from __future__ import annotations

import roma
import torch
from torch import Tensor

HAND_JOINTS = slice(25, 55)


def into_world(
    root_pose: Tensor,  # [T, 3]
    trans: Tensor,  # [T, 3]
    pivot: Tensor,  # [3]
    rotation: Tensor,  # [T, 3, 3]
    translation: Tensor,  # [T, 3]
) -> tuple[Tensor, Tensor]:
    """The root's rotation and place in the world, from those in each frame's camera.

    Args:
        root_pose: R_root, rotation vectors in the camera's axes.
        trans: metres, relative to ``pivot``.
        pivot: J_0, the root joint at rest, metres.
        rotation, translation: world-to-camera, R and t.

    Returns:
        global_orient G [T, 3] and transl [T, 3], float64.
    """
    rotation, pivot = rotation.double(), pivot.double()
    orient = roma.rotmat_to_rotvec(rotation.mT @ roma.rotvec_to_rotmat(root_pose.double()))
    pelvis = (pivot + trans.double() - translation.double())[:, None] @ rotation
    return orient, pelvis[:, 0] - pivot


def into_camera(
    global_orient: Tensor,  # [T, 3]
    transl: Tensor,  # [T, 3]
    pivot: Tensor,  # [3]
    rotation: Tensor,  # [T, 3, 3]
    translation: Tensor,  # [T, 3]
) -> tuple[Tensor, Tensor]:
    """The inverse of ``into_world``: root_pose and trans, [T, 3] each, float64."""
    rotation, pivot = rotation.double(), pivot.double()
    root_pose = roma.rotmat_to_rotvec(rotation @ roma.rotvec_to_rotmat(global_orient.double()))
    pelvis = (pivot + transl.double())[:, None] @ rotation.mT
    return root_pose, pelvis[:, 0] + translation.double() - pivot


def moved_pivot(
    global_orient: Tensor,  # [T, 3]
    transl: Tensor,  # [T, 3]
    pivot: Tensor,  # [3]
    other: Tensor,  # [3]
) -> Tensor:
    """The transl with which a body that turns about ``other`` is where one that turns about ``pivot`` is.

    Returns:
        [T, 3], metres, float64.
    """
    turn = roma.rotvec_to_rotmat(global_orient.double()) - torch.eye(3, dtype=torch.float64)
    return transl.double() + (turn @ (other - pivot).double()[:, None])[..., 0]
