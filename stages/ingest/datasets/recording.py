"""What an adapter makes of a dataset's folder, and what adapters share."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from stages.ingest.cameras.calibration import Calibration
from stages.ingest.video import PICTURES, Clip, read_picture

STEP = 100_000
"""Frame numbers of the n-th further shot begin at n times this."""


@dataclasses.dataclass(frozen=True)
class Shot:
    """One camera's footage and what came with it; None where nothing did.

    Attributes:
        clip: the footage; its frame numbers are those of everything else here, and of no other shot.
        calibration: cameras, by frame number or one that stands still.
        keypoints: frame number -> JSON file.
        masks: frame number -> picture.
        mask_kind: how those are read, see ``detections.MASK_KINDS``.
        poses: of some frames, roots in the axes of each frame's camera.
    """

    clip: Clip
    calibration: Calibration | None = None
    keypoints: Mapping[int, Path] | None = None
    masks: Mapping[int, Path] | None = None
    mask_kind: str = "white"
    poses: InitialPoses | None = None


@dataclasses.dataclass(frozen=True)
class Recording:
    """A dataset's folder.

    Attributes:
        layout: the adapter's name.
        shots: one, or several of one rig in one world.
        train, test: the layout's own split, frame numbers; None where it has none.
        notes: what a user should know, a line each.
    """

    layout: str
    shots: tuple[Shot, ...]
    train: frozenset[int] | None = None
    test: frozenset[int] | None = None
    notes: tuple[str, ...] = ()


def numbered(folder: Path, suffixes: Sequence[str] = PICTURES) -> dict[int, Path]:
    """Frame number -> file, sorted: the last run of digits in each name; empty without such a folder.

    Raises:
        UserError: two files of one frame.
    """
    found: dict[int, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else []:
        digits = re.findall(r"\d+", file.stem)
        if file.suffix.lower() not in suffixes or file.name.startswith(".") or not digits:
            continue
        number = int(digits[-1])  # what precedes it is the camera, the take or a word
        if number in found:
            raise UserError(f"{file} and {found[number].name} both name frame {number}: keep one")
        found[number] = file
    return dict(sorted(found.items()))


def folder_clip(path: Path, pictures: Mapping[int, Path], fps: float = 0.0) -> Clip:
    """A clip of numbered pictures.

    Raises:
        UserError: there are none, or the first is damaged.
    """
    if not pictures:
        raise UserError(f"{path} holds no pictures ({', '.join(PICTURES)}): unpack the dataset there")
    ordered = dict(sorted(pictures.items()))
    height, width = read_picture(next(iter(ordered.values()))).shape[:2]
    return Clip(path, width, height, fps, len(ordered), ordered)


def only(files: Mapping[int, Path], frames: Sequence[int] | Mapping[int, Any]) -> dict[int, Path] | None:
    """The files of some frames; None where there are none."""
    return {frame: file for frame, file in files.items() if frame in frames} or None


def numbers(value: Any, shape: tuple[int, ...], where: str, remedy: str) -> np.ndarray:
    """``value`` as finite float64 of a shape; -1 in it stands for any length.

    Raises:
        UserError: it is something else; ``where`` names file and entry.
    """
    try:
        array = np.asarray(value, np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{where} is not {list(shape)} numbers: {remedy}") from None
    if not np.isfinite(array).all():
        raise UserError(f"{where} is not finite: {remedy}")
    return array


def entry(table: Any, key: str, where: Path, remedy: str) -> Any:
    """``table[key]``; UserError where it is no table, or has no such entry."""
    if not isinstance(table, dict) or key not in table:
        raise UserError(f"{where} has no '{key}': {remedy}")
    return table[key]


def shifted(poses: InitialPoses | None, frames: Mapping[int, int]) -> InitialPoses | None:
    """The poses under other frame numbers, old -> new; others are left out."""
    if poses is None:
        return None
    rows = [row for row, frame in enumerate(poses.frames) if frame in frames]
    if not rows:
        return None
    chosen = torch.tensor(rows)
    names = ("rotation", "expression", "transl", "valid", "hand_pca")
    parts = {n: getattr(poses, n)[chosen] for n in names if getattr(poses, n) is not None}
    return dataclasses.replace(poses, frames=tuple(frames[poses.frames[row]] for row in rows), **parts)
