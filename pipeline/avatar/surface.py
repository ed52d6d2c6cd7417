"""One level of subdivision: the canonical mesh and the constants that go with it."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.avatar.canonical import HANDS, HEAD, Canonical
from pipeline.avatar.residual import Region
from pipeline.avatar.skinning_tables import Rig
from pipeline.avatar.sparse import SparsePair
from pipeline.avatar.triplane import normalise, region_boxes, sampling


@dataclasses.dataclass(frozen=True)
class Surface:
    """One level of subdivision: the canonical mesh and the constants that go with it.

    Attributes:
        canonical: the mesh.
        samples: from texels to the vertices' features.
        neighbours: the mean over each vertex's neighbours.
        pliable: [N, 1] float, 1 where pose heads may move a vertex: not on head and hands, which
            follow the body model alone.
        rig: the mesh as skinning without gradient needs it.
        residual: the parts that have a residual colour head.
        rows: [N] int64, which of the level's vertices these are; None where they are all of them.
    """

    canonical: Canonical
    samples: SparsePair
    neighbours: SparsePair
    pliable: Tensor  # [N, 1]
    rig: Rig
    residual: tuple[Region, ...] = ()
    rows: Tensor | None = None

    def pick(self, values: Tensor) -> Tensor:
        """The rows of this surface in what is known of every vertex of the finest level: [M, C] -> [N, C]."""
        return values[: len(self.canonical)] if self.rows is None else values[self.rows]


def plane_regions(finest: Canonical) -> tuple[Tensor, Tensor]:
    """The triplane regions of the finest level's vertices, [N], and their boxes, [R, 2, 3].

    Head and rest of the body, or a single region when only one of them is kept.
    """
    head = finest.is_part(*HEAD)
    both = bool(head.any()) and not bool(head.all())
    planes = head.long() if both else torch.zeros(len(finest), dtype=torch.long)
    return planes, region_boxes(finest.vertices, planes)


def build_surface(
    mesh: Canonical, planes: Tensor, boxes: Tensor, resolution: int, residual: tuple[Region, ...]
) -> Surface:
    """The surface of a whole level; see ``plane_regions`` for ``planes`` and ``boxes``."""
    coordinates = normalise(mesh.vertices, planes, boxes)
    samples = sampling(coordinates, planes, len(boxes), resolution)
    pliable = (~mesh.is_part(*HEAD, *HANDS)).float()[:, None]
    return Surface(mesh, samples, mesh.neighbour_mean(), pliable, Rig.build(mesh), residual)
