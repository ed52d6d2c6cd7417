"""MediaPipe's landmarks as the 133 COCO-WholeBody points, with a score each.

MediaPipe scores pose points only (their visibility). The face mesh and the hands come without a
score, and fail silently: a hand may collapse into a blob in the palm, or jump to the other one. Their
scores are derived here from the whole clip: size, agreement with the pose, jumps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipeline.clip.keypoints import (
    BODY,
    FACE,
    FACE_MESH_LEFT_IRIS,
    FACE_MESH_RIGHT_IRIS,
    FACE_MESH_TO_IBUG68,
    FEET,
    LEFT_HAND,
    RIGHT_HAND,
    Keypoints,
    empty_keypoints,
)
from pipeline.detection.mediapipe import Estimate

POSE_TO_BODY = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)
POSE_TO_FEET = (31, 31, 29, 32, 32, 30)  # toes are one point in MediaPipe
SMALL_TOE_SCORE = 0.5  # of the toe's: the small toe lies a few centimetres beside it
POSE_WRISTS = (15, 16)
PALM_LENGTHS = ((0, 5), (0, 9), (0, 17), (5, 17))  # wrist and knuckles
FACE_MESH_NOSE = 4
POSE_EARS = (7, 8)
FACE_MESH_OF_BODY = (
    FACE_MESH_NOSE,
    FACE_MESH_LEFT_IRIS,
    FACE_MESH_RIGHT_IRIS,
    454,
    234,
)  # ears: their fronts
SMALL_HAND, CLEAR_HAND = 5.0, 14.0  # palm length in the estimator's pixels
SMALL_FACE, CLEAR_FACE = 6.0, 20.0  # distance of the irises


@dataclasses.dataclass(frozen=True)
class PixelLandmarks:
    """An estimate without its masks, in pixels of the stored frame; zeros where nothing was found.

    Attributes:
        pose: [33, 4], x, y, z, visibility.
        world: [33, 4].
        face: [478, 4], x, y, z, found.
        hands: [2, 21, 4], x, y, z, found.
    """

    pose: np.ndarray
    world: np.ndarray
    face: np.ndarray
    hands: np.ndarray


def to_pixels(estimate: Estimate, width: int, height: int) -> PixelLandmarks:
    """Fractions of the picture as pixels of a frame of ``width`` x ``height``."""
    scale = np.array([width, height, width], np.float32)

    def scaled(points: np.ndarray | None, count: int) -> np.ndarray:
        array = np.zeros((count, 4), np.float32)
        if points is not None:
            array[:, :3] = points[:, :3] * scale
            array[:, 3] = points[:, 3] if points.shape[1] > 3 else 1
        return array

    hands = np.stack([scaled(hand, 21) for hand in estimate.hands])
    return PixelLandmarks(scaled(estimate.pose, 33), estimate.world.copy(), scaled(estimate.face, 478), hands)


def to_keypoints(
    frames: np.ndarray,  # [T]
    landmarks: Sequence[PixelLandmarks],
    width: int,
    height: int,
    magnification: float,
) -> Keypoints:
    """The clip's keypoints with scores.

    Args:
        frames: frame numbers, increasing.
        landmarks: one a frame, pixels of a frame of ``width`` x ``height``.
        width, height: of the stored frame.
        magnification: the estimator's pixels in one stored pixel.
    """
    keypoints = empty_keypoints(frames)
    if not len(frames):
        return keypoints
    size = np.array([width, height], np.float32)
    pose = np.stack([one.pose for one in landmarks])
    face = np.stack([one.face for one in landmarks])
    hands = np.stack([one.hands for one in landmarks])
    face_score = score_faces(face, pose, magnification)
    hand_score = np.stack(
        [score_hands(hands[:, side], pose[:, POSE_WRISTS[side]], magnification) for side in (0, 1)], axis=1
    )
    face[..., 3] = face_score[:, None] * inside_picture(face, size)
    hands[..., 3] = hand_score[..., None] * inside_picture(hands, size)
    keypoints.pose_image[:] = pose
    keypoints.pose_world[:] = np.stack([one.world for one in landmarks])
    keypoints.face_mesh[:] = np.where(face[..., 3:] > 0, face, 0)
    keypoints.hands[:] = np.where(hands[..., 3:] > 0, hands, 0)
    _fill_whole_body(keypoints.whole_body, pose, face, hands, size)
    np.clip(keypoints.pose_image[..., 3], 0, 1, out=keypoints.pose_image[..., 3])
    np.clip(keypoints.pose_world[..., 3], 0, 1, out=keypoints.pose_world[..., 3])
    return keypoints


def _fill_whole_body(
    whole: np.ndarray,  # [T, 133, 3], filled
    pose: np.ndarray,  # [T, 33, 4]
    face: np.ndarray,  # [T, 478, 4]
    hands: np.ndarray,  # [T, 2, 21, 4]
    size: np.ndarray,  # [2]
) -> None:
    def planar(points: np.ndarray, score: np.ndarray) -> np.ndarray:
        return np.concatenate([points[..., :2], score[..., None]], axis=-1)

    pose_score = np.clip(pose[..., 3], 0, 1) * inside_picture(pose, size)
    whole[:, BODY] = planar(pose, pose_score)[:, list(POSE_TO_BODY)]
    whole[:, FEET] = planar(pose, pose_score)[:, list(POSE_TO_FEET)]
    whole[:, [FEET.start + 1, FEET.start + 4], 2] *= SMALL_TOE_SCORE
    whole[:, FACE] = planar(face, face[..., 3])[:, list(FACE_MESH_TO_IBUG68)]
    # In close-ups the pose model puts the face's points too low; the mesh is right where there is one.
    mesh = planar(face, face[..., 3])[:, list(FACE_MESH_OF_BODY)]
    mesh[:, 3:, 2] *= pose_score[:, list(POSE_EARS)]  # the mesh does not know which ear is turned away
    whole[:, 0:5] = np.where(mesh[..., 2:] > 0, mesh, whole[:, 0:5])
    whole[:, LEFT_HAND] = planar(hands, hands[..., 3])[:, 0]
    whole[:, RIGHT_HAND] = planar(hands, hands[..., 3])[:, 1]
    whole[whole[..., 2] <= 0] = 0


def inside_picture(points: np.ndarray, size: np.ndarray) -> np.ndarray:
    """1 where a point [..., 2+] lies in the picture, else 0, [...] float32."""
    return np.asarray(((points[..., :2] >= 0) & (points[..., :2] <= size)).all(-1), np.float32)


def score_hands(hand: np.ndarray, wrist: np.ndarray, magnification: float) -> np.ndarray:
    """The trust in one hand's detections, [T] float32 in [0, 1].

    Args:
        hand: [T, 21, 4], pixels, found.
        wrist: [T, 4], the pose's wrist of that side.
        magnification: the estimator's pixels in one stored pixel.

    The product of: size in pixels, palm length over the clip's median (a collapsed hand is short, a
    merged one long), distance to the pose's wrist, and distance to the hand's own course. Lengths are
    in palms.
    """
    found = hand[..., 0, 3] > 0
    if not found.any():
        return np.zeros(len(hand), np.float32)
    across = [np.linalg.norm(hand[:, a, :2] - hand[:, b, :2], axis=-1) for a, b in PALM_LENGTHS]
    palm = np.maximum(np.max(across, axis=0), 1e-3)  # the longest: foreshortening spares one direction
    typical = float(np.median(palm[found]))
    ratio = palm / typical
    apart = np.linalg.norm(hand[:, 0, :2] - wrist[:, :2], axis=-1) / typical
    score = smoothstep(palm * magnification, SMALL_HAND, CLEAR_HAND)
    score = (
        score
        * smoothstep(ratio, 0.35, 0.65)
        * (1 - smoothstep(ratio, 1.6, 2.4))
        * (1 - smoothstep(apart, 1.2, 2.5))
    )
    score = score * (1 - smoothstep(detour(hand[:, [0, 5, 17], :2].mean(1), found) / typical, 0.8, 2.0))
    return (score * found).astype(np.float32)


def score_faces(face: np.ndarray, pose: np.ndarray, magnification: float) -> np.ndarray:
    """The trust in the face mesh, [T] float32 in [0, 1], by size, agreement with the pose's nose, and jumps.

    Args:
        face: [T, 478, 4], pixels, found.
        pose: [T, 33, 4].
        magnification: the estimator's pixels in one stored pixel.
    """
    found = face[:, 0, 3] > 0
    if not found.any():
        return np.zeros(len(face), np.float32)
    # Forehead to chin, and temple to temple: a profile shortens one of them only.
    spans = [np.linalg.norm(face[:, a, :2] - face[:, b, :2], axis=-1) for a, b in ((10, 152), (127, 356))]
    length = np.maximum(np.max(spans, axis=0), 1e-3)
    apart = np.linalg.norm(face[:, FACE_MESH_NOSE, :2] - pose[:, 0, :2], axis=-1) / length
    score = smoothstep(length * magnification, 2 * SMALL_FACE, 2 * CLEAR_FACE) * (
        1 - smoothstep(apart, 0.5, 1.0)
    )
    score = score * (1 - smoothstep(detour(face[:, FACE_MESH_NOSE, :2], found) / length, 0.3, 0.8))
    return (score * found).astype(np.float32)


def detour(points: np.ndarray, found: np.ndarray) -> np.ndarray:
    """The distance of a point from the median of the five frames about it, [T].

    Args:
        points: [T, 2], any unit, which is the result's.
        found: [T] bool; only these count, and with fewer than three of them the distance is 0.
    """
    distances = np.zeros(len(points))
    for row in np.flatnonzero(found).tolist():
        about = [other for other in range(max(0, row - 2), min(len(points), row + 3)) if found[other]]
        if len(about) >= 3:
            distances[row] = np.linalg.norm(points[row] - np.median(points[about], axis=0))
    return distances


def smoothstep(value: np.ndarray, start: float, end: float) -> np.ndarray:
    """0 up to ``start``, 1 from ``end`` on, smooth between (3t^2 - 2t^3)."""
    t = np.clip((value - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)
