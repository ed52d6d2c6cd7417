"""The person's own colours where the mask is soft.

At the mask's edge a pixel of the photograph is a mixture ``I = a F + (1 - a) B`` of person and background.
Whoever takes ``I`` for the person's colour paints the wall onto temples and collars. F is estimated from the
picture alone (Forte and Pitie, Approximate Fast Foreground Colour Estimation, 2021): F and B are means of
what lies near, weighted by mask and by its opposite, and F then takes up what the mixture leaves unexplained,
first over a wide and then over a narrow neighbourhood. Where the clip has shown the background itself
(``background.py``), that is B.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.clip.background import Background, learn_background
from pipeline.clip.boxes import person_box
from pipeline.clip.foreground import FOREGROUND
from pipeline.clip.frames import read_frame, read_mask, write_frame

WIDE, NARROW = 0.12, 0.02  # of the person's longer side, the boxes' sides
LEAST_WIDE, LEAST_NARROW = 21, 7  # pixels
SURE = 4  # power of the mask: means are of what is surely the person's, not of mixtures
TINY = 1e-7


def write_foreground(folder: Path, frames: Sequence[int], learn: bool = True) -> None:
    """Writes ``foreground/``, a picture a frame, of the frames and masks in a folder.

    Args:
        folder: with ``frames`` and ``masks``.
        frames: frame numbers.
        learn: look for a background that stands still.
    """
    (folder / FOREGROUND).mkdir(parents=True, exist_ok=True)

    def pictures(frame: int) -> tuple[np.ndarray, np.ndarray]:
        return read_frame(folder / "frames", frame), read_mask(folder / "masks", frame)

    def pairs():
        for frame in frames:
            image, mask = pictures(frame)
            yield image, mask.astype(np.float32) / 255

    background = learn_background(pairs()) if learn and len(frames) > 1 else None
    for frame in frames:
        write_frame(folder / FOREGROUND, frame, estimate_foreground(*pictures(frame), background))


def estimate_foreground(
    image: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray,  # [H, W] uint8
    background: Background | None = None,
) -> np.ndarray:
    """The person's own colours, [H, W, 3] uint8: the picture's where the mask is 255, black where it is 0.

    Args:
        image: RGB.
        mask: the person's soft alpha.
        background: what stands still behind, of the same size.
    """
    found = np.where(mask[..., None] == 255, image, 0).astype(np.uint8)
    soft = (mask > 0) & (mask < 255)
    margin = max(LEAST_WIDE, round(WIDE * max(mask.shape)))
    box = person_box([mask], margin)
    if box is None or not soft.any():
        return np.where(mask[..., None] > 0, image, 0).astype(np.uint8)
    rows = box.slices
    plate = None
    if background is not None:
        plate = background.mean[rows] / 255, background.confidence[rows][..., None]
    colors = _blurred_fusion(image[rows].astype(np.float32) / 255, mask[rows].astype(np.float32) / 255, plate)
    inside = soft[rows]
    found[rows][inside] = np.round(colors[inside] * 255).astype(np.uint8)
    return found


def _blurred_fusion(
    image: np.ndarray, alpha: np.ndarray, plate: tuple[np.ndarray, np.ndarray] | None
) -> np.ndarray:
    """F of Forte and Pitie's two passes, in [0, 1]; ``plate`` is a known background and its confidence."""
    foreground, background, share = image, image, alpha[..., None]
    longer = max(alpha.shape)
    for side in (max(LEAST_WIDE, round(WIDE * longer)), max(LEAST_NARROW, round(NARROW * longer))):
        size = (2 * (side // 2) + 1,) * 2
        near = _near(foreground, share, size)
        behind = _near(background, 1 - share, size)
        if plate is not None:
            behind = plate[1] * plate[0] + (1 - plate[1]) * behind
        unexplained = image - share * near - (1 - share) * behind
        foreground, background = np.clip(near + share * unexplained, 0, 1), np.clip(behind, 0, 1)
    return foreground


def _near(colors: np.ndarray, share: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Mean colours of what is surely of one side in a box around each pixel, [H, W, 3]."""
    weight = share**SURE + TINY
    return cv2.blur(colors * weight, size) / cv2.blur(weight, size)[..., None]
