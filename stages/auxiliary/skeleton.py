"""Skeleton frames as MimicMotion was trained on: 18 body points, 21 of each hand, 68 of the face, on black.

Layer by layer: limbs as filled ellipses in OpenPose's rainbow at 0.6 of their brightness, the body's
joints, the hands' bones by hue with blue joints, the face as grey dots. Every colour is scaled by the
confidence of its points, and limbs whose points score under 0.3 are left out.
"""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
from torch import Tensor

from pipeline.body import (
    Landmarks,
    Pose,
    joint_index,
    joint_orientations,
    locate,
    pose_frame,
    rasterize,
)
from pipeline.clip.camera import Camera, project, to_camera
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND
from stages.auxiliary.turntable_motion import TurntableMotion

LEAST = 0.3  # the score under which a point is not drawn
DIMMED = 0.6  # of the body layer's limbs
OCCLUDED = 0.6  # the score of a limb's joint behind the body: detectors guess those well
BEHIND = 0.05  # metres below what is seen at which a body or hand point counts as hidden
FACE_BEHIND = 0.012  # the same of the face's points, which lie on the surface

_FROM_COCO = (0, None, 6, 8, 10, 5, 7, 9, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3)
"""The 18 points from the 17 of COCO; the neck is the middle of the shoulders."""

_LIMBS = (
    (1, 2), (1, 5), (2, 3), (3, 4), (5, 6), (6, 7), (1, 8), (8, 9), (9, 10), (1, 11), (11, 12), (12, 13),
    (1, 0), (0, 14), (14, 16), (0, 15), (15, 17),
)  # fmt: skip
_RAINBOW = (
    (255, 0, 0), (255, 85, 0), (255, 170, 0), (255, 255, 0), (170, 255, 0), (85, 255, 0), (0, 255, 0),
    (0, 255, 85), (0, 255, 170), (0, 255, 255), (0, 170, 255), (0, 85, 255), (0, 0, 255), (85, 0, 255),
    (170, 0, 255), (255, 0, 255), (255, 0, 170), (255, 0, 85),
)  # fmt: skip
_FINGERS = tuple(
    (0 if joint == 0 else 4 * f + joint, 4 * f + joint + 1) for f in range(5) for joint in range(4)
)
_LIMB_WIDTH, _JOINT_RADIUS, _DOT_RADIUS = 4, 4, 3  # pixels
_NOSE_TO_EARS = slice(0, 5)


def body_18(whole_body: np.ndarray) -> np.ndarray:
    """COCO-WholeBody's first 17 points as OpenPose's 18: [133, 3] -> [18, 3]."""
    points = np.zeros((18, 3), np.float32)
    for place, source in enumerate(_FROM_COCO):
        if source is not None:
            points[place] = whole_body[source]
    shoulders = whole_body[5:7]
    points[1, :2] = shoulders[:, :2].mean(0)
    points[1, 2] = shoulders[:, 2].min()
    return points


def draw_skeleton(whole_body: np.ndarray, width: int, height: int) -> np.ndarray:
    """One frame.

    Args:
        whole_body: [133, 3], pixels and scores in [0, 1].
        width, height: pixels.

    Returns:
        [height, width, 3] uint8 RGB.
    """
    canvas = np.zeros((height, width, 3), np.uint8)
    _draw_body(canvas, body_18(whole_body))
    for hand in (LEFT_HAND, RIGHT_HAND):
        _draw_hand(canvas, whole_body[hand])
    for x, y, score in whole_body[FACE]:
        if score >= LEAST:
            grey = int(255 * min(score, 1))
            cv2.circle(canvas, _place(x, y), _DOT_RADIUS, (grey, grey, grey), -1)
    return canvas


