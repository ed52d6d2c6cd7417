"""The mesh that carries the texture: one colour a vertex of the subdivided body.

A texture in UV has seams that every filter must be taught; on the surface itself neighbours are
neighbours. Two subdivisions give vertices 2 to 4 mm apart, finer than a pixel of a person who is less
than about 500 pixels tall.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body import PARTS, BodyModel, is_face, joint_index, part_labels
from pipeline.body.mesh import edges_of_faces, subdivide

_EARS = 0.03  # metres behind the jaw's hinge, as far as the ears reach


@dataclasses.dataclass(frozen=True)
class FineSurface:
    """The subdivided body.

    Attributes:
        faces: [F, 3] int64.
        coarse: the body's own triangles; its V vertices are the first ones here.
        ends: for each level the two vertices whose middle each new vertex is, [E, 2] int64.
        mirrored: [N] int64, the vertex that is nearest to each one's mirror image on the template.
        region: [N] int8, 1 on face and ears, 2 on the rest of the skull, else 0.
        part: [N] int64, index into ``pipeline.body.parts.PARTS``.
    """

    faces: Tensor
    coarse: Tensor
    ends: tuple[Tensor, ...]
    mirrored: np.ndarray
    region: np.ndarray
    part: np.ndarray

    def __len__(self) -> int:
        return len(self.mirrored)

    def refine(self, values: Tensor) -> Tensor:
        """Values of the body's vertices on the fine ones: [V, C] -> [N, C]."""
        for pairs in self.ends:
            values = torch.cat([values, (values[pairs[:, 0]] + values[pairs[:, 1]]) / 2])
        return values

    def edges(self, coarse: bool = False) -> np.ndarray:
        """Every edge within a region once, of the fine mesh or the body's own: [E, 2] int64."""
        pairs = edges_of_faces(self.coarse if coarse else self.faces)[0].numpy()
        return pairs[self.region[pairs[:, 0]] == self.region[pairs[:, 1]]]


def fine_surface(body: BodyModel, levels: int) -> FineSurface:
    """Subdivide a body ``levels`` times."""
    faces, ends = body.faces, []
    for _ in range(levels):
        ends.append(edges_of_faces(faces)[0])
        faces = subdivide(faces, torch.zeros(int(faces.max()) + 1, 1))[0]
    none = np.zeros(0, np.int64)
    bare = FineSurface(faces, body.faces, tuple(ends), none, none, none)
    template = bare.refine(body.v_template).numpy()
    mirrored = cKDTree(template).query(template * [-1, 1, 1])[1]
    return dataclasses.replace(
        bare, mirrored=mirrored.astype(np.int64), region=_regions(body, bare), part=_parts(body, bare)
    )


def _parts(body: BodyModel, surface: FineSurface) -> np.ndarray:
    marks = torch.nn.functional.one_hot(part_labels(body).long(), len(PARTS)).float()
    return surface.refine(marks).argmax(1).numpy()


def _regions(body: BodyModel, surface: FineSurface) -> np.ndarray:
    joints = body.joint_regressor @ body.v_template
    face = is_face(body)
    ears = joints[joint_index("jaw"), 2] - _EARS
    front = (body.v_template[:, 2] > ears) & (body.v_template[:, 1] < body.v_template[face, 1].max())
    head = body.skinning_weights[:, joint_index("head")] > 0.5
    marks = torch.stack([face | (head & front), head & ~face & ~front], dim=1).float()
    carried = surface.refine(marks).numpy()
    return np.where(carried[:, 0] > 0.5, 1, np.where(carried[:, 1] > 0.5, 2, 0)).astype(np.int8)
