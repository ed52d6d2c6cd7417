"""Keypoints and masks that another program has made, one file a frame.

Keypoints: a folder of ``<frame>.json``. A file is either a list of 133 ``[x, y, score]`` in pixels of
the source (ExAvatar's and FlexiAvatar's ``keypoints_whole_body``) or mmpose's own
``results_<frame>.json`` with ``instance_info[i].keypoints`` and ``.keypoint_scores``, of which the
person with the highest mean score is taken.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.clip.keypoints import COUNT
from pipeline.errors import UserError
from pipeline.untrusted import check_picture, parse_json
from stages.ingest.video import PICTURES

_REMEDY = "write it again as 133 [x, y, score] or as mmpose's results"
MASK_KINDS = ("white", "inverted", "nonzero")
_MOST_BYTES = 16 << 20  # mmpose writes every person of a frame
LARGEST = 1e6  # pixels; beyond it a coordinate is no measurement
_NUMBER = re.compile(r"(?:.*\D)?(\d+)")


def number_by_name(folder: Path, suffixes: tuple[str, ...], what: str) -> dict[int, Path]:
    """Frame number -> file: the last run of digits in each name.

    Raises:
        UserError: no such folder, no such file in it, or two files for one frame.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: ingest.{what} must be 'mediapipe' or a folder of files")
    numbered: dict[int, Path] = {}
    for file in sorted(folder.iterdir()):
        match = _NUMBER.fullmatch(file.stem)
        if file.suffix.lower() not in suffixes or match is None:
            continue
        number = int(match.group(1))
        if number in numbered:
            raise UserError(f"{file} and {numbered[number].name} both name frame {number}: keep one")
        numbered[number] = file
    if not numbered:
        raise UserError(f"{folder} holds no numbered {'/'.join(suffixes)} file: check ingest.{what}")
    return numbered


def check_frames(files: Mapping[int, Path], frames: set[int], complete: bool) -> None:
    """Compare a folder's numbers with the clip's.

    Args:
        files: frame number -> file.
        frames: the numbers of every frame that the clip holds.
        complete: whether every frame of the clip was looked at.

    Raises:
        UserError: a file names a frame that the clip does not hold.
    """
    strangers = sorted(set(files) - frames) if complete else []
    if strangers:
        raise UserError(
            f"{files[strangers[0]]} is for frame {strangers[0]}, which the clip does not have "
            f"({len(strangers)} such files): number the files as the frames, or take them out"
        )


def read_whole_body(path: Path) -> np.ndarray:
    """One person's 133 points, [133, 3] float32: x, y in source pixels, score clipped to [0, 1].

    Raises:
        UserError: not JSON, not 133 points, or a number that is not finite. Points with null
            coordinates are refused as well.
    """
    value = parse_json(path, _REMEDY, _MOST_BYTES)
    if isinstance(value, dict) and "instance_info" in value:
        return _best(path, value["instance_info"])
    return _points(path, value)


def read_foreign_mask(path: Path, width: int, height: int, kind: str = "white") -> np.ndarray:
    """A mask file as soft alpha, resized by averaging.

    Args:
        path: a grey picture, or one with transparency, which then is the mask.
        width, height: of the result, pixels.
        kind: one of ``MASK_KINDS``, what in it is the person: ``white`` (255 is wholly so), ``inverted``
            (0 is) or ``nonzero`` (anything but 0 is).

    Returns:
        [height, width] uint8, 255 where the pixel is wholly the person's.

    Raises:
        UserError: the file is damaged.
    """
    data, remedy = np.fromfile(path, np.uint8), "replace it, or set ingest.masks=mediapipe"
    check_picture(path, remedy, data.tobytes())
    mask = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if mask is None:
        raise UserError(f"{path} is not a readable picture: {remedy}")
    if mask.ndim == 3:  # a picture with transparency carries the mask there
        mask = mask[..., 3] if mask.shape[2] == 4 else mask[..., :3].max(-1)
    if mask.dtype == np.uint16:
        mask = mask // 257
    if kind == "nonzero":
        mask = (mask > 0).astype(np.uint8) * 255
    elif kind == "inverted":
        mask = 255 - mask
    resized = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return np.clip(np.round(resized), 0, 255).astype(np.uint8)


def mask_files(folder: Path) -> dict[int, Path]:
    """The masks of a folder, frame number -> file."""
    return number_by_name(folder, PICTURES, "masks")


def keypoint_files(folder: Path) -> dict[int, Path]:
    """The keypoint files of a folder, frame number -> file."""
    return number_by_name(folder, (".json",), "keypoints")


def _best(path: Path, people: Any) -> np.ndarray:
    if not isinstance(people, list) or not all(isinstance(one, dict) for one in people):
        raise UserError(f"{path}: 'instance_info' is not a list of people: {_REMEDY}")
    found = []
    for one in people:
        points, scores = one.get("keypoints"), one.get("keypoint_scores")
        if not isinstance(points, list) or not isinstance(scores, list) or len(points) != len(scores):
            raise UserError(f"{path}: a person has no matching 'keypoints' and 'keypoint_scores': {_REMEDY}")
        pairs = zip(points, scores, strict=True)
        found.append(_points(path, [[*p[:2], s] if isinstance(p, list) else p for p, s in pairs]))
    if not found:
        return np.zeros((COUNT, 3), np.float32)
    return max(found, key=lambda points: float(points[:, 2].mean()))


def _points(path: Path, value: Any) -> np.ndarray:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != (COUNT, 3):
        raise UserError(f"{path} does not hold {COUNT} points of x, y, score: {_REMEDY}")
    bad = np.flatnonzero(~(np.abs(array) < LARGEST).all(1))
    if len(bad):
        raise UserError(f"{path}: point {bad[0]} is not finite or lies beyond {LARGEST:.0f} px: {_REMEDY}")
    array[:, 2] = np.clip(array[:, 2], 0, 1)
    return array.astype(np.float32)
