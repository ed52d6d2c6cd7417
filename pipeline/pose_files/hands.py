"""Hands of other programs as rotation vectors relative to flat hands.

SMPL-X files hold hands relative to the mean of the model's file (``flat_hand_mean=False``), and often as a
few coefficients of its principal components: pose = mean + coefficients @ components[:P], which is how the
``smplx`` package builds them. The components are in the licensed file alone: without it such hands begin at
the body's mean hand.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import UserError
from pipeline.pose_files.camera_frame import HAND_JOINTS
from pipeline.pose_files.initial_poses import InitialPoses


def with_flat_hands(
    poses: InitialPoses, body_file: Path, official: bool, log: Callable[[str], None] = lambda note: None
) -> InitialPoses:
    """The same poses with hands relative to flat hands.

    Args:
        body_file: the body model's file, for mean and components.
        official: whether the file is SMPL-X's, whose components the coefficients belong to.
        log: told in a line if the hands' coefficients could not be used.

    Raises:
        UserError: the file cannot be read.
    """
    rotation = poses.rotation.clone()
    if poses.hands == "mean" or poses.hand_pca is not None:
        rotation[:, HAND_JOINTS] += read_hand_mean(body_file).to(rotation)
    if poses.hand_pca is not None:
        components = _components(body_file) if official else None
        if components is None:
            log(
                f"the hands are {poses.hand_pca.shape[-1]} coefficients of SMPL-X's hand components, which "
                f"{body_file.name} does not have: they begin relaxed; body=SMPLX_NEUTRAL.npz reads them"
            )
        else:
            count = min(poses.hand_pca.shape[-1], components.shape[1])
            coefficients = poses.hand_pca[..., :count].to(rotation)
            turned = torch.einsum("tsp,spk->tsk", coefficients, components[:, :count].to(rotation))
            rotation[:, HAND_JOINTS] += turned.reshape(len(rotation), 30, 3)
    return dataclasses.replace(poses, rotation=rotation, hands="flat", hand_pca=None)


def read_hand_mean(body_file: Path) -> Tensor:
    """The hand pose that a body file's hands are relative to in parameter files: [30, 3], radians.

    It belongs to the model that the parameters were made with. The open body's own is a relaxed hand as
    SMPL-X's is, but not the same: with it, estimates for the official model start with fingers that are
    a few tenths of a radian too straight. Zero if the file has none.

    Raises:
        UserError: the file cannot be read, or holds something else under these names.
    """
    remedy = "use data/body/open_body.npz or a SMPL-X model file"
    try:
        with np.load(body_file, allow_pickle=False) as archive:
            names = ("hands_meanl", "hands_meanr")
            if not all(name in archive.files for name in names):
                return torch.zeros(30, 3)
            means = np.concatenate([np.asarray(archive[name], np.float32).reshape(15, 3) for name in names])
    except (OSError, EOFError, ValueError, TypeError, AttributeError, BadZipFile) as error:
        raise UserError(f"{body_file}: its mean hand pose cannot be read ({error}): {remedy}") from None
    if not np.isfinite(means).all():
        raise UserError(f"{body_file}: its mean hand pose is not finite: {remedy}")
    return torch.from_numpy(means)


def _components(body_file: Path) -> Tensor | None:
    """[2, P, 45], left then right, a component a row; None where the file has none."""
    names = ("hands_componentsl", "hands_componentsr")
    try:
        with np.load(body_file, allow_pickle=False) as archive:
            if not all(name in archive.files for name in names):
                return None
            found = np.stack([np.asarray(archive[name], np.float64).reshape(-1, 45) for name in names])
    except (OSError, EOFError, ValueError, TypeError, BadZipFile) as error:
        raise UserError(f"{body_file}: its hand components cannot be read ({error}): get it again") from None
    return torch.from_numpy(found)
