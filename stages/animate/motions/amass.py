"""AMASS's archives of motion, and SMPL-X motion in archives of that style.

========================  ===========================================================================
``poses``                 [T, 156] (SMPL-H: root, 21 body joints, 30 of the hands), [T, 165] (SMPL-X:
                          jaw and two eyes before the hands) or [T, 66] and [T, 72] (root and body; SMPL's
                          two hands are left out), rotation vectors in radians
or, instead of it         ``root_orient`` [T, 3], ``pose_body`` [T, 63], and, if they are there,
                          ``pose_jaw`` [T, 3], ``pose_eye`` [T, 6], ``pose_hand`` [T, 90]
``trans``                 [T, 3], metres: the model's translation (``transl`` here)
``betas``                 shape, of the first 16 at most; one row a frame is allowed
``expression(s)``         [T, E], which only the official SMPL-X can read
``mocap_framerate``       frames a second, also ``mocap_frame_rate``, ``fps``; 30 if there is none
========================  ===========================================================================

AMASS's world is Z up. Whoever stands upright there has a root that turns the model's Y axis to Z, and that
is how it is told which axis is up: the one that the root's Y axis points along on average. A Z-up world is
turned by -90 degrees about X: (x, y, z) becomes (x, z, -y). Hands are rotations from flat hands, as AMASS has
them. Nothing is unpickled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import JOINT_NAMES, BodyModel
from pipeline.errors import UserError
from pipeline.pose_files import is_official_smplx
from pipeline.untrusted import read_npz
from stages.animate.motions.motion import USUAL_FPS, Motion, Span, leg_length

_REMEDY = "name an AMASS or SMPL-X motion with poses (or root_orient and pose_body) and trans"
_BODY, _FACE, _HANDS = slice(1, 22), slice(22, 25), slice(25, 55)
_LAYOUTS = {66: (_BODY,), 72: (_BODY,), 156: (_BODY, _HANDS), 165: (_BODY, _FACE, _HANDS)}
_PARTS = {"pose_body": _BODY, "pose_jaw": slice(22, 23), "pose_eye": slice(23, 25), "pose_hand": _HANDS}
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate")
_EXPRESSIONS = ("expressions", "expression")
_LARGEST = 1e4  # radians and metres
_BETAS = 16


def read_amass(path: Path, body: BodyModel, span: Span, up: str = "auto") -> Motion:
    """Reads an archive.

    Args:
        body: whose expressions and shapes the numbers may belong to.
        span: which frames are wanted.
        up: the axis that is up in the file: y, z or auto.

    Raises:
        UserError: it is damaged, lacks what a motion needs, or has no frame in the span.
    """
    arrays = read_npz(path, _REMEDY)
    rotation, told = _rotations(path, arrays)
    count = len(rotation)
    own_fps, notes = _rate(path, arrays), []
    if own_fps is None:
        own_fps = USUAL_FPS
        notes.append(f"{path.name} does not say how many frames a second it has: {USUAL_FPS:g} are taken")
    root = torch.zeros(count, 3, dtype=torch.float64)
    if "trans" in arrays:
        root = torch.from_numpy(_array(path, arrays, "trans", count, 3))
    else:
        notes.append(f"{path.name} has no trans: the body stays in its place")
    rows, fps = span.rows(count, own_fps, path.name)
    rotation, root = rotation[rows], root[rows]
    if _z_is_up(rotation[:, 0], up):
        rotation, root = _upright(rotation, root)
        notes.append(f"{path.name} is Z up and was turned to Y up")
    return Motion(
        name=path.name,
        fps=fps,
        numbers=tuple(rows.tolist()),
        rotation=rotation.float(),
        expression=_expression(path, arrays, body, count, rows),
        root=root.float(),
        leg=leg_length(body, betas=_betas(path, arrays) if is_official_smplx(body) else None),
        told=told,
        notes=tuple(notes),
    )


def _rotations(path: Path, arrays: Mapping[str, Any]) -> tuple[Tensor, tuple[str, ...]]:
    """All frames' rotation vectors [T, 55, 3] float64, and the joints that the file tells of."""
    if "poses" in arrays:
        poses = _array(path, arrays, "poses")
        parts = _LAYOUTS.get(poses.shape[1] if poses.ndim == 2 else 0)
        if parts is None:
            sizes = ", ".join(map(str, _LAYOUTS))
            raise UserError(f"{path}: poses has shape {poses.shape}, not [frames, one of {sizes}]: {_REMEDY}")
        found = {"root_orient": poses[:, :3]}
        taken, column = {}, 3
        for part in parts:
            width = 3 * (part.stop - part.start)
            taken[part.start] = (part, poses[:, column : column + width])
            column += width
    else:
        found = {"root_orient": _array(path, arrays, "root_orient", None, 3)}
        taken = {}
        for name, part in _PARTS.items():
            if name in arrays or name == "pose_body":
                width = 3 * (part.stop - part.start)
                taken[part.start] = (part, _array(path, arrays, name, len(found["root_orient"]), width))
    root = found["root_orient"]
    if not len(root):
        raise UserError(f"{path} has no frames: {_REMEDY}")
    rotation = np.zeros((len(root), len(JOINT_NAMES), 3))
    rotation[:, 0] = root
    told = [JOINT_NAMES[0]]
    for part, values in taken.values():
        rotation[:, part] = values.reshape(len(root), -1, 3)
        told += JOINT_NAMES[part]
    return torch.from_numpy(rotation), tuple(told)


