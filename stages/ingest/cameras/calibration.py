"""Calibrated cameras, and the frames of the clip that they belong to."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.clip.frame_files import ClipFrames, describe_match, match_names
from pipeline.errors import UserError
from stages.ingest.video import Clip, clip_frames

EVERY_FRAME = ""


@dataclasses.dataclass(frozen=True)
class CalibratedCamera:
    """One camera as a file gives it.

    Attributes:
        lens: pixels -> rays, any of COLMAP's camera models; the first pixel's centre is (0.5, 0.5).
        rotation: [3, 3] float64, world-to-camera, OpenCV axes.
        translation: [3] float64, world-to-camera, in the file's unit.
    """

    lens: pycolmap.Camera
    rotation: np.ndarray
    translation: np.ndarray


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The cameras of a clip as its files give them.

    Attributes:
        path: the file or folder.
        kind: what it is, for messages.
        views: picture name -> camera; a single one named ``EVERY_FRAME`` is a camera that stands still.
        metric: whether the unit is the metre.
        upright: whether the world's Y axis points up.
        depth: how far the scene's points lie from the cameras, median, in the file's unit; NaN if unknown.
        by_frame: whether the names are frame numbers.
    """

    path: Path
    kind: str
    views: Mapping[str, CalibratedCamera]
    metric: bool
    upright: bool
    depth: float = float("nan")
    by_frame: bool = False


def pinhole_lens(
    width: int, height: int, focal: tuple[float, float], centre: tuple[float, float]
) -> pycolmap.Camera:
    """A lens without distortion; everything in pixels."""
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[*focal, *centre])


def check_rotation(rotation: np.ndarray, where: str) -> None:
    """UserError where a matrix [3, 3] turns and mirrors, shears or scales."""
    proper = np.isfinite(rotation).all() and np.linalg.det(rotation) > 0
    if not proper or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise UserError(f"{where}: the rotation is not one: write it as a rotation matrix, world-to-camera")


def frames_of_views(
    calibration: Calibration, clip: Clip, total: int, counted_from: int | None = None
) -> tuple[dict[str, int], str]:
    """Picture name -> frame number, and how they were matched (``pipeline.clip.frame_files``).

    A camera of the wrong frame does more harm than none, so that every name must be a frame's.

    Args:
        calibration: its names are such as ``image12.jpg``, ``frames/00012.png`` or ``12``.
        clip: the footage.
        total: how many frames a video has; 0 if unknown, and then the numbers are not checked.
        counted_from: the first frame's number where the user says so.

    Raises:
        UserError: a name without a number, two names of one frame, or numbers that are no frames'.
    """
    path = calibration.path
    if calibration.by_frame:
        return {name: int(name) for name in calibration.views}, "by frame number"
    frames = clip_frames(clip) if clip.pictures else ClipFrames(range(clip.first, clip.first + total))
    match = match_names(calibration.views, frames, path, counted_from)
    if match.strangers:
        raise UserError(
            f"{path}: the picture '{match.strangers[0]}' is of no frame of {clip.path.name} "
            f"({len(frames.numbers)} frames; {len(match.strangers)} such names): give this clip's cameras, "
            "named as its pictures or numbered from 0 or 1, or say ingest.numbered_from"
        )
    nameless = [name for name in calibration.views if name not in match.frames]
    if nameless:
        raise UserError(f"{path}: the picture name '{nameless[0]}' has no frame number: rename the pictures")
    return dict(match.frames), describe_match(match, frames)
