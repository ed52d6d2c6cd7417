"""A dataset's folder as footage with what came with it, and what the adapters share."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch

from pipeline.clip.frame_files import match_files
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from stages.ingest.cameras.calibration import Calibration, pinhole_lens
from stages.ingest.video import PICTURES, Clip, clip_frames


@dataclasses.dataclass(frozen=True)
class Shot:
    """One camera's footage and what came with it, None where nothing did.

    Attributes:
        clip: the footage; its frame numbers are those of everything else here, and of no other shot.
        calibration: cameras, by frame number or one that stands still.
        keypoints: frame number -> JSON file.
        masks: frame number -> picture.
        mask_kind: how those are read, see ``external_detections.read_given_mask``.
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


def files_of(folder: Path, clip: Clip, suffixes: Sequence[str] = PICTURES) -> dict[int, Path] | None:
    """The files of a folder that belong to frames of a clip, by frame number; None where there are none."""
    return match_files(folder, suffixes, clip_frames(clip))[0] or None


def lacking(what: str, found: int, frames: int, where: str) -> str:
    """A note on files that a layout promises; empty where every frame has one.

    Args:
        what: their name in the plural.
        found: how many there are.
        frames: of the clip; 0 where it does not say how many it has.
        where: the folders that were looked into.
    """
    if not found:
        return f"no {what} in {where}"
    return f"{what} in {where} for {found} of {frames} frames" if found < frames else ""


_PER_FRAME = ("rotation", "expression", "transl", "valid", "hand_pca")


def renumbered(poses: InitialPoses | None, frames: Mapping[int, int]) -> InitialPoses | None:
    """The poses under other frame numbers, old -> new; others are left out, and None stands for no pose."""
    rows = [row for row, frame in enumerate(poses.frames) if frame in frames] if poses else []
    if poses is None or not rows:
        return None
    chosen = torch.tensor(rows)
    parts = {n: getattr(poses, n)[chosen] for n in _PER_FRAME if getattr(poses, n) is not None}
    return dataclasses.replace(poses, frames=tuple(frames[poses.frames[row]] for row in rows), **parts)


def join_poses(poses: Sequence[InitialPoses | None]) -> InitialPoses | None:
    """Poses of several shots as one; None where a shot has none."""
    known = [one for one in poses if one is not None]
    if not known or len(known) < len(poses):
        return None
    together: dict[str, Any] = {
        name: torch.cat([getattr(one, name) for one in known])
        for name in _PER_FRAME
        if all(getattr(one, name) is not None for one in known)
    }
    frames = tuple(frame for one in known for frame in one.frames)
    return dataclasses.replace(known[0], frames=frames, **together)


def read_array(table: Any, key: str, shape: tuple[int, ...], where: Path | str, remedy: str) -> np.ndarray:
    """``table[key]`` as finite float64 of a shape; -1 in it stands for any length.

    Raises:
        UserError: no table, no such entry, or something else; ``where`` names the file.
    """
    return numbers(entry(table, key, where, remedy), shape, f"{where}, '{key}'", remedy)


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
    if not array.size and -1 in shape:
        raise UserError(f"{where} is empty: {remedy}")
    return array


def stacked(arrays: Sequence[np.ndarray], where: Path | str, remedy: str, axis: int = 0) -> np.ndarray:
    """Arrays of one shape as one; UserError where they differ, as files of several programs do."""
    if len({array.shape for array in arrays}) > 1:
        lengths = ", ".join(sorted({str(list(array.shape)) for array in arrays})[:4])
        raise UserError(f"{where}: numbers that belong together have the shapes {lengths}: {remedy}")
    return np.stack(arrays, axis=axis)


def entry(table: Any, key: str, where: Path | str, remedy: str) -> Any:
    """``table[key]``; UserError where it is no table, or has no such entry."""
    if not isinstance(table, dict) or key not in table:
        raise UserError(f"{where} has no '{key}': {remedy}")
    return table[key]


def pinhole_of_matrix(matrix: np.ndarray, clip: Clip, where: Path | str, remedy: str) -> pycolmap.Camera:
    """A lens without distortion from intrinsics [3, 3]; UserError where a focal length is not positive."""
    if min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise UserError(f"{where}: the focal length is not positive: {remedy}")
    return pinhole_lens(clip.width, clip.height, (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))
