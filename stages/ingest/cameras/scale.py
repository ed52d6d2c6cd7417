"""The metres of one unit of cameras without a scale, from the person's motion.

In camera axes the person's place c_t is known in metres: the estimator's 3D landmarks have the size of a
body, and their pixels give its distance. The cameras are known up to one factor s, so the person's place in
the world is X_t = R_t^T (c_t - s t_t) = a_t - s b_t. A wrong s makes the camera's motion shake the person, so
s minimises the path sum |X_(t+1) - X_t|^2, in closed form. a and b are smoothed first by the same filter,
which keeps s and removes the noise of the depths. A person who moves with the camera looks like a small s:
bounds from the scene's depth keep the background behind the person.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pipeline.clip.keypoints import Keypoints
from pipeline.pose_files import InitialPoses

TRUNK, HEAD = (11, 12, 23, 24), tuple(range(11))  # of MediaPipe's pose; the trunk turns, but hardly bends
VISIBLE = 0.5
MOSTLY = 0.7  # part of the frames in which a point must be seen to be used
SMOOTH_SECONDS = 0.2  # deviation of the filter
NEAREST, FARTHEST = 0.7, 30.0  # median depth of the scene over the person's
_PIVOT = (0.0, -0.35, 0.0)  # the root joint of a body at rest, where poses do not say whose it is
STILL = 1e-9  # squared motion of the cameras, in their unit, below which there is nothing to scale


@dataclasses.dataclass(frozen=True)
class Scale:
    """Metres a unit (s above), and a note for the log on what it rests on."""

    metres: float
    note: str


def person_positions(
    keypoints: Keypoints, focal: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The person's place in each camera's axes, by weak perspective.

    The centroid of trunk and head points (those seen in most frames) in ``pose_world`` metres, whose axes
    are the camera's, is fitted to the same points' pixels: depth = focal / (pixels a metre).

    Args:
        keypoints: of T frames.
        focal, centre: [T, 2], pixels.

    Returns:
        rows: [N] int, the frames that could be placed.
        places: [N, 3], metres, OpenCV camera axes.
    """
    size = 2 * centre  # close enough to tell what is far outside the picture
    pixels = keypoints.pose_image[..., :2].astype(np.float64)
    within = ((pixels > -0.05 * size[:, None]) & (pixels < 1.05 * size[:, None])).all(-1)
    seen = (keypoints.pose_image[..., 3] >= VISIBLE) & within & keypoints.pose_world[..., :3].any(-1)
    points = [point for point in (*TRUNK, *HEAD) if seen[:, point].mean() >= MOSTLY]
    if len(points) < 3:
        return np.zeros(0, int), np.zeros((0, 3))
    rows = np.flatnonzero(seen[:, points].all(1))
    world, there = keypoints.pose_world[rows][:, points, :2].astype(np.float64), pixels[rows][:, points]
    spread = world - world.mean(1, keepdims=True)
    shift = (there - there.mean(1, keepdims=True)) / focal[rows, None]
    inverse = (spread * shift).sum((1, 2)) / np.maximum(np.square(spread).sum((1, 2)), 1e-9)  # 1 / metres
    usable = inverse > 1e-3
    rows, depth = rows[usable], 1 / inverse[usable]
    offset = (there.mean(1)[usable] - centre[rows]) / focal[rows] * depth[:, None]
    return rows, np.concatenate([offset, depth[:, None]], axis=1)


def posed_positions(frames: np.ndarray, poses: InitialPoses | None) -> tuple[np.ndarray, np.ndarray]:
    """The root joint's place in each camera's axes by poses that came with a dataset.

    Takes T frame numbers [T]; returns as :func:`person_positions`, and nothing where poses have no place.
    """
    if poses is None or poses.transl is None:
        return np.zeros(0, int), np.zeros((0, 3))
    pivot = np.array(_PIVOT) if poses.pivot is None else poses.pivot.double().numpy()
    at = dict(zip(poses.frames, poses.transl.double().numpy() + pivot, strict=True))
    rows = [row for row, frame in enumerate(frames.tolist()) if frame in at]
    return np.array(rows, int), np.array([at[int(frames[row])] for row in rows]).reshape(-1, 3)


def metric_scale(
    rotations: np.ndarray,  # [N, 3, 3]
    translations: np.ndarray,  # [N, 3]
    places: np.ndarray,  # [N, 3]
    fps: float,
    scene_depth: float,
) -> Scale:
    """The metres of one unit of the cameras' translations.

    Args:
        rotations, translations: world-to-camera, of the frames that have a place.
        places: the person in camera axes, metres.
        fps: frames a second; 0 counts as 25.
        scene_depth: how far the scene's points are from the cameras, median, in the cameras' unit; NaN if
            unknown, and then the scale has no bounds but to be positive.
    """
    if len(places) < 3:
        return Scale(1.0, "no 3D landmarks to tell the scale by, so a unit of the model is taken for a metre")
    a = np.einsum("tji,tj->ti", rotations, places)
    b = np.einsum("tji,tj->ti", rotations, translations)
    width = SMOOTH_SECONDS * (fps or 25.0)
    steps_a, steps_b = (np.diff(gaussian_filter1d(v, width, axis=0, mode="nearest"), axis=0) for v in (a, b))
    moved = float(np.square(steps_b).sum())
    if moved < STILL:
        return Scale(1.0, "the camera does not move, so its model needs no scale")
    free = float((steps_a * steps_b).sum()) / moved
    depth = float(np.median(places[:, 2]))
    bounds = (1e-6, 1e6)
    if np.isfinite(scene_depth) and scene_depth > 0:
        bounds = (NEAREST * depth / scene_depth, FARTHEST * depth / scene_depth)
    metres = float(np.clip(free, *bounds))
    before, after = (float(np.linalg.norm(steps_a - s * steps_b, axis=1).sum()) for s in (0.0, metres))
    note = f"{metres:.4g} metres a unit, which shortens the person's path from {before:.2f} to {after:.2f} m"
    if metres != free:
        note += f" (the shortest path, at {free:.4g}, would put the scene before the person or out of sight)"
    return Scale(metres, note)
