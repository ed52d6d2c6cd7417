"""AMASS's archives of motion, and SMPL-X motion in archives of that style.

========================  ===========================================================================
``poses``                 all joints of SMPL, SMPL-H or SMPL-X, see ``pose_arrays``
or, instead of it         ``root_orient`` and ``pose_body``, and, if they are there, ``pose_jaw``,
                          ``pose_eye``, ``pose_hand``; also by the names of the ``smplx`` package
                          (``global_orient``, ``body_pose``, ``left_hand_pose``, ...)
``trans``                 [T, 3], metres: the model's translation (also ``transl``)
``betas``                 shape, of the first 16 at most; one row a frame is allowed
``expression(s)``         [T, E], which only the official SMPL-X can read
``mocap_framerate``       frames a second, also ``mocap_frame_rate``, ``fps``; 30 if there is none
========================  ===========================================================================

What else an archive holds (``gender``, markers, labels) is not looked at. Nothing is unpickled.

AMASS's world is Z up; others are Y up, or -Y where a camera's axes were kept. Whoever stands upright there
has a root that turns the model's Y axis to the axis that is up, and that is how it is told: by where the
root's Y axis points on average. The world is turned to Y up, a Z-up one by -90 degrees about X: (x, y, z)
becomes (x, z, -y). Hands are rotations from flat hands, as AMASS has them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import BodyModel
from pipeline.config.choices import Up, UpAxis
from pipeline.errors import UserError
from pipeline.motion.up_axis import nearest_axis, turn_to_y
from pipeline.pose_files import is_official_smplx
from pipeline.untrusted import read_npz
from stages.animate.motions.motion import USUAL_FPS, Motion, Span, leg_length
from stages.animate.motions.pose_arrays import REMEDY, first, numbers, pose_members, read_pose_arrays

_TRANS = ("trans", "transl", "smpl_trans", "translation")
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate", "framerate")
_EXPRESSIONS = ("expressions", "expression")
_BETAS = 16
_WORLDS: tuple[UpAxis, ...] = ("z", "y", "-y")
_STANDS = 0.5  # mean cosine between the root's Y axis and an axis under which it leaves doubt


def read_amass(path: Path, body: BodyModel, span: Span, up: Up = "auto") -> Motion:
    """Reads an archive.

    Args:
        body: whose expressions and shapes the numbers may belong to.
        span: which frames are wanted.
        up: the axis that is up in the file, or auto.

    Raises:
        UserError: it is damaged, lacks what a motion needs, or has no frame in the span.
    """
    official = is_official_smplx(body)
    arrays = read_npz(path, REMEDY, choose=lambda names: _needed(names, official))
    poses = read_pose_arrays(path, arrays)
    rotation, notes = poses.rotation, list(poses.notes)
    count = len(rotation)
    own_fps = _rate(path, arrays)
    if own_fps is None:
        own_fps = USUAL_FPS
        notes.append(f"{path.name} does not say how many frames a second it has: {USUAL_FPS:g} are taken")
    root = _trans(path, arrays, count)
    if root is None:
        root = torch.zeros(count, 3, dtype=torch.float64)
        notes.append(f"{path.name} has no trans: the body stays in its place")
    rows, fps = span.rows(count, own_fps, path.name)
    rotation, root = rotation[rows], root[rows]
    axis, note = _up(rotation[:, 0], up)
    if axis != "y":
        rotation, root = _upright(rotation, root, axis)
        note += " and was turned to Y up"
    return Motion(
        name=path.name,
        fps=fps,
        numbers=tuple(rows.tolist()),
        rotation=rotation.float(),
        expression=_expression(path, arrays, count, rows),
        root=root.float(),
        leg=leg_length(body, betas=_betas(path, arrays)),
        told=poses.told,
        notes=(*notes, f"{path.name} is {note}"),
    )


def _needed(names: Collection[str], official: bool) -> set[str]:
    """The members that are read; shape and expression belong to the official body alone."""
    wanted = [_TRANS, _RATES, *([("betas",), _EXPRESSIONS] if official else [])]
    return pose_members(names) | {name for one in wanted for name in [first(one, names)] if name is not None}


def _trans(path: Path, arrays: Mapping[str, Any], count: int) -> Tensor | None:
    """The model's translation [T, 3]; None where the file has none."""
    name = first(_TRANS, arrays)
    if name is None:
        return None
    values = numbers(path, arrays, name)
    if values.size != 3 * count or values.shape[0] != count or values.shape[-1] != 3:
        raise UserError(f"{path}: {name} has shape {values.shape}, not [{count}, 3]: {REMEDY}")
    return torch.from_numpy(values.reshape(count, 3))


def _rate(path: Path, arrays: Mapping[str, Any]) -> float | None:
    """Frames a second; None where the file does not say."""
    name = first(_RATES, arrays)
    if name is None:
        return None
    try:
        rate = float(np.asarray(arrays[name], np.float64).reshape(-1)[0])
    except (TypeError, ValueError, IndexError):
        rate = math.nan
    if not 0.1 <= rate <= 10_000:
        raise UserError(f"{path}: {name} is no number of frames a second: {REMEDY}")
    return rate


def _betas(path: Path, arrays: Mapping[str, Any]) -> Tensor | None:
    if "betas" not in arrays:
        return None
    betas = numbers(path, arrays, "betas")
    one = betas[0] if betas.ndim == 2 and len(betas) else betas
    return torch.from_numpy(one.reshape(-1)[:_BETAS]).float()


def _expression(path: Path, arrays: Mapping[str, Any], count: int, rows: np.ndarray) -> Tensor | None:
    """The wanted frames' expressions [T, E], if there are any."""
    name = first(_EXPRESSIONS, arrays)
    if name is None:
        return None
    values = numbers(path, arrays, name)
    if values.ndim < 2 or len(values) != count:
        raise UserError(f"{path}: {name} has shape {values.shape}, not [{count}, numbers]: {REMEDY}")
    return torch.from_numpy(values.reshape(count, -1)[rows]).float()


def _up(root: Tensor, up: Up) -> tuple[UpAxis, str]:
    """The axis that is up in the world of rotation vectors [T, 3], and what says so."""
    if up != "auto":
        return up, f"{up.upper()} up, as it was said,"
    upward = roma.rotvec_to_rotmat(root)[:, :, 1].mean(0)  # where the body's own Y axis points
    axis, share = nearest_axis(upward, _WORLDS)
    doubt = "" if share >= _STANDS else " (in doubt: its body hardly stands; animate.up= says it)"
    return axis, f"{axis.upper()} up{doubt}"


def _upright(rotation: Tensor, root: Tensor, up: UpAxis) -> tuple[Tensor, Tensor]:
    """A motion in a Y-up world."""
    turn = turn_to_y(up)
    turned = rotation.clone()
    turned[:, 0] = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(rotation[:, 0]))
    return turned, root @ turn.mT
