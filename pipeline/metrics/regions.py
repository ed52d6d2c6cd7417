"""Where face and hands are in a picture: square crops around their keypoints (supplement F of the paper).

The crops go by what was detected in the true frame, so that every method is judged on the same pixels. A
hand that was not found has no crop, and a frame without any is left out of that region's mean.
"""

from __future__ import annotations

import numpy as np

from pipeline.clip.boxes import Box
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND

REGIONS = ("face", "hands")

SCORE = 0.3
"""Of a keypoint from which it is believed."""

_PARTS = {"face": ((FACE, 1.5),), "hands": ((LEFT_HAND, 1.4), (RIGHT_HAND, 1.4))}  # points, side over extent
_SHARE = 0.5  # of a part's points that must be believed
SMALLEST = 16
"""Pixels of a crop's shorter side; smaller ones show nothing that could be judged."""


def region_boxes(points: np.ndarray, width: int, height: int) -> dict[str, list[Box]]:
    """The crops of a frame.

    Args:
        points: [133, 3], COCO-WholeBody, pixels and scores.
        width, height: of the picture.

    Returns:
        Region -> its boxes, inside the picture; a region that was not found is missing.
    """
    found: dict[str, list[Box]] = {}
    for region, parts in _PARTS.items():
        boxes = [_box(points[part], room, width, height) for part, room in parts]
        known = [box for box in boxes if box is not None]
        if known:
            found[region] = known
    return found


def _box(points: np.ndarray, room: float, width: int, height: int) -> Box | None:
    believed = points[points[:, 2] > SCORE, :2]
    if len(believed) < _SHARE * len(points):
        return None
    low, high = believed.min(0), believed.max(0)
    half = room * float((high - low).max()) / 2
    middle = (low + high) / 2
    low, high = np.floor(middle - half), np.ceil(middle + half)
    box = Box(*(int(value) for value in (*low, *high))).clipped(width, height)
    return box if min(box.width, box.height) >= SMALLEST else None
