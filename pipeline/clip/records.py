"""The small records that travel between the stages: cameras, the split, the footage.

``cameras.parquet`` has one row a kept frame: ``frame``, ``width``, ``height`` (int32, pixels),
``intrinsics`` [9] and ``rotation`` [9] (float64, row by row) and ``translation`` [3] (float64, metres),
world-to-camera with OpenCV axes as in :mod:`pipeline.clip.camera`.
``split.json`` is ``{"train": [...], "test": [...]}``, frame numbers.
``footage.json`` holds the fields of :class:`Footage`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from pydantic import TypeAdapter, ValidationError

from pipeline.clip.camera import Camera
from pipeline.clip.frame_files import ClipFrames
from pipeline.errors import UserError
from pipeline.files.json_files import write_json
from pipeline.files.tables import read_table, vectors, write_table
from pipeline.untrusted import parse_json

CAMERA_SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("width", pa.int32()),
        ("height", pa.int32()),
        ("intrinsics", vectors(9, pa.float64())),
        ("rotation", vectors(9, pa.float64())),
        ("translation", vectors(3, pa.float64())),
    ]
)
SHOT_STEP = 100_000
"""Frame numbers of a rig's n-th further camera begin at n times this."""

_REMEDY = "run the ingest stage again"


def write_cameras(path: Path, cameras: Mapping[int, Camera]) -> None:
    """Write ``cameras.parquet``, sorted by frame number."""
    frames = sorted(cameras)

    def column(name: str, size: int) -> np.ndarray:
        rows = [getattr(cameras[frame], name).detach().double().numpy().reshape(size) for frame in frames]
        return np.array(rows, np.float64).reshape(len(frames), size)

    columns = {
        "frame": np.array(frames, np.int32),
        "width": np.array([cameras[frame].width for frame in frames], np.int32),
        "height": np.array([cameras[frame].height for frame in frames], np.int32),
        "intrinsics": column("intrinsics", 9),
        "rotation": column("rotation", 9),
        "translation": column("translation", 3),
    }
    write_table(path, CAMERA_SCHEMA, columns)


def read_cameras(path: Path, dtype: torch.dtype = torch.float32) -> dict[int, Camera]:
    """Read ``cameras.parquet``: frame number -> camera.

    Raises:
        UserError: the file is missing or malformed, an image is empty, a focal length is not
            positive, or a rotation is not one.
    """
    columns = read_table(path, CAMERA_SCHEMA, _REMEDY)
    cameras = {}
    for row, frame in enumerate(columns["frame"].tolist()):
        width, height = int(columns["width"][row]), int(columns["height"][row])
        intrinsics = columns["intrinsics"][row].reshape(3, 3)
        rotation = columns["rotation"][row].reshape(3, 3)
        if min(width, height) < 1 or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
            raise UserError(f"{path}: the camera of frame {frame} is empty: {_REMEDY}")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
            raise UserError(f"{path}: the camera of frame {frame} has no proper rotation: {_REMEDY}")
        arrays = (intrinsics, rotation, columns["translation"][row])
        cameras[frame] = Camera(width, height, *(torch.tensor(array, dtype=dtype) for array in arrays))
    return cameras


@dataclasses.dataclass(frozen=True)
class Split:
    """The frames to learn from and those held out; frame numbers, increasing, disjoint."""

    train: tuple[int, ...]
    test: tuple[int, ...]


def write_split(path: Path, split: Split) -> None:
    """Write ``split.json``."""
    write_json(path, {"train": list(split.train), "test": list(split.test)})


def read_split(path: Path) -> Split:
    """Read ``split.json``.

    Raises:
        UserError: missing or malformed, no training frame, or a frame in both parts.
    """
    value = parse_json(path, _REMEDY)
    parts = {}
    for name in ("train", "test"):
        frames = value.get(name) if isinstance(value, dict) else None
        if not isinstance(frames, list) or not all(type(frame) is int and frame >= 0 for frame in frames):
            raise UserError(f"{path}: {name!r} must be a list of frame numbers: {_REMEDY}")
        parts[name] = tuple(sorted(frames))
    frames = parts["train"] + parts["test"]
    if not parts["train"] or len(set(frames)) < len(frames):
        raise UserError(f"{path}: train is empty, or a frame stands twice: {_REMEDY}")
    return Split(**parts)


@dataclasses.dataclass(frozen=True)
class Footage:
    """The source and the frames that were kept of it.

    Attributes:
        name: the source's file or folder name.
        width, height: the source's upright size in pixels.
        fps: frames a second of the source on average; 0 where the source has no clock (images).
        scale: stored frame size over source size.
        read: how many frames were looked at.
        kept: how many were published.
        dropped: reason -> how many frames were left out for it.
        people: how many people were noticed in the clip; 0 where nobody counted.
        seconds: the time of each kept frame from the clip's start, in the order of the frames.
        sources: what the keypoints and the masks came from.
        camera: where the cameras came from (``source``), how far the background moves in a second
            (``displacement``, of the longer side) where it was measured, ``metres_per_unit`` where a scale
            was applied, and what else that source has to say.
        total: how many frames the source has, whatever was looked at; 0 where it does not say.
        names: frame number, as text -> file name, of all frames of a source of pictures; empty for a video.
        stills: whether the frames are single pictures, of which none follows another in time.
    """

    name: str
    width: int
    height: int
    fps: float
    scale: float
    read: int
    kept: int
    dropped: Mapping[str, int]
    people: int
    seconds: tuple[float, ...]
    sources: Mapping[str, str]
    camera: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    total: int = 0
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    stills: bool = False

    @property
    def all_frames(self) -> ClipFrames:
        """All frames of the source, and what they are called."""
        if self.names:
            names = {int(frame): name for frame, name in self.names.items()}
            return ClipFrames(tuple(sorted(names)), names)
        return ClipFrames(range(self.total))


def write_footage(path: Path, footage: Footage) -> None:
    """Write ``footage.json``."""
    write_json(path, dataclasses.asdict(footage))


def read_footage(path: Path) -> Footage:
    """Read ``footage.json``; UserError where it is missing or malformed."""
    value = parse_json(path, _REMEDY)
    names = {field.name for field in dataclasses.fields(Footage)}
    if not isinstance(value, dict) or set(value) != names:
        raise UserError(f"{path}: its fields are not {', '.join(sorted(names))}: {_REMEDY}")
    try:
        footage = TypeAdapter(Footage).validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        place = ".".join(map(str, error.errors()[0]["loc"]))
        raise UserError(f"{path}: {place} is no such value as ingest writes: {_REMEDY}") from None
    counts = (footage.width, footage.height, footage.read, footage.kept, footage.total)
    numbered = all(name.isascii() and name.isdigit() and len(name) < 10 for name in footage.names)
    if not all(0 <= count < 2**31 for count in counts) or not numbered:
        raise UserError(f"{path}: a count or a frame's number is out of range: {_REMEDY}")
    return footage
