"""Which hand detections to believe."""

from __future__ import annotations

import numpy as np

POSE_WRISTS = (15, 16)
"""The wrists among MediaPipe's pose landmarks."""


def trusted_hands(hands: np.ndarray, pose: np.ndarray, world: np.ndarray, threshold: float) -> np.ndarray:
    """Which hand detections to believe; detectors give no score that tells.

    A hand goes when its palm is under half or over twice the clip's median, when its fingers are under
    0.6 of the length that they show elsewhere in the clip (a hand that collapsed to a blob), when it is
    more than two palms away from a seen wrist of the pose, when it leaps away for a frame, or when
    both hands were found at one place and it is the farther from the camera.

    Args:
        hands: [T, 2, 21, 4], x, y, z in pixels and score.
        pose: [T, 33, 4], x, y, z in pixels and visibility.
        world: [T, 33, 4], metres, z away from the camera, and visibility.
        threshold: tau.

    Returns:
        [T, 2] bool.
    """
    trusted = (hands[..., 3] >= threshold).mean(2) > 0.5
    trusted &= np.isfinite(hands).all((2, 3))
    seen = trusted.copy()
    hands = np.nan_to_num(hands)
    palm = np.linalg.norm(hands[:, :, 9, :3] - hands[:, :, 0, :3], axis=-1)
    knuckles = hands[:, :, 5:, :3].reshape(len(hands), 2, 4, 4, 3)
    fingers = np.linalg.norm(np.diff(knuckles, axis=3), axis=-1).sum((2, 3))
    for side, wrist in enumerate(POSE_WRISTS):
        if not trusted[:, side].any():
            continue
        usual = np.median(palm[trusted[:, side], side])
        trusted[:, side] &= (palm[:, side] > 0.5 * usual) & (palm[:, side] < 2.0 * usual)
        trusted[:, side] &= fingers[:, side] > 0.6 * np.quantile(fingers[seen[:, side], side], 0.9)
        away = np.linalg.norm(hands[:, side, 0, :2] - pose[:, wrist, :2], axis=-1)
        trusted[:, side] &= (away < 2.0 * usual + 4) | (pose[:, wrist, 3] < threshold)
        trusted[:, side] &= ~_leaps(hands[:, side, 0, :2], trusted[:, side], 1.5 * usual)
    double = trusted.all(1) & (_overlap(hands[:, 0, :, :2], hands[:, 1, :, :2]) > 0.5)
    farther = np.argmax(world[:, POSE_WRISTS, 2], axis=1)
    trusted[double, farther[double]] = False
    return trusted


def trusted_flat_hands(
    hands: np.ndarray, seen: np.ndarray, wrists: np.ndarray, seen_wrists: np.ndarray
) -> np.ndarray:
    """Which hand detections to believe where nothing has depth: those of which most points are seen.

    Where both hands were found at one place (their boxes overlap by more than half of their union), one
    goes. If the arms' wrists are seen, it is the hand that lies farther from its own wrist by more than
    half a palm: most such pairs are one hand found twice. Else it is the farther from the camera, whose
    palm looks smaller by more than a fifth; and between palms of one size the one that scores less.

    Args:
        hands: [T, 2, 21, 3], x, y in pixels and score.
        seen: [T, 2, 21] bool, which of their points to believe.
        wrists: [T, 2, 3], the left and the right wrist of the arms.
        seen_wrists: [T, 2] bool, which wrists to believe.

    Returns:
        [T, 2] bool.
    """
    trusted = seen.mean(2) > 0.5
    hands, wrists = np.nan_to_num(hands), np.nan_to_num(wrists)
    double = trusted.all(1) & (_overlap(hands[:, 0, :, :2], hands[:, 1, :, :2]) > 0.5)
    palm = np.linalg.norm(hands[:, :, 9, :2] - hands[:, :, 0, :2], axis=-1)
    away = np.linalg.norm(hands[:, :, 0, :2] - wrists[..., :2], axis=-1)
    by_wrist = seen_wrists.all(1) & (np.abs(away[:, 0] - away[:, 1]) > 0.5 * palm.max(1))
    by_palm = palm.min(1) < 0.8 * palm.max(1)
    worse = np.where(by_palm, palm.argmin(1), hands[..., 2].mean(2).argmin(1))
    worse = np.where(by_wrist, away.argmax(1), worse)
    trusted[double, worse[double]] = False
    return trusted


def _leaps(places: np.ndarray, known: np.ndarray, limit: float) -> np.ndarray:
    """Frames whose place is farther than ``limit`` from the nearest known frames before and after."""
    leap = np.zeros(len(places), bool)
    rows = np.flatnonzero(known)
    step = np.linalg.norm(np.diff(places[rows], axis=0), axis=1)
    around = np.linalg.norm(places[rows[2:]] - places[rows[:-2]], axis=1)
    leap[rows[1:-1]] = (step[:-1] > limit) & (step[1:] > limit) & (around < limit)
    return leap


def _overlap(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Intersection over union of the boxes around two point sets: [T, K, 2] twice -> [T]."""
    low = np.maximum(first.min(1), second.min(1))
    high = np.minimum(first.max(1), second.max(1))
    common = np.clip(high - low, 0, None).prod(1)
    areas = (first.max(1) - first.min(1)).prod(1) + (second.max(1) - second.min(1)).prod(1)
    return common / np.maximum(areas - common, 1e-9)
