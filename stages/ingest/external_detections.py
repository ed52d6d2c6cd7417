"""Keypoints and masks that another program has made, one file a frame, in place of MediaPipe's.

Keypoints: a folder of ``<frame>.json``. A file is either a list of 133 ``[x, y, score]`` in pixels of
the source (ExAvatar's and FlexiAvatar's ``keypoints_whole_body``) or mmpose's own
``results_<frame>.json`` with ``instance_info[i].keypoints`` and ``.keypoint_scores``, of which the
person with the highest mean score is taken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from pipeline.clip.keypoints import COUNT
from pipeline.errors import UserError
from pipeline.untrusted import check_picture, parse_json
from stages.ingest.datasets.recording import Shot
from stages.ingest.video import PICTURES, numbered_files, trailing_number

if TYPE_CHECKING:
    from pipeline.run.stage import Context

MEDIAPIPE, AUTO = "mediapipe", "auto"
LARGEST = 1e6  # pixels; beyond it a coordinate is no measurement
_MOST_BYTES = 16 << 20  # mmpose writes every person of a frame
_REMEDY = "write it again as 133 [x, y, score] or as mmpose's results"


@dataclasses.dataclass(frozen=True)
class DetectionSources:
    """The files and models that give a shot's keypoints and masks.

    Attributes:
        mediapipe: the asset's folder; None where nothing is asked of it.
        keypoints: frame number -> JSON file; None where MediaPipe gives the keypoints.
        masks: frame number -> picture; None where MediaPipe gives the masks.
        mask_kind: as for :func:`read_given_mask`.
        names: for ``footage.json``: what ``keypoints`` and ``masks`` came from.
    """

    mediapipe: Path | None
    keypoints: Mapping[int, Path] | None
    masks: Mapping[int, Path] | None
    mask_kind: str = "white"
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)


def open_sources(context: Context, shot: Shot, layout: str, span: range | None = None) -> DetectionSources:
    """The sources that the settings and the dataset name.

    Args:
        context: the stage's.
        shot: the footage and what the dataset brings.
        layout: the dataset's name.
        span: the frame numbers of this shot, where folders that the settings name are of several.

    Raises:
        UserError: a folder is missing, empty or ambiguous, or MediaPipe is needed and not there.
    """
    files: dict[str, Mapping[int, Path] | None] = {}
    names, kind = {}, shot.mask_kind
    for what, suffixes, own in (("keypoints", (".json",), shot.keypoints), ("masks", PICTURES, shot.masks)):
        setting = getattr(context.settings, what)
        files[what] = own if setting == AUTO else None
        names[what] = (MEDIAPIPE if own is None else layout) if setting == AUTO else setting
        if setting not in (AUTO, MEDIAPIPE):
            found = _files_of_folder(Path(setting), suffixes, what)
            files[what] = {frame: file for frame, file in found.items() if span is None or frame in span}
            kind = "white" if what == "masks" else kind
    if None not in files.values():
        return DetectionSources(None, **files, mask_kind=kind, names=names)
    if MEDIAPIPE not in context.assets:
        raise UserError("MediaPipe is not in data/assets: fetch it with doit run assets:mediapipe")
    return DetectionSources(context.assets[MEDIAPIPE], **files, mask_kind=kind, names=names)


def _files_of_folder(folder: Path, suffixes: tuple[str, ...], what: str) -> dict[int, Path]:
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: ingest.{what} must be 'mediapipe' or a folder of files")
    files = numbered_files(folder, suffixes, trailing_number)
    if not files:
        raise UserError(f"{folder} holds no numbered {'/'.join(suffixes)} file: check ingest.{what}")
    return files


def check_frames(files: Mapping[int, Path], frames: set[int]) -> None:
    """Refuse files, frame number -> path, of which one is of no frame of the clip; UserError names it."""
    strangers = sorted(set(files) - frames)
    if strangers:
        raise UserError(
            f"{files[strangers[0]]} is for frame {strangers[0]}, which the clip does not have "
            f"({len(strangers)} such files): number the files as the frames, or take them out"
        )


def read_whole_body(path: Path) -> np.ndarray:
    """One person's 133 points, [133, 3] float32: x, y in source pixels, score clipped to [0, 1].

    Raises:
        UserError: not JSON, not 133 points, or a number that is null, not finite or beyond ``LARGEST``.
    """
    value = parse_json(path, _REMEDY, _MOST_BYTES)
    if isinstance(value, dict) and "instance_info" in value:
        return _best_person(path, value["instance_info"])
    return _points(path, value)


def _best_person(path: Path, people: Any) -> np.ndarray:
    if not isinstance(people, list) or not all(isinstance(one, dict) for one in people):
        raise UserError(f"{path}: 'instance_info' is not a list of people: {_REMEDY}")
    found = [np.zeros((COUNT, 3), np.float32)] if not people else []
    for one in people:
        points, scores = one.get("keypoints"), one.get("keypoint_scores")
        if not isinstance(points, list) or not isinstance(scores, list) or len(points) != len(scores):
            raise UserError(f"{path}: a person has no matching 'keypoints' and 'keypoint_scores': {_REMEDY}")
        pairs = zip(points, scores, strict=True)
        found.append(_points(path, [[*p[:2], s] if isinstance(p, list) else p for p, s in pairs]))
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


def read_given_mask(path: Path, width: int, height: int, kind: str = "white") -> np.ndarray:
    """A mask file as soft alpha, resized by averaging: [height, width] uint8, 255 where it is the person.

    Args:
        path: a grey picture, or one with transparency, which then is the mask.
        width, height: of the result, pixels.
        kind: the person is ``white`` (255 wholly so), ``inverted`` (0 wholly so) or ``nonzero``.

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
