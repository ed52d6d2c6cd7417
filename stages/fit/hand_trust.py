"""Hand trust: the hand detections that the fit uses."""

from __future__ import annotations

import numpy as np

POSE_WRISTS = (15, 16)
"""The wrists among MediaPipe's pose landmarks."""

PALM = (0, 5, 9, 13, 17)
"""The wrist and the first knuckles among the 21 points of a hand."""

_PALM_BONES = tuple((0, knuckle) for knuckle in PALM[1:])
_FINGER_BONES = tuple((a, a + 1) for first in PALM[1:] for a in range(first, first + 3))
_LEAST_POINTS = 5  # of a hand; the rest may lie outside the picture
_APART = 12.0  # 30ths of a second between the frames before and after a leap
_LEAST_BONES = 6  # of the fingers' twelve, for what they measure to tell a collapsed hand


def trusted_hands(
    hands: np.ndarray,
    pose: np.ndarray,
    world: np.ndarray,
    threshold: float,
    times: np.ndarray | None = None,
) -> np.ndarray:
    """The hands to trust among detections that have depth; detectors give no score that tells.

    A hand at the picture's edge has places for the points inside alone, and they are as good as those of
    a whole hand. So hands are judged by the points that they have, of which five are enough, and no rule
    speaks of what is not there.

    A hand goes when its palm is under half or over twice the clip's median, when its fingers are under
    0.6 of the length that they show elsewhere in the clip (a hand that collapsed to a blob), when it is
    more than two palms away from a seen wrist of the pose, when it leaps away for a frame, or when
    both hands were found at one place and it is the farther from the camera.

    Args:
        hands: [T, 2, 21, 4], x, y, z in pixels and score.
        pose: [T, 33, 4], x, y, z in pixels and visibility.
        world: [T, 33, 4], metres, z away from the camera, and visibility.
        threshold: tau.
        times: [T], in 30ths of a second; by default the frames follow one another so.

    Returns:
        [T, 2] bool.
    """
    times = np.arange(float(len(hands))) if times is None else times
    known = (hands[..., 3] >= threshold) & (hands[..., 3] > 0)
    seen = (known.sum(2) >= _LEAST_POINTS) & np.isfinite(hands).all((2, 3))
    trusted = seen.copy()
    places = np.where(known[..., None], hands[..., :3], np.nan)
    palm = _mean_length(places, _PALM_BONES, seen, 1)
    fingers = _mean_length(places, _FINGER_BONES, seen, _LEAST_BONES)
    for side, wrist in enumerate(POSE_WRISTS):
        usual = _quantile(palm[seen[:, side], side], 0.5)
        trusted[:, side] &= ~((palm[:, side] <= 0.5 * usual) | (palm[:, side] >= 2.0 * usual))
        trusted[:, side] &= ~(fingers[:, side] <= 0.6 * _quantile(fingers[seen[:, side], side], 0.9))
        away = _distance(places[:, side, :, :2], pose[:, wrist, :2])
        trusted[:, side] &= ~(away >= 2.0 * usual + 4) | (pose[:, wrist, 3] < threshold)
        middle, somewhere = _middle(places[:, side, PALM, :2])
        trusted[:, side] &= ~_leaps(middle, trusted[:, side] & somewhere, 1.5 * usual, times)
    double = trusted.all(1) & (_overlap(places[:, 0, :, :2], places[:, 1, :, :2]) > 0.5)
    farther = np.argmax(world[:, POSE_WRISTS, 2], axis=1)
    trusted[double, farther[double]] = False
    return trusted


def _mean_length(
    places: np.ndarray, bones: tuple[tuple[int, int], ...], seen: np.ndarray, least: int
) -> np.ndarray:
    """The mean length of bones.

    Bones with an unknown end are taken to be what they usually are beside the others, so that a part of
    a hand measures as the whole would.

    Args:
        places: [T, 2, 21, 3], NaN where unknown.
        bones: pairs of points.
        seen: [T, 2] bool, the hands that tell what is usual.
        least: how many bones must be known.

    Returns:
        [T, 2], NaN where fewer are.
    """
    start, end = np.array(bones).T
    length = np.linalg.norm(places[:, :, end] - places[:, :, start], axis=-1)
    known = np.isfinite(length)
    usual = np.array([_quantile(one, 0.5) for one in length[seen].T])
    beside = np.where(known.sum(-1) >= least, np.where(known, usual, 0).sum(-1), np.nan)
    return np.nansum(length, axis=-1) / beside * _mean(usual)


def _quantile(values: np.ndarray, share: float) -> float:
    """The quantile of the values that are known; NaN if none is."""
    values = values[np.isfinite(values)]
    return float(np.quantile(values, share)) if len(values) else np.nan


def _mean(values: np.ndarray) -> float:
    """The mean of the values that are known; NaN if none is."""
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else np.nan


def _distance(hand: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    """The distance from a hand's own wrist, or if that is not known its nearest point, to another wrist.

    Args:
        hand: [T, 21, 2], NaN where unknown.
        wrist: [T, 2].

    Returns:
        [T], NaN where nothing is known.
    """
    away = np.linalg.norm(hand - wrist[:, None], axis=-1)
    nearest = np.where(np.isfinite(away), away, np.inf).min(1)
    away = np.where(np.isfinite(away[:, 0]), away[:, 0], nearest)
    return np.where(np.isfinite(away), away, np.nan)


def _middle(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of the known ones among places [T, K, 2], 0 where there is none: [T, 2], and where: [T]."""
    count = np.isfinite(places).all(-1).sum(1)
    return np.nansum(places, axis=1) / np.maximum(count, 1)[:, None], count > 0


def trusted_flat_hands(
    hands: np.ndarray, seen: np.ndarray, wrists: np.ndarray, seen_wrists: np.ndarray
) -> np.ndarray:
    """The hands to trust where nothing has depth: those of which most points are seen.

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


def _leaps(places: np.ndarray, known: np.ndarray, limit: float, times: np.ndarray) -> np.ndarray:
    """Frames whose place is farther than ``limit`` from the nearest known frames before and after.

    Where these are more than ``_APART`` apart, a hand has time to go and come back.
    """
    leap = np.zeros(len(places), bool)
    rows = np.flatnonzero(known)
    step = np.linalg.norm(np.diff(places[rows], axis=0), axis=1)
    around = np.linalg.norm(places[rows[2:]] - places[rows[:-2]], axis=1)
    soon = times[rows[2:]] - times[rows[:-2]] <= _APART
    leap[rows[1:-1]] = (step[:-1] > limit) & (step[1:] > limit) & (around < limit) & soon
    return leap


def _overlap(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Intersection over union of the boxes around the known of two point sets: [T, K, 2] twice -> [T].

    Unknown points are NaN. Where a set has none, 0.
    """

    def box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        known = np.isfinite(points)
        return np.where(known, points, np.inf).min(1), np.where(known, points, -np.inf).max(1)

    (low, high), (other_low, other_high) = box(first), box(second)
    common = np.clip(np.minimum(high, other_high) - np.maximum(low, other_low), 0, None).prod(1)
    areas = np.clip(high - low, 0, None).prod(1) + np.clip(other_high - other_low, 0, None).prod(1)
    return common / np.maximum(areas - common, 1e-9)
