"""Outlier frames: left and right swapped by the detector, or one that no neighbour agrees with.

Such frames come alone or a few in a row, and harm more than themselves: the start turns the body round
there, and the fit's first steps, which are wide in time, carry the neighbours along (one swapped frame of
24 turned a dozen others by 30 to 140 degrees; one nonsensical frame of 16 all others by 20). The frames
around them say where the body is, so the detections of outlier frames are masked.

**Swapped.** A body cannot turn round between two frames of a film. So where swapping left and right brings
a frame's points much nearer to those of the frame before, one of the two is swapped. Of the stretches
between such places every other one is swapped, and the shorter ones are taken to be.

**Isolated.** Nor can it move by much of its own length and back again within a frame or two.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.clip.clock import times_of_numbers, usual_step
from pipeline.clip.keypoints import LEFT_HAND, RIGHT_HAND, Keypoints

POSE_PAIRS = ((11, 12), (13, 14), (15, 16), (23, 24), (25, 26), (27, 28))
BODY_PAIRS = ((5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16))
_FACE_OF_POSE = 11  # MediaPipe's first points are the head's

_SCORE = 0.4  # of a point, or of both points of a pair
_LEAST = 2  # pairs that must be seen
_SOON = 3.1  # 30ths of a second within which nobody turns round, or moves and is back
_NEARER = 0.3  # the swapped points' distance, of the others'
_APART = 0.12  # least distance of left and right, of the body's extent; less is a side view
_LONGEST = 5.1  # 30ths of a second of a swapped stretch that is masked
_FAR, _NEAR = 0.4, 0.15  # mean distance of an isolated frame from its neighbours, and of these, of the extent


def mask_outlier_frames(keypoints: Keypoints, times: np.ndarray | None = None) -> tuple[Keypoints, list[int]]:
    """The detections with body and hands unseen in outlier frames, and the numbers of these frames.

    Args:
        keypoints: of T frames.
        times: [T], of the frames, see :mod:`pipeline.clip.clock`; by default their numbers.

    Returns:
        The detections, the same where there is no such frame, and these frames' numbers.
    """
    points, pairs = keypoints.pose_image[..., [0, 1, 3]], POSE_PAIRS
    if not (points[..., 2] > 0).any():
        points, pairs = keypoints.whole_body, BODY_PAIRS
    left, right = (points[:, [pair[side] for pair in pairs]] for side in (0, 1))
    times = times_of_numbers(keypoints.frames) if times is None else times
    rows = np.union1d(left_right_swapped(times, left, right), isolated_outliers(times, left, right))
    if not len(rows):
        return keypoints, []
    names = ("pose_image", "pose_world", "hands", "whole_body")
    unseen = {name: getattr(keypoints, name).copy() for name in names}
    for name in ("pose_image", "pose_world"):
        unseen[name][rows, _FACE_OF_POSE:, 3] = 0
    unseen["hands"][rows, ..., 3] = 0
    for part in (slice(5, 23), LEFT_HAND, RIGHT_HAND):
        unseen["whole_body"][rows, part, 2] = 0
    return dataclasses.replace(keypoints, **unseen), keypoints.frames[rows].tolist()


def left_right_swapped(times: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The rows in which left and right are swapped: indices, increasing.

    Args:
        times: [T], in 30ths of a second, increasing.
        left, right: [T, P, 3], pixels and score of a body's pairs of points.
    """
    seen, usable = _seen(left, right)
    if len(usable) < 3:
        return usable[:0]
    stretch = np.zeros(len(usable), int)
    for place, (before, now) in enumerate(zip(usable[:-1], usable[1:], strict=True)):
        both = seen[before] & seen[now]
        turned = both.sum() >= _LEAST and times[now] - times[before] <= _SOON
        rows = [before, now]
        turned = turned and _crossed(left[rows][:, both, :2], right[rows][:, both, :2])
        stretch[place + 1] = stretch[place] + turned
    lengths = np.bincount(stretch)
    odd = lengths[1::2].sum() > lengths[::2].sum()  # which of the two ways round is the common one
    most = _LONGEST / min(usual_step(times), _SOON)  # frames
    swapped = [number for number, length in enumerate(lengths) if number % 2 != odd and length <= most]
    return usable[np.isin(stretch, swapped)]


def isolated_outliers(times: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The rows that are far from both neighbours, which are near to each other: indices, increasing.

    Args:
        times, left, right: as for ``left_right_swapped``.
    """
    seen, usable = _seen(left, right)
    found = []
    for before, now, after in zip(usable[:-2], usable[1:-1], usable[2:], strict=True):
        all_three = seen[before] & seen[now] & seen[after]
        if all_three.sum() < _LEAST or times[after] - times[before] > _SOON:
            continue
        body = np.concatenate([left[:, all_three, :2], right[:, all_three, :2]], axis=1)
        extent = max(_extent(body[before]), _extent(body[after]))
        away = min(_distance(body[before], body[now]), _distance(body[now], body[after]))
        if away > _FAR * extent and _distance(body[before], body[after]) < _NEAR * extent:
            found.append(now)
    return np.array(found, np.int64)


def _seen(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs that are seen in each frame, [T, P] bool, and the rows that show enough of them."""
    scored = np.minimum(left[..., 2], right[..., 2]) >= _SCORE
    seen = scored & np.isfinite(left).all(-1) & np.isfinite(right).all(-1)
    return seen, np.flatnonzero(seen.sum(1) >= _LEAST)


def _crossed(left: np.ndarray, right: np.ndarray) -> bool:
    """True if left and right of two frames, [2, P, 2] each, agree better when swapped in one of them."""
    extent = max(_extent(np.concatenate(frame)) for frame in zip(left, right, strict=True))
    same = _distance(np.concatenate([left[0], right[0]]), np.concatenate([left[1], right[1]]))
    turned = _distance(np.concatenate([left[0], right[0]]), np.concatenate([right[1], left[1]]))
    return _distance(left, right) > _APART * extent and turned < _NEARER * same


def _extent(points: np.ndarray) -> float:
    """The diagonal of the points' box, [K, 2], pixels."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """The mean distance of points, [..., 2] twice, pixels."""
    return float(np.linalg.norm(first.astype(np.float64) - second, axis=-1).mean())
