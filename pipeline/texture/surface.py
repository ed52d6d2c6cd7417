"""The mesh that carries the texture: one colour a vertex of the subdivided body.

A texture in UV has seams that every filter must be taught; on the surface itself neighbours are
neighbours. Two subdivisions give vertices 2 to 4 mm apart, finer than a pixel of a person who is less
than about 500 pixels tall.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from pipeline.body import BodyModel, part_labels
from pipeline.body.mesh import edges_of_faces, subdivide
from pipeline.body.parts import PARTS
from pipeline.texture.segments import Segments, find_segments


@dataclasses.dataclass(frozen=True)
class FineSurface:
    """The subdivided body.

    Attributes:
        faces: [F, 3] int64.
        coarse: the body's own triangles; its V vertices are the first ones here.
        ends: for each level the two vertices whose middle each new vertex is, [E, 2] int64.
        segments: of its N vertices, on the template.
    """

    faces: Tensor
    coarse: Tensor
    ends: tuple[Tensor, ...]
    segments: Segments

    def __len__(self) -> int:
        return len(self.segments)

    def refine(self, values: Tensor) -> Tensor:
        """Values of the body's vertices on the fine ones: [V, C] -> [N, C]."""
        return _refined(values, self.ends)


def fine_surface(body: BodyModel, levels: int) -> FineSurface:
    """Subdivide a body ``levels`` times."""
    faces, ends = body.faces, []
    for _ in range(levels):
        ends.append(edges_of_faces(faces)[0])
        faces = subdivide(faces, torch.zeros(int(faces.max()) + 1, 1))[0]
    marks = torch.nn.functional.one_hot(part_labels(body).long(), len(PARTS)).float()
    carried = (body.v_template, body.skinning_weights, marks)
    vertices, weights, marks = (_refined(values, ends) for values in carried)
    joints = body.joint_regressor @ body.v_template
    segments = find_segments(vertices, faces, weights, marks.argmax(1), joints)
    return FineSurface(faces, body.faces, tuple(ends), segments)


def _refined(values: Tensor, ends: Sequence[Tensor]) -> Tensor:
    for pairs in ends:
        values = torch.cat([values, (values[pairs[:, 0]] + values[pairs[:, 1]]) / 2])
    return values
