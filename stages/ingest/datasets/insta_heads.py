"""FLAME's numbers of an INSTA subject, from the tracker's files or from the text files made of them.

::

    checkpoint/00012.frame    torch file: flame {exp, jaw, eyes, ...}, opencv {R, t, K}, img_size
    flame/exp/00012.txt       expression, a number a line (INSTA's scripts/transforms.py)
    flame/jaw/00012.txt       6 numbers, flame/eyes/00012.txt 12 (FATE's)

Expressions are FLAME's, whose first coefficients are what SMPL-X's expressions are built from. Jaw and eyes
are rotation vectors or the first two ROWS of a matrix (pytorch3d's six numbers), left eye first, as the
tracker's FLAME joins them (Zielon/metrical-tracker, flame/FLAME.py).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from pipeline.untrusted import read_lines, read_torch
from stages.ingest.cameras.calibration import CalibratedCamera, check_rotation
from stages.ingest.datasets.recording import entry, files_of, numbers, read_array
from stages.ingest.datasets.smplx_poses import initial_poses
from stages.ingest.video import Clip

_REMEDY = "unpack the INSTA subject again"
_FRAME_BYTES = 64 << 20


@dataclasses.dataclass(frozen=True)
class TrackedHead:
    """One frame's head.

    Attributes:
        rotation: [3, 3], the head's axes to the camera's, OpenCV.
        expression: [E], FLAME's.
        turns: [3, 3], rotation vectors of jaw, left eye and right eye, radians.
        intrinsics: [3, 3], pixels; None where the files do not say.
    """

    rotation: np.ndarray
    expression: np.ndarray
    turns: np.ndarray
    intrinsics: np.ndarray | None = None


def read_tracker(source: Path, clip: Clip) -> dict[int, TrackedHead]:
    """Frame number -> head, of ``checkpoint/``; UserError where a file is malformed."""
    files = files_of(source / "checkpoint", clip, (".frame",)) or {}
    return {frame: _tracked(path) for frame, path in files.items()}


def read_texts(source: Path, clip: Clip, views: Mapping[str, CalibratedCamera]) -> dict[int, TrackedHead]:
    """Frame number -> head, of ``flame/``, in the frames' cameras; UserError where a file is malformed."""
    files = files_of(source / "flame" / "exp", clip, (".txt",)) or {}
    turns = {key: files_of(source / "flame" / key, clip, (".txt",)) or {} for key in ("jaw", "eyes")}
    heads = {}
    for frame, path in files.items():
        if str(frame) not in views:
            continue
        flame = {key: _text(of[frame]) for key, of in turns.items() if frame in of}
        angles = [_rotation_vectors(flame, key, count, path) for key, count in (("jaw", 1), ("eyes", 2))]
        heads[frame] = TrackedHead(views[str(frame)].rotation, _text(path), np.concatenate(angles))
    return heads


def poses_of(heads: Mapping[int, TrackedHead]) -> InitialPoses | None:
    """Heads as the fit's start; None without any."""
    if not heads:
        return None
    rotation = np.zeros((len(heads), 55, 3))
    rotation[:, 0] = Rotation.from_matrix(np.stack([one.rotation for one in heads.values()])).as_rotvec()
    rotation[:, 22:25] = np.stack([one.turns for one in heads.values()])
    width = min(len(one.expression) for one in heads.values())
    expression = np.stack([one.expression[:width] for one in heads.values()])
    return initial_poses(list(heads), rotation, expression)


def _tracked(path: Path) -> TrackedHead:
    value = read_torch(path, _REMEDY, _FRAME_BYTES)
    flame, camera = entry(value, "flame", path, _REMEDY), entry(value, "opencv", path, _REMEDY)
    rotation = read_array(camera, "R", (3, 3), path, _REMEDY)
    read_array(camera, "t", (3,), path, _REMEDY)
    check_rotation(rotation, str(path))
    expression = read_array(flame, "exp", (-1,), path, _REMEDY)
    turns = [_rotation_vectors(flame, key, count, path) for key, count in (("jaw", 1), ("eyes", 2))]
    return TrackedHead(
        rotation, expression, np.concatenate(turns), read_array(camera, "K", (3, 3), path, _REMEDY)
    )


def _text(path: Path) -> np.ndarray:
    """The numbers of a text file, [N]."""
    words = [word for line in read_lines(path, _REMEDY, 10_000) for word in line.split()]
    return numbers(words, (-1,), str(path), _REMEDY)


def _rotation_vectors(flame: Any, key: str, count: int, path: Path) -> np.ndarray:
    """[count, 3]; zero where the file says nothing."""
    if key not in flame:
        return np.zeros((count, 3))
    flat = read_array(flame, key, (-1,), path, _REMEDY)
    if len(flat) == 3 * count:
        return flat.reshape(count, 3)
    rows = numbers(flat, (count, 2, 3), f"{path}, {key}", _REMEDY)
    first = rows[:, 0] / np.maximum(np.linalg.norm(rows[:, 0], axis=1, keepdims=True), 1e-9)
    second = rows[:, 1] - (rows[:, 1] * first).sum(1, keepdims=True) * first
    length = np.linalg.norm(second, axis=1, keepdims=True)
    if (length < 1e-6).any():
        raise UserError(f"{path}: '{key}' is no rotation: {_REMEDY}")
    second = second / length
    third = np.cross(first, second)
    return Rotation.from_matrix(np.stack([first, second, third], axis=1)).as_rotvec()
