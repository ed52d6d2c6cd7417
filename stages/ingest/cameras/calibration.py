"""Calibrated cameras, and the frames of the clip that they belong to."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath

import numpy as np
import pycolmap

from pipeline.errors import UserError
from stages.ingest.video import Clip, trailing_number

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
    """

    path: Path
    kind: str
    views: Mapping[str, CalibratedCamera]
    metric: bool
    upright: bool
    depth: float = float("nan")


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


def frames_by_name(names: Iterable[str], clip: Clip, total: int, path: Path) -> tuple[dict[str, int], int]:
    """Picture name -> frame number, and whether the names counted from 0 or 1.

    A name that is a picture's own in footage of pictures is that picture. Otherwise the digits that it ends
    with are a frame's number; where that fits not all names, but one less does, they count from 1 (as FFmpeg
    numbers the pictures that it writes). A camera of the wrong frame does more harm than none.

    Args:
        names: as the calibration has them, such as ``image12.jpg``, ``frames/00012.png`` or ``12``.
        clip: the footage.
        total: how many frames a video has; 0 if unknown, and then the numbers are not checked.
        path: the calibration, for messages.

    Raises:
        UserError: a name without a number, two names of one frame, or numbers that are no frames'.
    """
    stems = {name: PurePath(name.replace("\\", "/")).stem for name in names}
    own = {file.stem: index for index, file in clip.pictures.items()}
    if own and all(stem in own for stem in stems.values()):
        return _distinct({name: own[stem] for name, stem in stems.items()}, path), 0
    numbers: dict[str, int] = {}
    for name, stem in stems.items():
        number = trailing_number(stem)
        if number is None:
            raise UserError(f"{path}: the picture name '{name}' has no frame number: rename the pictures")
        numbers[name] = number
    known = set(clip.pictures) or set(range(total))
    for first in (0, 1):
        if not known or all(number - first in known for number in numbers.values()):
            return _distinct({name: number - first for name, number in numbers.items()}, path), first
    stranger = next(name for name, number in numbers.items() if number not in known)
    raise UserError(
        f"{path}: the picture '{stranger}' is of no frame of {clip.path.name} ({len(known)} frames from "
        f"{min(known)} to {max(known)}): give the cameras of this clip, numbered as its frames from 0 or 1"
    )


def _distinct(frames: dict[str, int], path: Path) -> dict[str, int]:
    first: dict[int, str] = {}
    for name, frame in frames.items():
        if frame in first:
            raise UserError(f"{path}: '{first[frame]}' and '{name}' both name frame {frame}: keep one")
        first[frame] = name
    return frames
