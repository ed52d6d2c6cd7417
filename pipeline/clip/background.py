"""The background that stands still behind the person, learnt from the clip itself.

Each pixel's mean colour and spread over the frames in which the person is surely elsewhere. Where the
camera or the scene moves the spread is wide, and the pixel counts as unknown.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

ABSENT = 0.1  # the person is surely elsewhere where the mask, widened, is below this
MARGIN = 0.02  # by how much it is widened, of the longer side
FEWEST, ENOUGH = 3, 8  # frames that a pixel must have been seen in: unknown, known
STILL, MOVING = 15.0, 25.0  # spread in grey levels: known, unknown
NOISE = 6.0  # grey levels that every pixel may differ by
PULL, PUSH = 4.0, 1.0  # log-odds that likeness takes away, and unlikeness adds


@dataclasses.dataclass(frozen=True)
class Background:
    """The mean colour [H, W, 3], spread [H, W] in grey levels, and confidence [H, W] in [0, 1]; float32."""

    mean: np.ndarray
    spread: np.ndarray
    confidence: np.ndarray


def learn_background(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> Background | None:
    """The background of (image [H, W, 3] uint8, mask [H, W] in [0, 1]) pairs; None where there are none."""
    count: Any = 0.0  # [H, W] float32 from the first frame on
    total: Any = 0.0
    squares: Any = 0.0
    for image, alpha in pairs:
        reach = max(3, round(MARGIN * max(alpha.shape)))
        weight = (cv2.dilate(alpha, np.ones((reach, reach), np.uint8)) < ABSENT).astype(np.float32)
        colour = image.astype(np.float64) * weight[..., None]
        count = count + weight
        total = total + colour
        squares = squares + np.square(colour).mean(-1)
    if not np.ndim(count):
        return None
    seen = np.maximum(count, 1)
    mean = total / seen[..., None]
    spread = np.sqrt(np.maximum(squares / seen - np.square(mean).mean(-1), 0))
    known = np.clip((count - FEWEST) / (ENOUGH - FEWEST), 0, 1)
    known = known * np.clip((MOVING - spread) / (MOVING - STILL), 0, 1)
    return Background(mean.astype(np.float32), spread.astype(np.float32), known.astype(np.float32))


def log_odds(alpha: np.ndarray) -> np.ndarray:
    """log(a / (1 - a)), bounded as if ``alpha`` lay in [0.01, 0.99]."""
    safe = np.clip(alpha, 0.01, 0.99)
    return np.log(safe / (1 - safe))


def subtract_background(
    alpha: np.ndarray,  # [H, W] in [0, 1]
    image: np.ndarray,  # [H, W, 3] uint8
    background: Background,
) -> np.ndarray:
    """The mask with the known background taken out, [H, W] float32 in [0, 1].

    A pixel that looks like the background loses, unless the mask is sure of it; one that does not
    gains, where the mask already half believes in it: a shadow is unlike the background as well.
    """
    known, away = background.confidence, np.sqrt(np.square(image - background.mean).mean(-1))
    distance = cv2.blur(away, (3, 3)) / (NOISE + 2 * background.spread)
    unlike = np.clip((distance - 1) / 3, 0, 1)
    odds = log_odds(alpha) - known * PULL * np.clip(1 - 2 * unlike, 0, 1)
    odds += known * PUSH * np.clip(2 * unlike - 1, 0, 1) * (alpha > 0.15)
    return np.where(alpha > 0.97, alpha, 1 / (1 + np.exp(-odds))).astype(np.float32)
