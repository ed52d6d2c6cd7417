"""The pixels that scores are taken over: the whole image, the person, and the inside of the mask.

The mask of a held-out frame limits every score: two good masks of the same frame differ by more at
their edges than a good render does inside. The interior leaves that edge out, and is measured on black
whatever the whole image is measured on: a mask is not quite 1 even there.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

EROSION = 3
"""Pixels by which the mask shrinks to become the interior."""

INSIDE = 0.5
"""The alpha above which a pixel belongs to the person."""


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
    """
    inside = (mask > INSIDE * 255).astype(np.uint8)
    square = np.ones((2 * erosion + 1, 2 * erosion + 1), np.uint8)
    return torch.from_numpy(cv2.erode(inside, square, borderType=cv2.BORDER_CONSTANT, borderValue=1)).bool()