def _array(
    path: Path, arrays: Mapping[str, Any], name: str, rows: int | None = None, columns: int | None = None
) -> np.ndarray:
    """An array of numbers as float64; UserError where it is missing, of another shape, or absurd."""
    array = arrays.get(name)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise UserError(f"{path} has no array '{name}': {_REMEDY}")
    array = array.astype(np.float64)
    wrong = columns is not None and (array.ndim != 2 or array.shape[1] != columns)
    if wrong or (rows is not None and len(array) != rows):
        raise UserError(
            f"{path}: {name} has shape {array.shape}, not [{rows or 'frames'}, {columns}]: {_REMEDY}"
        )
    if not np.isfinite(array).all() or (array.size and np.abs(array).max() > _LARGEST):
        raise UserError(f"{path}: {name} holds numbers that no motion has: {_REMEDY}")
    return array


def _rate(path: Path, arrays: Mapping[str, Any]) -> float | None:
    """Frames a second; None where the file does not say."""
    name = next((name for name in _RATES if name in arrays), None)
    if name is None:
        return None
    try:
        rate = float(np.asarray(arrays[name], np.float64).reshape(-1)[0])
    except (TypeError, ValueError, IndexError):
        rate = math.nan
    if not 0.1 <= rate <= 10_000:
        raise UserError(f"{path}: {name} is no number of frames a second: {_REMEDY}")
    return rate


def _betas(path: Path, arrays: Mapping[str, Any]) -> Tensor | None:
    if "betas" not in arrays:
        return None
    betas = _array(path, arrays, "betas")
    one = betas[0] if betas.ndim == 2 and len(betas) else betas
    return torch.from_numpy(one.reshape(-1)[:_BETAS]).float()


def _expression(
    path: Path, arrays: Mapping[str, Any], body: BodyModel, count: int, rows: np.ndarray
) -> Tensor | None:
    """The wanted frames' expressions [T, E], if they mean something to this body."""
    name = next((name for name in _EXPRESSIONS if name in arrays), None)
    if name is None or not is_official_smplx(body):
        return None
    values = _array(path, arrays, name, count)
    return torch.from_numpy(values.reshape(count, -1)[rows]).float()


def _z_is_up(root: Tensor, up: str) -> bool:
    """True if Z is the world's up axis; root [T, 3] rotation vectors."""
    if up != "auto":
        return up == "z"
    upward = roma.rotvec_to_rotmat(root)[:, :, 1].mean(0)  # where the body's own Y axis points
    return bool(upward[2] > upward[1])


def _upright(rotation: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:
    """A Z-up motion in a Y-up world."""
    turn = roma.rotvec_to_rotmat(torch.tensor([-math.pi / 2, 0.0, 0.0], dtype=torch.float64))
    turned = rotation.clone()
    turned[:, 0] = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(rotation[:, 0]))
    return turned, root @ turn.mT
