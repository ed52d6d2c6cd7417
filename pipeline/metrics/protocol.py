"""What is compared with what: the person on black or white, over the whole image and inside the mask.

The mask of a held-out frame limits every score: two good masks of the same frame differ by more at
their edges than a good render does inside. The interior leaves that edge out, and is measured on black
whatever the whole image is measured on: a mask is not quite 1 even there.
"""

from __future__ import annotations

from typing import get_args

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.config.choices import Background

BLACK, WHITE = get_args(Background)

BACKGROUNDS = {BLACK: 0.0, WHITE: 1.0}
"""What a person can be composited on -> the value of its pixels."""

EROSION = 3
"""Pixels by which the mask shrinks to become the interior."""

INSIDE = 0.5
"""The alpha above which a pixel belongs to the person."""


def composite(frame: np.ndarray, mask: np.ndarray, background: str = BLACK) -> Tensor:
    """The person cut out: ``frame / 255 * alpha + background * (1 - alpha)``.

    Args:
        frame: [H, W, 3] uint8, RGB.
        mask: [H, W] uint8, the person's soft alpha.
        background: one of ``BACKGROUNDS``.

    Returns:
        [H, W, 3] float32 in [0, 1].
    """
    alpha = torch.from_numpy(mask).float() / 255
    return over(torch.from_numpy(frame).float() / 255 * alpha[..., None], alpha, background)


def over(color: Tensor, alpha: Tensor, background: str = BLACK) -> Tensor:
    """Premultiplied colour, as a renderer gives it, on a background: ``color + background * (1 - alpha)``.

    Args:
        color: [H, W, 3], premultiplied with alpha.
        alpha: [H, W].
        background: one of ``BACKGROUNDS``.

    Returns:
        [H, W, 3].
    """
    value = BACKGROUNDS[background]
    return color + value * (1 - alpha)[..., None] if value else color


def cut_out(black: Tensor, white: Tensor, mask: np.ndarray, background: str = BLACK) -> Tensor:
    """A picture of which no more is left than the truth's mask holds.

    Its alpha becomes the smaller of its own and the mask's: what lies outside counts for nothing, however
    wrong it is, and what lies inside stays as it is. Multiplying by the mask, as the authors' release does
    with renders that have the scene behind them, would cut half-transparent edges out twice here.

    Args:
        black, white: [H, W, 3] in [0, 1], the picture on both backgrounds; they differ where it is clear.
        mask: [H, W] uint8, soft alpha.
        background: one of ``BACKGROUNDS``.

    Returns:
        [H, W, 3].
    """
    alpha = 1 - (white - black).mean(-1)
    kept = torch.minimum(alpha, torch.from_numpy(mask).to(black) / 255)
    share = kept / alpha.clamp_min(1e-6)
    return over(black * share[..., None], kept, background)


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
