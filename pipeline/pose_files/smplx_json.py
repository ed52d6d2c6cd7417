"""Reading a folder of SMPL-X parameters, a JSON file a frame."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.clip.frame_files import ClipFrames, frame_files
from pipeline.errors import UserError
from pipeline.files.text_encoding import decode_text
from pipeline.pose_files.camera_frame import HAND_JOINTS
from pipeline.pose_files.initial_poses import InitialPoses, on_frames

_ROTATIONS = {  # name -> numbers, in the order of the schema's joints
    "root_pose": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3,
    "lhand_pose": 45, "rhand_pose": 45,
}  # fmt: skip
_NEEDED = ("root_pose", "body_pose")
_VECTORS = {"trans": 3, "expr": None, "shape": None}  # None: any length up to _LONGEST
_LONGEST = 400
_LARGEST = {"trans": 1e4, "expr": 1e3, "shape": 1e3}  # metres, units, units; rotations: radians
_LARGEST_ANGLE = 100.0
_MEGABYTE = 1 << 20  # a frame's parameters are some 5 kB
_REMEDY = "name the folder of SMPLest-X's smplx_init/<frame>.json, or leave fit.pose_init empty"


def read_smplx_json(
    folder: Path,
    frames: Sequence[int],
    hand_mean: Tensor,
    log: Callable[[str], None] = lambda note: None,
    clip: ClipFrames | None = None,
    counted_from: int | None = None,
) -> InitialPoses:
    """Read the poses of some frames.

    A frame without a file, or whose file holds null or NaN because the estimator found nobody, takes its
    pose from its neighbours: rotations along the shortest arc, the rest linearly.

    Args:
        folder: holds a file a frame, named as ``pipeline.clip.frame_files`` says.
        frames: the T frame numbers, increasing.
        hand_mean: [30, 3], what the hands are relative to, from ``read_hand_mean``.
        log: told in a line each how files were matched and how many frames had to be interpolated.
        clip: all frames of the source; None: the names' numbers are frame numbers.
        counted_from: the first frame's number where the user says so.

    Raises:
        UserError: no frame has a usable file, or a file is malformed.
    """
    known = read_known_poses(folder, frames, clip, counted_from, log)
    if len(known.frames) < len(frames):
        missing = len(frames) - len(known.frames)
        log(f"{folder}: no usable pose of {missing} of {len(frames)} frames, interpolated")
    rotation = known.rotation.clone()
    rotation[:, HAND_JOINTS] += hand_mean.to(rotation)
    return on_frames(dataclasses.replace(known, rotation=rotation, hands="flat"), frames)


def read_known_poses(
    folder: Path,
    frames: Sequence[int] | None = None,
    clip: ClipFrames | None = None,
    counted_from: int | None = None,
    log: Callable[[str], None] = lambda note: None,
) -> InitialPoses:
    """Read the poses that a folder has, with hands relative to the model's mean.

    Args:
        folder: holds a file a frame, named as ``pipeline.clip.frame_files`` says.
        frames: the frame numbers that are wanted; all by default.
        clip, counted_from: as for ``read_smplx_json``.
        log: told in one line how files were matched, where ``clip`` says of what.

    Returns:
        Poses of the frames whose file is usable, float64.

    Raises:
        UserError: as ``read_smplx_json``.
    """
    paths = _by_frame(folder, clip, counted_from, log)
    wanted = list(paths) if frames is None else list(frames)
    read = {frame: _read_frame(paths[frame]) for frame in wanted if frame in paths}
    usable = {frame: values for frame, values in read.items() if values is not None}
    if not usable:
        found = f"has poses of {len(read)} of the clip's {len(wanted)} frames, none usable"
        raise UserError(f"{folder} {found}: {_REMEDY}")
    usable = dict(sorted(usable.items()))
    expression, transl, shape = (_vectors(name, usable, paths) for name in ("expr", "trans", "shape"))
    return InitialPoses(
        frames=tuple(usable),
        rotation=_rotations(usable),
        expression=expression,
        betas=None if shape is None else shape.median(dim=0).values,
        transl=transl,
        valid=torch.ones(len(usable), dtype=torch.bool),
        hands="mean",
    )


def _by_frame(
    folder: Path, clip: ClipFrames | None, counted_from: int | None, log: Callable[[str], None]
) -> dict[int, Path]:
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder: {_REMEDY}")
    return frame_files(folder, (".json",), clip, counted_from, log)


def _read_frame(path: Path) -> dict[str, np.ndarray] | None:
    """A file's arrays by name, flat; None if one that is there has an empty place."""
    try:
        if not path.is_file():
            raise ValueError("it is no regular file")
        if path.stat().st_size > _MEGABYTE:
            raise ValueError("it is larger than 1 MB")
        # Here alone NaN is no damage: some estimators write it where they found nobody.
        value = json.loads(decode_text(path.read_bytes()), parse_float=_finite)
        if not isinstance(value, dict):
            raise ValueError("it is no JSON object")
        missing = [name for name in _NEEDED if name not in value]
        if missing:
            raise ValueError(f"it has no {missing[0]}")
        lengths = _ROTATIONS | _VECTORS
        arrays = {name: _numbers(name, value[name], lengths[name]) for name in lengths if name in value}
    except (OSError, ValueError, RecursionError) as error:
        reason = "it is nested too deep" if isinstance(error, RecursionError) else error
        raise UserError(f"{path} does not hold a frame's SMPL-X parameters ({reason}): {_REMEDY}") from None
    return arrays if all(np.isfinite(array).all() for array in arrays.values()) else None


