"""SMPL's, SMPL-H's and SMPL-X's poses as archives of arrays hold them: names, shapes, and whose joints.

``poses`` holds everything, J joints in the model's order: 22 (root and body), 24 (SMPL; its two hands are
left out), 52 (SMPL-H: 30 of the hands after the body), 55 (SMPL-X: jaw and two eyes before the hands). Or
root, body, and what else there is have arrays of their own. Any of them is [T, 3 J] or [T, J, 3], rotation
vectors in radians, or [T, J, 3, 3], rotation matrices.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import JOINT_NAMES
from pipeline.errors import UserError

REMEDY = "name an AMASS or SMPL-X motion with poses (or root_orient and pose_body) and trans"
LARGEST = 1e4  # radians and metres

_POSES = ("poses", "fullpose", "full_pose", "smpl_poses", "pose")
_ROOT = ("root_orient", "global_orient")
_BODY = ("pose_body", "body_pose")
_BODY_JOINTS, _FACE_JOINTS, _HAND_JOINTS = slice(1, 22), slice(22, 25), slice(25, 55)
_LAYOUTS = {22: (_BODY_JOINTS,), 24: (_BODY_JOINTS,), 52: (_BODY_JOINTS, _HAND_JOINTS),
            55: (_BODY_JOINTS, _FACE_JOINTS, _HAND_JOINTS)}  # fmt: skip
_PARTS: Mapping[tuple[str, ...], slice] = {  # names -> joints
    _BODY: _BODY_JOINTS, ("pose_jaw", "jaw_pose"): slice(22, 23), ("pose_eye",): slice(23, 25),
    ("leye_pose",): slice(23, 24), ("reye_pose",): slice(24, 25), ("pose_hand",): _HAND_JOINTS,
    ("left_hand_pose",): slice(25, 40), ("right_hand_pose",): slice(40, 55),
}  # fmt: skip
_SMPL_BODY = 23  # joints; the last two are the hands
_ORTHOGONAL = 0.02  # how far a matrix times its transpose may be from the identity


@dataclasses.dataclass(frozen=True)
class PoseArrays:
    """The poses of an archive.

    Attributes:
        rotation: [T, 55, 3] float64, rotation vectors; zero where the archive tells nothing.
        told: the joints that it tells of.
        notes: what could not be used, a sentence each.
    """

    rotation: Tensor
    told: tuple[str, ...]
    notes: tuple[str, ...]


def pose_members(names: Collection[str]) -> set[str]:
    """Those of an archive's names that ``read_pose_arrays`` needs."""
    whole = first(_POSES, names)
    if whole is not None:
        return {whole}
    return {name for one in (_ROOT, *_PARTS) for name in [first(one, names)] if name is not None}


def read_pose_arrays(path: Path, arrays: Mapping[str, Any]) -> PoseArrays:
    """An archive's poses.

    Raises:
        UserError: it has none, or their shapes or numbers are no poses'.
    """
    whole = first(_POSES, arrays)
    if whole is not None:
        poses = _rotation_vectors(path, arrays, whole)
        if poses is None or poses.shape[1] not in _LAYOUTS:
            sizes = ", ".join(str(3 * joints) for joints in _LAYOUTS)
            raise _refuse_shape(path, whole, arrays, f"[frames, one of {sizes}], or [frames, joints, 3]")
        parts = _LAYOUTS[poses.shape[1]]
        joints = (0, *(joint for part in parts for joint in range(part.start, part.stop)))
        return _gathered(path, {joints: poses[:, : len(joints)]}, [])
    root = first(_ROOT, arrays)
    body = first(_BODY, arrays)
    if root is None or body is None:
        missing = _ROOT if root is None else _BODY
        raise UserError(f"{path} has no array '{missing[0]}' (or '{missing[1]}') and no 'poses': {REMEDY}")
    found: dict[tuple[int, ...], np.ndarray] = {(0,): _part(path, arrays, root, 1)}
    notes = []
    for names, part in _PARTS.items():
        name = first(names, arrays)
        if name is None:
            continue
        places = tuple(range(part.start, part.stop))
        if _are_coefficients(arrays[name], name):
            notes.append(f"{name} of {path.name} holds coefficients of hands, which are not used")
            continue
        found[places] = _part(path, arrays, name, len(places))
    return _gathered(path, found, notes)