def _draw_body(canvas: np.ndarray, points: np.ndarray) -> None:
    for (start, end), color in zip(_LIMBS, _RAINBOW, strict=False):
        score = float(points[[start, end], 2].mean())
        if points[[start, end], 2].min() < LEAST:
            continue
        ends = points[[start, end], :2]
        middle, along = ends.mean(0), ends[0] - ends[1]
        length, angle = float(np.hypot(*along)), float(np.degrees(np.arctan2(along[1], along[0])))
        axes = (int(length / 2), _LIMB_WIDTH)
        polygon = np.array(cv2.ellipse2Poly(_place(*middle), axes, int(angle), 0, 360, 1))
        cv2.fillConvexPoly(canvas, polygon, [int(part * score) for part in color])
    canvas[:] = (canvas * DIMMED).astype(np.uint8)
    for (x, y, score), color in zip(points, _RAINBOW, strict=True):
        if score >= LEAST:
            cv2.circle(canvas, _place(x, y), _JOINT_RADIUS, [int(part * score) for part in color], -1)


def _draw_hand(canvas: np.ndarray, points: np.ndarray) -> None:
    for place, (start, end) in enumerate(_FINGERS):
        if points[[start, end], 2].min() < LEAST:
            continue
        score = float(points[start, 2] * points[end, 2])
        color = [int(255 * part * score) for part in colorsys.hsv_to_rgb(place / len(_FINGERS), 1, 1)]
        cv2.line(canvas, _place(*points[start, :2]), _place(*points[end, :2]), color, 2)
    for x, y, score in points:
        if score >= LEAST:
            cv2.circle(canvas, _place(x, y), _JOINT_RADIUS, (0, 0, int(255 * score)), -1)


def _place(x: float, y: float) -> tuple[int, int]:
    limit = 1 << 14  # far outside every picture, and safe for OpenCV's integers
    return int(np.clip(x, -limit, limit)), int(np.clip(y, -limit, limit))


def driven_keypoints(
    clip: FittedClip, landmarks: Landmarks, joints: Tensor, vertices: Tensor, camera: Camera
) -> np.ndarray:
    """The 133 points of a posed body as a detector would give them: [133, 3] float32.

    A point of the face that is turned away scores 0, a joint behind the body ``OCCLUDED``, the rest 1.

    Args:
        joints: [55, 3], posed, metres.
        vertices: [V, 3], posed.
    """
    places = locate(landmarks.whole_body, joints, vertices)
    pixels = project(camera, places).numpy()
    depth = to_camera(camera, places)[:, 2].numpy()
    nearest = rasterize(camera, vertices, clip.body.faces).depth
    columns = np.clip(pixels[:, 0].astype(int), 0, camera.width - 1)
    rows = np.clip(pixels[:, 1].astype(int), 0, camera.height - 1)
    deeper = depth - np.where(np.isfinite(nearest[rows, columns]), nearest[rows, columns], depth)
    scores = np.where(deeper > BEHIND, OCCLUDED, 1.0)
    for face in (FACE, _NOSE_TO_EARS):
        scores[face] = np.where(deeper[face] > FACE_BEHIND, 0.0, 1.0)
    inside = (pixels >= 0).all(1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return np.concatenate([pixels, (scores * inside)[:, None]], axis=1).astype(np.float32)


def turntable_keypoints(clip: FittedClip, turn: TurntableMotion, landmarks: Landmarks) -> np.ndarray:
    """The driving skeletons of a whole turn: [T, 133, 3] float32."""
    found = []
    for frame in turn.poses.frames:
        vertices, joints = pose_frame(clip.body, clip.identity, turn.poses.pose(frame))
        found.append(driven_keypoints(clip, landmarks, joints, vertices, turn.camera))
    return np.stack(found)


def head_facing(clip: FittedClip, pose: Pose, camera: Camera, place: Tensor) -> float:
    """The cosine between the head's front and the way to the camera.

    Args:
        pose: of the body.
        place: [3], where the body is.
    """
    front = joint_orientations(pose.rotation, clip.body.parents)[joint_index("head")][:, 2]
    view = camera.centre - place
    return float(front @ view / view.norm())
