"""Frames that are single pictures: whether a detector may follow a person from one to the next.

MediaPipe's video mode looks for the person where it last was, and smooths its points as if 30 frames a second
came in. That helps with a film and harms everything else: photographs of somebody from all sides, and frames
of a film that are taken so seldom that the person is elsewhere by then.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pipeline.errors import UserError
from stages.ingest.settings import IngestSettings
from stages.ingest.video import Clip, read_picture

LONGEST_STEP = 0.085  # seconds between frames that are followed: 12 a second
COMPARED = 24  # pairs of neighbouring pictures that are looked at, at most
MOVED = 6.0  # grey levels by which neighbours must differ
UNRELATED = 0.6  # of the difference of pictures that lie half the clip apart
_SIDE = 96  # pixels at which pictures are compared


def detects_singly(clip: Clip, settings: IngestSettings, stills: bool) -> bool:
    """True where every frame is detected as if it were the first.

    Args:
        clip: the footage.
        settings: its stride.
        stills: what ``are_stills`` says of it.
    """
    return stills or (clip.fps > 0 and settings.stride / clip.fps > LONGEST_STEP)


def are_stills(clip: Clip, settings: IngestSettings) -> bool:
    """True for pictures without a clock, of which neighbours are about as different as any two are.

    Pictures that cannot be read are left out; whoever needs them says so.
    """
    if clip.fps or not clip.pictures:
        return False
    files = list(clip.pictures.values())[:: settings.stride]
    files = files[: settings.max_frames] if settings.max_frames else files
    far = len(files) // 2
    starts = np.unique(np.linspace(0, max(len(files) - 2, 0), COMPARED).astype(int)).tolist()
    wanted = sorted({(s + d) % len(files) for s in starts for d in (0, 1, far)})
    small = {}
    for place in wanted:
        try:
            small[place] = thumbnail(read_picture(files[place]))
        except UserError:
            continue
    pairs = [[(s, (s + d) % len(files)) for s in starts] for d in (1, far)]
    near, apart = (
        [difference(small[a], small[b]) for a, b in some if a != b and a in small and b in small]
        for some in pairs
    )
    return unrelated(near, apart)


def unrelated(near: Sequence[float], apart: Sequence[float]) -> bool:
    """True where neighbours differ clearly, and nearly as much as pictures far apart do.

    Args:
        near, apart: differences of neighbours, and of pictures half the clip apart, grey levels.
    """
    if not near or not apart:
        return False
    return bool(np.median(near) > max(MOVED, UNRELATED * float(np.median(apart))))


def thumbnail(image: np.ndarray) -> np.ndarray:
    """A picture [H, W, 3] uint8 in grey, its longer side 96 pixels: [h, w] float32."""
    scale = _SIDE / max(image.shape[:2])
    size = tuple(max(1, round(side * scale)) for side in image.shape[1::-1])
    return cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA).astype(
        np.float32
    )


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """The root mean square difference of two thumbnails, grey levels; infinite where their sizes differ."""
    if first.shape != second.shape:
        return float("inf")
    return float(np.sqrt(np.square(first - second).mean()))
