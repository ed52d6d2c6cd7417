"""Face direction: the cosine at which a face looks into the camera, 1 straight, 0 in profile, -1 away.

A face that is turned away is returned by detectors all the same, as a guess. The angle is taken against
the camera's axis: estimators look at a crop around the face, so its place in the picture is gone.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from pipeline.body import joint_orientations
from pipeline.body.joints import joint_index
from stages.fit.camera_batch import CameraBatch

TURNED = 0.4
"""Under this cosine (66 degrees) a face is turned away; half of its points are then behind the other half."""

POSE_TURNED = -0.2
"""The same for the cosine of an initial pose, which is only believed where it is clear."""

# MediaPipe's mesh: outer and inner corners of the eyes, corner of the mouth, cheek; then brow and chin.
_MESH_LEFT, _MESH_RIGHT = (263, 362, 291, 454), (33, 133, 61, 234)
_MESH_TOP, _MESH_BOTTOM = (10, 151, 9), (152, 175, 199)
# iBUG's 68 points.
_RIGHT_EYE, _LEFT_EYE, _MOUTH = slice(36, 42), slice(42, 48), slice(48, 60)
_EYES_OVER_HEIGHT = 0.9  # distance of the eyes over that from eyes to mouth, of the open body's mean face


def mesh_facing(mesh: np.ndarray) -> np.ndarray:
    """The cosine from the normal of a face mesh, whose points have depth.

    Args:
        mesh: [T, 478, 3 or 4], x right, y down, z away, in pixels.

    Returns:
        [T]; 0 where the mesh has no extent.
    """
    places = np.nan_to_num(mesh[..., :3].astype(np.float64))

    def middle(rows: tuple[int, ...]) -> np.ndarray:
        return places[:, list(rows)].mean(1)

    across = middle(_MESH_LEFT) - middle(_MESH_RIGHT)
    down = middle(_MESH_BOTTOM) - middle(_MESH_TOP)
    inwards = np.cross(across, down)  # away from a camera that is looked at
    return inwards[:, 2] / np.maximum(np.linalg.norm(inwards, axis=1), 1e-9)


def points_facing(face: np.ndarray, ears: np.ndarray, threshold: float) -> np.ndarray:
    """The cosine from 68 points without depth.

    A face seen from the front has its eyes and mouth in a winding order, and the triangle between them
    narrows as the face turns. From behind, detectors imagine a face that looks out of the picture; then
    the ears are the wrong way round.

    Args:
        face: [T, 68, 2 or 3], pixels, iBUG's order.
        ears: [T, 2, 3], the left and the right ear, and scores.
        threshold: tau; ears that score less say nothing.

    Returns:
        [T], about the cosine.
    """
    places = np.nan_to_num(face[..., :2].astype(np.float64))
    right, left, mouth = (places[:, part].mean(1) for part in (_RIGHT_EYE, _LEFT_EYE, _MOUTH))
    across, down = left - right, mouth - (left + right) / 2
    area = across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]
    height = np.maximum((down**2).sum(1), 1e-9)
    cosine = np.clip(area / (_EYES_OVER_HEIGHT * height), -1.0, 1.0)
    between = np.nan_to_num(ears[:, 0, :2] - ears[:, 1, :2]).astype(np.float64)
    crossed = (ears[..., 2] >= threshold).all(1) & ((between * across).sum(1) < 0)
    return np.where(crossed, -np.abs(cosine), cosine)


def pose_facing(rotation: Tensor, parents: tuple[int, ...], views: CameraBatch) -> np.ndarray:
    """The cosine from the head of a posed body: [T, 55, 3] rotation vectors -> [T]."""
    head = joint_orientations(rotation, parents)[:, joint_index("head")]
    ahead = (views.rotation @ head)[..., 2]  # the face looks along its +Z
    return (-ahead[:, 2]).double().numpy()
