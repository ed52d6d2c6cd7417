"""Where keypoints and masks come from: MediaPipe, the dataset, or folders that another program has filled."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import UserError
from stages.ingest.datasets import Shot
from stages.ingest.detections import keypoint_files, mask_files

if TYPE_CHECKING:
    from pipeline.run.stage import Context

MEDIAPIPE, AUTO = "mediapipe", "auto"


@dataclasses.dataclass(frozen=True)
class Sources:
    """What the settings and the dataset name.

    Attributes:
        mediapipe: the asset's folder; None where nothing is asked of it.
        keypoints: frame number -> JSON file; None where MediaPipe gives the keypoints.
        masks: frame number -> picture; None where MediaPipe gives the masks.
        mask_kind: how the masks are read, see ``detections.MASK_KINDS``.
        names: for ``footage.json``: what ``keypoints`` and ``masks`` came from.
    """

    mediapipe: Path | None
    keypoints: Mapping[int, Path] | None
    masks: Mapping[int, Path] | None
    mask_kind: str = "white"
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)


def open_sources(context: Context, shot: Shot, layout: str, span: range | None = None) -> Sources:
    """What a shot's keypoints and masks come from.

    Args:
        context: the stage's.
        shot: what the dataset brings.
        layout: its name.
        span: the frame numbers of this shot, where folders that the settings name are of several.

    Raises:
        UserError: a folder is missing, empty or ambiguous, or MediaPipe is needed and not there.
    """
    settings = context.settings
    keypoints = shot.keypoints if settings.keypoints == AUTO else None
    masks = shot.masks if settings.masks == AUTO else None
    names = {
        "keypoints": _name(settings.keypoints, keypoints, layout),
        "masks": _name(settings.masks, masks, layout),
    }
    if settings.keypoints not in (AUTO, MEDIAPIPE):
        keypoints = _within(keypoint_files(Path(settings.keypoints)), span)
    kind = shot.mask_kind
    if settings.masks not in (AUTO, MEDIAPIPE):
        masks, kind = _within(mask_files(Path(settings.masks)), span), "white"
    if keypoints is not None and masks is not None:
        return Sources(None, keypoints, masks, kind, names)
    if "mediapipe" not in context.assets:
        raise UserError("MediaPipe is not in data/assets: fetch it with doit run assets:mediapipe")
    return Sources(context.assets["mediapipe"], keypoints, masks, kind, names)


def _within(files: dict[int, Path], span: range | None) -> dict[int, Path]:
    return {frame: file for frame, file in files.items() if span is None or frame in span}


def _name(setting: str, own: Mapping[int, Path] | None, layout: str) -> str:
    if setting != AUTO:
        return setting
    return MEDIAPIPE if own is None else layout
