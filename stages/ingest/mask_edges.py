"""A mask's edge moved to where the colours change.

About each uncertain pixel, colour is regressed on the mask over a small box in which certain pixels
count most (a guided filter with weights); where the colours there tell the two sides apart, the
regression's value replaces the mask's.
"""

from __future__ import annotations

import cv2
import numpy as np

REACH = 0.03  # half the box's side, of the square root of the person's area
UNSURE = 0.02  # pixels further than this from 0 and from 1 are moved
RIDGE = 1e-3  # squared colour differences, of colours in [0, 1], below which there is no edge
BLIND, CLEAR = 0.5, 0.85  # share of the mask's variance that colour explains: ignored, believed
SOFTNESS = 0.8  # pixels, the blur that makes the edge smooth again


def follow_edges(alpha: np.ndarray, image: np.ndarray, strength: float) -> np.ndarray:
    """The mask with its edge moved to where the colours change, [H, W] float32 in [0, 1].

    Args:
        alpha: [H, W] in [0, 1].
        image: [H, W, 3] uint8.
        strength: 0 leaves the mask as it is, 1 follows the colours wherever they are clear.
    """
    band = (alpha > UNSURE) & (alpha < 1 - UNSURE)
    if strength == 0 or not band.any():
        return alpha
    predicted, explained = _regress(alpha.astype(np.float32), image, band)
    belief = strength * np.clip((explained - BLIND) / (CLEAR - BLIND), 0, 1)
    moved = alpha.astype(np.float32)
    moved[band] += belief * (np.clip(predicted, 0, 1) - moved[band])
    return cv2.GaussianBlur(moved, (0, 0), SOFTNESS)


def _regress(alpha: np.ndarray, image: np.ndarray, band: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mask as a linear function of colour, and the share of its variance explained, each [band]."""
    side = 2 * max(2, round(REACH * float(np.sqrt(alpha.sum())))) + 1
    weight = np.square(2 * alpha - 1) + 0.01
    total = cv2.boxFilter(weight, -1, (side, side))

    def mean(values: np.ndarray) -> np.ndarray:
        return (cv2.boxFilter(weight * values, -1, (side, side)) / total)[band]

    colours = [image[..., channel].astype(np.float32) / 255 for channel in range(3)]
    means = [mean(colour) for colour in colours]
    centre = mean(alpha)
    spread = np.zeros((len(centre), 3, 3))
    joint = np.zeros((len(centre), 3))
    for i in range(3):
        joint[:, i] = mean(colours[i] * alpha) - means[i] * centre
        for j in range(i, 3):
            spread[:, i, j] = spread[:, j, i] = mean(colours[i] * colours[j]) - means[i] * means[j]
    slope = np.linalg.solve(spread + RIDGE * np.eye(3), joint[..., None])[..., 0]
    offsets = np.stack([colour[band] for colour in colours], axis=-1) - np.stack(means, axis=-1)
    variance = mean(np.square(alpha)) - np.square(centre)
    explained = (slope * joint).sum(-1) / np.maximum(variance, 1e-4)
    return centre + (slope * offsets).sum(-1), explained