def first(names: Collection[str], among: Collection[str]) -> str | None:
    """The first of some names that is there."""
    return next((name for name in names if name in among), None)


def numbers(path: Path, arrays: Mapping[str, Any], name: str) -> np.ndarray:
    """An array of numbers as float64; UserError where it holds others, or absurd ones."""
    array = arrays.get(name)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise UserError(f"{path}: '{name}' is no array of numbers: {REMEDY}")
    array = array.astype(np.float64)
    if not np.isfinite(array).all() or (array.size and np.abs(array).max() > LARGEST):
        raise UserError(f"{path}: {name} holds numbers that no motion has: {REMEDY}")
    return array


def _gathered(path: Path, parts: Mapping[tuple[int, ...], np.ndarray], notes: list[str]) -> PoseArrays:
    counts = {len(values) for values in parts.values()}
    if len(counts) > 1:
        raise UserError(f"{path}: its arrays have {' and '.join(map(str, sorted(counts)))} frames: {REMEDY}")
    if 0 in counts:
        raise UserError(f"{path} has no frames: {REMEDY}")
    rotation = np.zeros((*counts, len(JOINT_NAMES), 3))
    for places, values in parts.items():
        rotation[:, list(places)] = values
    told = sorted({joint for places in parts for joint in places})
    return PoseArrays(torch.from_numpy(rotation), tuple(JOINT_NAMES[joint] for joint in told), tuple(notes))


def _part(path: Path, arrays: Mapping[str, Any], name: str, joints: int) -> np.ndarray:
    """An array of some joints, [T, joints, 3]."""
    values = _rotation_vectors(path, arrays, name)
    if values is not None and name in _BODY and values.shape[1] == _SMPL_BODY:
        values = values[:, :joints]
    if values is None or values.shape[1] != joints:
        raise _refuse_shape(path, name, arrays, f"[frames, {3 * joints}], or [frames, {joints}, 3]")
    return values


def _rotation_vectors(path: Path, arrays: Mapping[str, Any], name: str) -> np.ndarray | None:
    """An array as rotation vectors [T, J, 3]; None where its shape is no such thing's."""
    values = numbers(path, arrays, name)
    if values.ndim == 3 and values.shape[1:] == (3, 3):  # no part has three joints: one matrix a frame
        values = values[:, None]
    if values.ndim == 4 and values.shape[2:] == (3, 3):
        return _vectors_of_matrices(path, name, values)
    if values.ndim == 3 and values.shape[2] == 3:
        return values
    if values.ndim == 2 and values.shape[1] % 3 == 0 and values.shape[1]:
        return values.reshape(len(values), values.shape[1] // 3, 3)
    return None


def _vectors_of_matrices(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    matrices = torch.from_numpy(values)
    off = (matrices @ matrices.mT - torch.eye(3, dtype=torch.float64)).abs()
    if values.size and not (off.max() < _ORTHOGONAL and (torch.linalg.det(matrices) > 0).all()):
        raise UserError(f"{path}: {name} holds matrices that are no rotations: {REMEDY}")
    return roma.rotmat_to_rotvec(roma.special_procrustes(matrices)).numpy() if values.size else values[..., 0]


def _are_coefficients(values: Any, name: str) -> bool:
    """True for hands as a few coefficients of their principal components, [T, up to 24]."""
    width = values.shape[1] if isinstance(values, np.ndarray) and values.ndim == 2 else 0
    return "hand" in name and 0 < width < 45


def _refuse_shape(path: Path, name: str, arrays: Mapping[str, Any], wanted: str) -> UserError:
    return UserError(f"{path}: {name} has shape {arrays[name].shape}, not {wanted}: {REMEDY}")
