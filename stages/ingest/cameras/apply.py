"""What cameras change of a clip: frames without one go, distortion is taken out."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.clip.keypoints import Keypoints
from stages.ingest.cameras.lens import undistort
from stages.ingest.detect import Detected

NO_CAMERA = "no camera"


def apply_cameras(
    output: Path, detected: Detected, cameras: Collection[int], lenses: Mapping[int, pycolmap.Camera]
) -> Detected:
    """The clip that fits its cameras; frames and masks are changed on disk.

    Args:
        output: the folder with ``frames`` and ``masks``.
        detected: the kept frames so far.
        cameras: the frames that have a camera; the others are taken away and counted.
        lenses: as in :class:`.choose.Chosen`.
    """
    frames = detected.keypoints.frames.tolist()
    rows = [row for row, frame in enumerate(frames) if frame in cameras]
    for frame in set(frames) - {frames[row] for row in rows}:
        for folder in ("frames", "masks"):
            (output / folder / f"{frame:06d}.png").unlink()
    dropped = dict(detected.dropped)
    if len(rows) < len(frames):
        dropped[NO_CAMERA] = len(frames) - len(rows)
    keypoints = select(detected.keypoints, np.array(rows, int))
    if lenses:
        keypoints = undistort(output, lenses, keypoints)
    return dataclasses.replace(
        detected,
        keypoints=keypoints,
        seconds=tuple(detected.seconds[row] for row in rows),
        dropped=dict(sorted(dropped.items())),
    )


def select(keypoints: Keypoints, rows: np.ndarray) -> Keypoints:
    """The keypoints of some rows [N]."""
    fields = dataclasses.fields(keypoints)
    return Keypoints(**{field.name: getattr(keypoints, field.name)[rows] for field in fields})
