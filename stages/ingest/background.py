"""The background that stands still behind the person, learnt from the clip itself.

Each pixel's mean colour and spread over the frames in which the person is surely elsewhere. Where the
camera or the scene moves the spread is wide, and the pixel counts as unknown.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

ABSENT = 0.1  # the person is surely elsewhere where the mask, widened, is below this
MARGIN = 0.02  # by how much it is widened, of the longer side
FEWEST, ENOUGH = 3, 8  # frames that a pixel must have been seen in: unknown, known
STILL, MOVING = 15.0, 25.0  # spread in grey levels: known, unknown
NOISE = 6.0  # grey levels that every pixel may differ by
PULL, PUSH = 4.0, 1.0  # log-odds that likeness takes away, and unlikeness adds


class Background:
    """The background's mean and spread, summed up frame by frame."""

    def __init__(self, height: int, width: int) -> None:
        """Begin without a frame; pixels."""
        self._count = np.zeros((height, width), np.float32)
        self._sum = np.zeros((height, width, 3), np.float64)
        self._squares = np.zeros((height, width), np.float64)

    def add(self, image: np.ndarray, alpha: np.ndarray) -> None:
        """Take in one frame.

        Args:
            image: [H, W, 3] uint8.
            alpha: [H, W] in [0, 1], where the person may be.
        """
        reach = max(3, round(MARGIN * max(alpha.shape)))
        weight = (cv2.dilate(alpha, np.ones((reach, reach), np.uint8)) < ABSENT).astype(np.float32)
        colour = image.astype(np.float64) * weight[..., None]
        self._count += weight
        self._sum += colour
        self._squares += np.square(colour).mean(-1)

    def model(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean colour [H, W, 3], spread [H, W] in grey levels, and confidence [H, W] in [0, 1]; float32."""
        count = np.maximum(self._count, 1)
        mean = self._sum / count[..., None]
        spread = np.sqrt(np.maximum(self._squares / count - np.square(mean).mean(-1), 0))
        known = np.clip((self._count - FEWEST) / (ENOUGH - FEWEST), 0, 1)
        known = known * np.clip((MOVING - spread) / (MOVING - STILL), 0, 1)
        return mean.astype(np.float32), spread.astype(np.float32), known.astype(np.float32)


def learn_background(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> Background | None:
    """The background of (image, mask) pairs; None where there are none."""
    background = None
    for image, alpha in pairs:
        background = background or Background(*alpha.shape)
        background.add(image, alpha)
    return background


def log_odds(alpha: np.ndarray) -> np.ndarray:
    """log(a / (1 - a)), bounded as if ``alpha`` lay in [0.01, 0.99]."""
    safe = np.clip(alpha, 0.01, 0.99)
    return np.log(safe / (1 - safe))


def subtract_background(
    alpha: np.ndarray,  # [H, W]
    image: np.ndarray,  # [H, W, 3]
    model: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """The mask moved by what is known of the background, [H, W] float32 in [0, 1].

    A pixel that looks like the background loses, unless the mask is sure of it; one that does not
    gains, where the mask already half believes in it: a shadow is unlike the background as well.

    Args:
        alpha: [H, W] in [0, 1].
        image: [H, W, 3] uint8.
        model: what :meth:`Background.model` returns.
    """
    mean, spread, known = model
    distance = cv2.blur(np.sqrt(np.square(image - mean).mean(-1)), (3, 3)) / (NOISE + 2 * spread)
    unlike = np.clip((distance - 1) / 3, 0, 1)
    odds = log_odds(alpha) - known * PULL * np.clip(1 - 2 * unlike, 0, 1)
    odds += known * PUSH * np.clip(2 * unlike - 1, 0, 1) * (alpha > 0.15)
    return np.where(alpha > 0.97, alpha, 1 / (1 + np.exp(-odds))).astype(np.float32)
