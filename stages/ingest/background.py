"""Taking out of a mask what is known to be the background (see ``pipeline/background.py``)."""

from __future__ import annotations

import cv2
import numpy as np

NOISE = 6.0  # grey levels that every pixel may differ by
PULL, PUSH = 4.0, 1.0  # log-odds that likeness takes away, and unlikeness adds


def log_odds(alpha: np.ndarray) -> np.ndarray:
    """log(a / (1 - a)), bounded as if ``alpha`` lay in [0.01, 0.99]."""
    safe = np.clip(alpha, 0.01, 0.99)
    return np.log(safe / (1 - safe))


def take_out(
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
        model: what ``pipeline.background.Background.model`` returns.
    """
    mean, spread, known = model
    distance = cv2.blur(np.sqrt(np.square(image - mean).mean(-1)), (3, 3)) / (NOISE + 2 * spread)
    unlike = np.clip((distance - 1) / 3, 0, 1)
    odds = log_odds(alpha) - known * PULL * np.clip(1 - 2 * unlike, 0, 1)
    odds += known * PUSH * np.clip(2 * unlike - 1, 0, 1) * (alpha > 0.15)
    return np.where(alpha > 0.97, alpha, 1 / (1 + np.exp(-odds))).astype(np.float32)
