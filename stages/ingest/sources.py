"""Where keypoints and masks come from: MediaPipe, or folders that another program has filled."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import UserError
from stages.ingest.detections import keypoint_files, mask_files

if TYPE_CHECKING:
    from pipeline.stage import Context

MEDIAPIPE = "mediapipe"


@dataclasses.dataclass(frozen=True)
class Sources:
    """What the settings name.

    Attributes:
        mediapipe: the asset's folder; None where nothing is asked of it.
        keypoints: frame number -> JSON file; None where MediaPipe gives the keypoints.
        masks: frame number -> picture; None where MediaPipe gives the masks.
    """

    mediapipe: Path | None
    keypoints: dict[int, Path] | None
    masks: dict[int, Path] | None


def open_sources(context: Context) -> Sources:
    """Read the folders' names; UserError where a folder is missing, empty or ambiguous."""
    settings = context.settings
    keypoints = None if settings.keypoints == MEDIAPIPE else keypoint_files(Path(settings.keypoints))
    masks = None if settings.masks == MEDIAPIPE else mask_files(Path(settings.masks))
    if keypoints is not None and masks is not None:
        return Sources(None, keypoints, masks)
    if "mediapipe" not in context.assets:
        raise UserError("MediaPipe is not in data/assets: fetch it with doit run assets:mediapipe")
    return Sources(context.assets["mediapipe"], keypoints, masks)
