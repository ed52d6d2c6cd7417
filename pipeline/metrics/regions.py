"""The pixels that scores are taken over: the person, the inside of the mask, crops of face and hands.

The mask of a held-out frame limits every score: two good masks of the same frame differ by more at
their edges than a good render does inside. The interior leaves that edge out, and is measured on black
whatever the whole image is measured on: a mask is not quite 1 even there.

The square crops (supplement F of the paper) go by what was detected in the true frame, so that every method
is judged on the same pixels. A hand that was not found has no crop, and a frame without any is left out of
that region's mean.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.clip.boxes import Box
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND

EROSION = 3
"""Pixels by which the mask shrinks to become the interior."""

INSIDE = 0.5
"""The alpha above which a pixel belongs to the person."""

REGIONS = ("face", "hands")

SCORE = 0.3
"""The score from which a keypoint is trusted."""

_PARTS = {"face": ((FACE, 1.5),), "hands": ((LEFT_HAND, 1.4), (RIGHT_HAND, 1.4))}  # points, side over extent
_SHARE = 0.5  # of a part's points that must be trusted
SMALLEST = 16
"""Pixels of a crop's shorter side; smaller ones show nothing that could be judged."""


def person(mask: np.ndarray) -> Tensor:
    """The person's pixels: alpha above 0.5, [H, W] bool."""
    return torch.from_numpy(mask > INSIDE * 255)


def interior(mask: np.ndarray, erosion: int = EROSION) -> Tensor:
    """The pixels that are the person beyond doubt: alpha above 0.5, eroded by ``erosion`` pixels.

    The structuring element is the square of side ``2 erosion + 1``. The image's border does not
    erode: a person whom the frame cuts off is inside up to the border.

    Args:
        mask: [H, W] uint8, soft alpha.
        erosion: pixels, 0 or more.

    Returns:
        [H, W] bool; all false where nothing is left.

    >>> mask = np.zeros((20, 20), np.uint8)
    >>> mask[5:15, 5:15] = 255
    >>> int(interior(mask, erosion=3).sum())  # of 10 x 10 pixels 4 x 4 are left
    16
    """
    inside = (mask > INSIDE * 255).astype(np.uint8)
    square = np.ones((2 * erosion + 1, 2 * erosion + 1), np.uint8)
    return torch.from_numpy(cv2.erode(inside, square, borderType=cv2.BORDER_CONSTANT, borderValue=1)).bool()


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
