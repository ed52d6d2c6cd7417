"""SMPL's 72 pose numbers as the poses of the project.

SMPL has 24 joints, 3 numbers each, a rotation vector in radians relative to the parent. The root and the 21
joints after it are SMPL-X's root and body joints in the same order; joints 22 and 23, the hands as one piece,
have no counterpart and are left out (Loper et al. 2015, Pavlakos et al. 2019). Hands begin relaxed, jaw and
eyes closed and straight. Both models rest in a T pose, so the rotations carry over; the shapes do not.

The pelvis does: SMPL turns about its root joint J_0, which lies elsewhere in its model's axes than SMPL-X's
does, about 13 cm higher. So places are handed on as those of the root joint, with SMPL's J_0 beside them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pipeline.pose_files import InitialPoses

ROOT = np.array([-0.0018, -0.2233, 0.0282])
"""J_0 of SMPL's neutral mean body at rest, metres. A person's own differs by some mm to 2 cm."""


def smpl_poses(
    frames: Sequence[int],
    poses: np.ndarray,  # [T, 72]
    root: np.ndarray,  # [T, 3, 3]
    pelvis: np.ndarray,  # [T, 3]
    betas: np.ndarray,  # [B]
) -> InitialPoses:
    """Poses of SMPL in each frame's camera.

    Args:
        frames: T frame numbers.
        poses: theta, radians; the first three of each are not looked at.
        root: the root's rotation, model to camera axes.
        pelvis: the root joint in the camera's axes, metres.
        betas: SMPL's shape, kept for the record: it means nothing to SMPL-X.
    """
    count = len(frames)
    rotation = np.zeros((count, 55, 3))
    rotation[:, 0] = Rotation.from_matrix(root).as_rotvec()
    rotation[:, 1:22] = poses[:, 3:66].reshape(count, 21, 3)
    return InitialPoses(
        frames=tuple(frames),
        rotation=torch.from_numpy(rotation),
        expression=None,
        betas=torch.from_numpy(np.asarray(betas, np.float64)),
        transl=torch.from_numpy(pelvis - ROOT),
        valid=torch.ones(count, dtype=torch.bool),
        pivot=torch.from_numpy(ROOT).float(),
        hands="mean",
        model="smpl",
    )
