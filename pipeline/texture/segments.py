"""Segments of the body's surface between which nothing may spread, and what in each resembles what.

Unseen surface is completed from seen surface of its own segment: hair from the scalp, cloth from trunk and
limbs, skin from skin. The segments come from joints and skinning weights alone, so that they hold for any
mesh of the schema, however it is divided.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.joints import joint_index
from pipeline.body.mesh import edges_of_faces, vertex_normals
from pipeline.body.parts import PARTS

FACE, SCALP, NECK, BODY, LEFT_HAND, RIGHT_HAND = range(6)
OTHER_SIDE = np.array([FACE, SCALP, NECK, BODY, RIGHT_HAND, LEFT_HAND])  # the mirror image's segment
SKIN = (FACE, NECK, LEFT_HAND, RIGHT_HAND)
HEAD = (FACE, SCALP, NECK)
EARS = 0.03  # metres behind the jaw's hinge, as far as the ears reach
EAR_TOP = 0.025  # metres above the eyes, as high as the ears reach: what lies higher at the side is scalp
_ALONG_X = ("left_arm", "right_arm", "left_hand", "right_hand")  # in T pose; all else lies along Y


@dataclasses.dataclass(frozen=True)
class Segments:
    """A surface of N vertices at rest, in T pose.

    Attributes:
        edges: [E, 2] int64, each edge of the mesh once that does not cross between segments.
        seams: [S, 2] int64, those that do.
        label: [N] int64, FACE with the ears, SCALP, NECK, BODY (trunk, arms, legs), LEFT_HAND or RIGHT_HAND.
        part: [N] int64, index into ``PARTS``.
        along: [N] float64, metres along the part's limb: a ring around it has one value.
        around: [N] float64, radians in [-pi, pi] about the part's limb: a line along it has one value.
        mirrored: [N] int64, the vertex nearest to each one's mirror image.
        normals: [N, 3] float64, unit, outward, at rest.
        spacing: [N] float64, mean length of the edges at a vertex, metres.
    """

    edges: np.ndarray
    seams: np.ndarray
    label: np.ndarray
    part: np.ndarray
    along: np.ndarray
    around: np.ndarray
    mirrored: np.ndarray
    normals: np.ndarray
    spacing: np.ndarray

    def __len__(self) -> int:
        """N."""
        return len(self.label)

    def is_in(self, *labels: int) -> np.ndarray:
        """[N] bool: the vertices of some segments."""
        return np.isin(self.label, labels)


def find_segments(
    vertices: Tensor,  # [N, 3]
    faces: Tensor,  # [F, 3]
    skinning_weights: Tensor,  # [N, 55]
    parts: Tensor,  # [N]
    joints: Tensor,  # [55, 3]
) -> Segments:
    """The segments of a mesh.

    Args:
        vertices: at rest, T pose, metres, Y up, the face towards +Z.
        faces: int64; may be few, where vertices were left out.
        skinning_weights: rows sum to 1.
        parts: int64, index into ``PARTS``.
        joints: at rest, metres.
    """
    vertices, faces, weights, parts, joints = (
        one.detach().cpu() for one in (vertices, faces, skinning_weights, parts, joints)
    )
    places, label = vertices.double().numpy(), _labels(vertices, weights, parts, joints)
    pairs = edges_of_faces(faces)[0].numpy()
    lengths = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    ends = pairs.ravel()
    total, degree = (
        np.bincount(ends, values, len(places)) for values in (np.repeat(lengths, 2), np.ones(len(ends)))
    )
    part = parts.long().numpy()
    along_x = np.isin(part, [PARTS.index(name) for name in _ALONG_X])
    within = label[pairs[:, 0]] == label[pairs[:, 1]]
    return Segments(
        edges=pairs[within],
        seams=pairs[~within],
        label=label,
        part=part,
        along=np.where(along_x, np.abs(places[:, 0]), places[:, 1]),
        around=_angles(np.where(along_x, places[:, 1], places[:, 0]), places[:, 2], part),
        mirrored=cKDTree(places).query(places * [-1, 1, 1])[1].astype(np.int64),
        normals=vertex_normals(vertices, faces).double().numpy(),
        spacing=total / np.maximum(degree, 1),
    )


def _angles(across: np.ndarray, forward: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Angles about the middle of each part, 0 in front: [N] radians."""
    size = np.maximum(np.bincount(part), 1)
    middle = [np.bincount(part, values) / size for values in (across, forward)]
    return np.arctan2(across - middle[0][part], forward - middle[1][part])


def _labels(vertices: Tensor, weights: Tensor, parts: Tensor, joints: Tensor) -> np.ndarray:
    def of(*names: str) -> Tensor:
        return torch.isin(parts.long(), torch.tensor([PARTS.index(name) for name in names]))

    face, skull = of("face"), weights[:, joint_index("head")] > 0.5
    ears = joints[joint_index("jaw"), 2] - EARS
    eyes = joints[[joint_index("left_eye"), joint_index("right_eye")], 1].mean()
    front = (vertices[:, 2] > ears) & (vertices[:, 1] < eyes + EAR_TOP)
    label = torch.full((len(vertices),), BODY)
    label[of("head")] = NECK
    label[of("head") & skull & ~front] = SCALP
    label[face | (skull & front)] = FACE
    label[of("left_hand")], label[of("right_hand")] = LEFT_HAND, RIGHT_HAND
    return label.numpy().astype(np.int64)
