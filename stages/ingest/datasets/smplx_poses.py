"""Poses of SMPL-X and SMPL from a dataset as the project's :class:`~pipeline.pose_files.InitialPoses`.

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

SMPL_ROOT = np.array([-0.0018, -0.2233, 0.0282])
"""J_0 of SMPL's neutral mean body at rest, metres. A person's own differs by some mm to 2 cm."""


def initial_poses(
    frames: Sequence[int],
    rotation: np.ndarray,  # [T, 55, 3]
    expression: np.ndarray | None = None,  # [T, E]
    betas: np.ndarray | None = None,  # [B]
    transl: np.ndarray | None = None,  # [T, 3]
    pivot: np.ndarray | None = None,  # [3]
    hands: np.ndarray | None = None,  # [T, 2, 45 or fewer]
    model: str = "smplx",
) -> InitialPoses:
    """Poses in each frame's camera, hands relative to the model's mean.

    Args:
        frames: T frame numbers.
        rotation: rotation vectors, radians; changed where ``hands`` are whole.
        expression, betas, transl, pivot, model: as in ``InitialPoses``; metres.
        hands: 45 numbers are rotation vectors of 15 joints, fewer are coefficients of SMPL-X's components.
    """
    count, pca = len(frames), hands
    if hands is not None and hands.shape[2] == 45:
        rotation[:, 25:] = hands.reshape(count, 30, 3)
        pca = None
    return InitialPoses(
        frames=tuple(frames),
        rotation=torch.from_numpy(rotation),
        expression=None if expression is None else torch.from_numpy(expression),
        betas=None if betas is None else torch.from_numpy(betas),
        transl=None if transl is None else torch.from_numpy(transl),
        valid=torch.ones(count, dtype=torch.bool),
        pivot=None if pivot is None else torch.from_numpy(pivot).float(),
        hands="mean",
        hand_pca=None if pca is None else torch.from_numpy(pca),
        model=model,
    )


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
        poses: theta, radians; the first three of each are ignored.
        root: the root's rotation, model to camera axes.
        pelvis: the root joint in the camera's axes, metres.
        betas: SMPL's shape, kept for the record: it means nothing to SMPL-X.
    """
    count = len(frames)
    rotation = np.zeros((count, 55, 3))
    rotation[:, 0] = Rotation.from_matrix(root).as_rotvec()
    rotation[:, 1:22] = poses[:, 3:66].reshape(count, 21, 3)
    shape = np.asarray(betas, np.float64)
    return initial_poses(frames, rotation, None, shape, pelvis - SMPL_ROOT, SMPL_ROOT, model="smpl")