def _finite(text: str) -> float:
    """A number that JSON wrote out; the words NaN and Infinity do not come here."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is too large a number")
    return number


def _numbers(name: str, value: Any, count: int | None) -> np.ndarray:
    """A list of numbers or of lists of numbers, flat; NaN where it holds null or is null.

    Raises:
        ValueError: anything else, another length, or a number no pose has.
    """
    if value is None:
        return np.full(count or 1, np.nan)
    flat = []
    for item in value if isinstance(value, list) else [value]:
        flat.extend(item if isinstance(item, list) else [item])
    if any(not (number is None or type(number) in (int, float)) for number in flat):
        raise ValueError(f"{name} is no list of numbers, or of lists of numbers")
    if len(flat) != count if count is not None else not 1 <= len(flat) <= _LONGEST:
        wanted = count if count is not None else f"1 to {_LONGEST}"
        raise ValueError(f"{name} has {len(flat)} numbers, not {wanted}")
    limit = _LARGEST.get(name, _LARGEST_ANGLE)
    if any(number is not None and limit < abs(number) < math.inf for number in flat):
        raise ValueError(f"{name} has numbers beyond {limit:g}")
    return np.array([math.nan if number is None else number for number in flat], np.float64)


def _rotations(usable: dict[int, dict[str, np.ndarray]]) -> Tensor:
    """The usable frames' rotation vectors as they are in the files, zero where one is missing: [N, 55, 3]."""
    rows = [
        np.concatenate([arrays.get(name, np.zeros(count)) for name, count in _ROTATIONS.items()])
        for arrays in usable.values()
    ]
    return torch.from_numpy(np.stack(rows)).unflatten(1, (-1, 3))


def _vectors(name: str, usable: dict[int, dict[str, np.ndarray]], paths: dict[int, Path]) -> Tensor | None:
    """One row a usable frame: [N, K]; None if a frame does not have it."""
    if not all(name in arrays for arrays in usable.values()):
        return None
    first = next(iter(usable))
    length = len(usable[first][name])
    for frame, arrays in usable.items():
        if len(arrays[name]) != length:
            found = f"{len(arrays[name])} numbers in {name}, {paths[first].name} {length}"
            raise UserError(f"{paths[frame]} has {found}: all frames must come from one program")
    return torch.from_numpy(np.stack([arrays[name] for arrays in usable.values()]))
