"""One level of subdivision: the canonical mesh, the constants that go with it, and parts of it.

What the visibility gate leaves (Section 3.4) is a surface of its own. What is left out takes no part in
anything: it is not decoded, not rendered, and no regulariser sees it. Texels that only it would read are in
no product any more, so that their gradient is exactly zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pipeline.avatar.canonical import HANDS, HEAD, Canonical, faces_among
from pipeline.avatar.residual import Region
from pipeline.avatar.skinning_tables import SkinningTables
from pipeline.avatar.sparse import SparsePair
from pipeline.avatar.triplane import bounding_boxes, normalise, sampling_matrix
from pipeline.body import subdivide
from pipeline.body.edge_splits import split_repeatedly


@dataclasses.dataclass(frozen=True)
class Surface:
    """One level of subdivision: the canonical mesh and the constants that go with it.

    Attributes:
        canonical: the mesh.
        samples: from texels to the vertices' features.
        neighbours: the mean over each vertex's neighbours.
        pose_movable: [N, 1] float, 1 where pose heads may move a vertex: not on head and hands, which
            follow the body model alone.
        skinning_tables: the mesh as skinning without gradient needs it.
        residual: the parts that have a residual colour head.
        rows: [N] int64, which of the level's vertices these are; None where they are all of them.
    """

    canonical: Canonical
    samples: SparsePair
    neighbours: SparsePair
    pose_movable: Tensor  # [N, 1]
    skinning_tables: SkinningTables
    residual: tuple[Region, ...] = ()
    rows: Tensor | None = None

    def pick(self, values: Tensor) -> Tensor:
        """The rows of this surface in what is known of every vertex of the finest level: [M, C] -> [N, C]."""
        return values[: len(self.canonical)] if self.rows is None else values[self.rows]


def plane_regions(
    finest: Canonical,
    places: Tensor,  # [N, 3]
) -> tuple[Tensor, Tensor]:
    """The triplane regions of the finest level's vertices, [N], and their boxes, [R, 2, 3].

    Head and rest of the body, or a single region when only one of them is kept.

    Args:
        finest: the mesh.
        places: its vertices' coordinates for the triplane, metres.
    """
    head = finest.is_part(*HEAD)
    both = bool(head.any()) and not bool(head.all())
    planes = head.long() if both else torch.zeros(len(finest), dtype=torch.long)
    return planes, bounding_boxes(places, planes)


def build_surface(
    mesh: Canonical,
    places: Tensor,  # [N, 3]
    planes: Tensor,
    boxes: Tensor,
    resolution: int,
    residual: tuple[Region, ...],
) -> Surface:
    """The surface of a whole level; see ``plane_regions`` for ``places``, ``planes`` and ``boxes``."""
    coordinates = normalise(places, planes, boxes)
    samples = sampling_matrix(coordinates, planes, len(boxes), resolution)
    pose_movable = (~mesh.is_part(*HEAD, *HANDS)).float()[:, None]
    return Surface(mesh, samples, mesh.neighbour_mean(), pose_movable, SkinningTables.build(mesh), residual)


def active_rows(coarse: Canonical, active: Tensor, level: int, splits: Sequence[Tensor] = ()) -> Tensor:
    """The vertices of a level of subdivision that stay, [N] int64.

    One that was put between others stays if all of them do, as if the mesh had been gated first and
    subdivided then.

    Args:
        coarse: the unsubdivided mesh, [K] vertices.
        active: [K] bool, those of its vertices that stay.
        level: of subdivision.
        splits: rounds of edges that were split instead.
    """
    faces, (share,) = subdivide(coarse.faces, active.float()[:, None], levels=level)
    _, (share,) = split_repeatedly(faces, splits, share)
    return torch.nonzero(share[:, 0] == 1)[:, 0]


def restricted(surface: Surface, rows: Tensor) -> Surface:
    """The surface of some of a surface's vertices.

    Their size and their axes stay as they were; the mean over neighbours is that over those that are
    left, and a vertex with none is its own.

    Args:
        surface: with all of its level's vertices.
        rows: [M] int64, increasing.
    """
    canonical, count = surface.canonical, len(surface.canonical)
    place = torch.full((count,), -1, dtype=torch.long, device=rows.device)
    place[rows] = torch.arange(len(rows), device=rows.device)
    chosen: dict[str, Any] = {
        name: None if (values := getattr(canonical, name)) is None else values[rows]
        for name in (
            "vertices", "skinning_weights", "expression_directions", "parts", "frames", "spacing",
        )
    }  # fmt: skip
    chosen |= _correctives(canonical, rows, place)
    mesh = dataclasses.replace(canonical, faces=faces_among(canonical.faces, rows, count), **chosen)
    features = (3 * rows[:, None] + torch.arange(3, device=rows.device)).flatten()  # a row a plane
    return dataclasses.replace(
        surface,
        canonical=mesh,
        samples=surface.samples.of_rows(features),
        neighbours=surface.neighbours.mean_among(rows),
        pose_movable=surface.pose_movable[rows],
        skinning_tables=SkinningTables.build(mesh),
        residual=tuple(
            region for region in (_part(one, place) for one in surface.residual) if len(region.rows)
        ),
        rows=rows,
    )


def _correctives(canonical: Canonical, rows: Tensor, place: Tensor) -> dict[str, Any]:
    """The pose correctives of what stays; ``place`` is each vertex's new number, -1 where it goes."""
    directions, corrected = canonical.pose_directions, canonical.corrected
    if directions is None or corrected is None:
        return {"pose_directions": None if directions is None else directions[rows]}
    new = place[corrected]
    return {"pose_directions": directions[new >= 0], "corrected": new[new >= 0]}


def _part(region: Region, place: Tensor) -> Region:
    new = place[region.rows]
    return dataclasses.replace(region, rows=new[new >= 0], encoded=region.encoded[new >= 0])
