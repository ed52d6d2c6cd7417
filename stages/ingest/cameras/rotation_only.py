"""A camera that only turns: its rotations from the background, frame by frame.

Without a baseline structure from motion has nothing to triangulate, but every pair of frames is then
related by the homography K R K^-1, whose R is the least-squares rotation between the rays of followed
corners (Kabsch), found again without the corners that disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stages.ingest.cameras.background_motion import FEWEST, GAP_SECONDS, PAIRS, track_corners

ROUNDS = 5
OUTLIER = 3.0  # times the median error
NEVER_WORSE = 0.5  # pixels; corners that agree this well are never outliers
ROTATION_ONLY = 0.03
"""Part of the displacement that a camera which only turns may leave unexplained. Pans that were made for the
tests left 0.011 under a focal length wrong by 40%, slides and orbits 0.043 to 0.22, a selfie 0.15."""
MOSTLY_ROTATION = 0.05  # and one whose turns are better than nothing, where structure from motion has failed


def rotation_between(before: np.ndarray, after: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation between two frames of a camera that only turned.

    Args:
        before, after: [N, 2], the same corners in both, pixels.
        matrix: [3, 3], intrinsics.

    Returns:
        [3, 3], from the first camera's axes to the second's; and the median error in pixels.
    """
    first, second = (_rays(points, matrix) for points in (before, after))
    kept = np.ones(len(before), bool)
    for _ in range(ROUNDS):
        rotation = Rotation.align_vectors(second[kept], first[kept])[0].as_matrix()
        moved = first @ rotation.T @ matrix.T
        error = np.linalg.norm(moved[:, :2] / moved[:, 2:] - after, axis=1)
        kept = error <= max(NEVER_WORSE, OUTLIER * float(np.median(error)))
    return rotation, float(np.median(error))


def unexplained_by_rotation(output: Path, frames: Sequence[int], fps: float, matrix: np.ndarray) -> float:
    """The part of the background's displacement that rotations leave unexplained.

    Measured over pairs of frames up to a second apart, medians; half a pixel is what following costs.

    Args:
        output: the folder with ``frames`` and ``masks``.
        frames: the kept frames, increasing.
        fps: frames a second; 0 counts as 25.
        matrix: [3, 3], intrinsics.

    Returns:
        0 to about 1; 1 where too few corners can be followed.
    """
    gap = min(max(1, round(GAP_SECONDS * (fps or 25.0))), max(1, len(frames) // 2))
    starts = np.unique(np.linspace(0, len(frames) - 1 - gap, PAIRS).astype(int)).tolist()
    unexplained, distances = [], []
    for start in starts:
        for step in (gap, gap // 2, gap // 4):
            before, after = track_corners(output, frames[start], frames[start + max(1, step)])
            if len(before) >= FEWEST:
                unexplained.append(rotation_between(before, after, matrix)[1])
                distances.append(float(np.median(np.linalg.norm(after - before, axis=1))))
                break
    if not distances:
        return 1.0
    left = max(0.0, float(np.median(unexplained)) - NEVER_WORSE)
    return left / max(float(np.median(distances)), NEVER_WORSE)


def chain_rotations(output: Path, frames: Sequence[int], matrix: np.ndarray) -> list[np.ndarray] | None:
    """World-to-camera rotations of all frames, the first camera's axes being the world's.

    Args:
        output: the folder with ``frames`` and ``masks``.
        frames: the kept frames, increasing.
        matrix: [3, 3], intrinsics.

    Returns:
        A rotation [3, 3] a frame; None where some pair of neighbours has too few corners to tell.
    """
    rotations = [np.eye(3)]
    for first, second in zip(frames[:-1], frames[1:], strict=True):
        before, after = track_corners(output, first, second)
        if len(before) < FEWEST:
            return None
        rotations.append(rotation_between(before, after, matrix)[0] @ rotations[-1])
    return rotations


def _rays(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Unit rays [N, 3] of pixels [N, 2]."""
    rays = np.linalg.solve(matrix, np.concatenate([points, np.ones((len(points), 1))], axis=1).T).T
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
