"""A part of a surface as a surface of its own: the Gaussians that the visibility gate leaves (Section 3.4).

What is left out takes no part in anything: it is not decoded, not rendered, and no regulariser sees it.
Texels that only it would read are in no product any more, so that their gradient is exactly zero.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from pipeline.avatar.canonical import Canonical, faces_among
from pipeline.avatar.residual import Region
from pipeline.avatar.skinning_tables import Rig
from pipeline.avatar.surface import Surface
from pipeline.body import subdivide


def active_rows(coarse: Canonical, active: Tensor, level: int) -> Tensor:
    """The vertices of a level of subdivision that stay, [N] int64.

    One that was put between others stays if all of them do, as if the mesh had been gated first and
    subdivided then.

    Args:
        coarse: the unsubdivided mesh, [K] vertices.
        active: [K] bool, those of its vertices that stay.
        level: of subdivision.
    """
    _, (share,) = subdivide(coarse.faces, active.float()[:, None], levels=level)
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
            "vertices", "skinning_weights", "expression_directions", "pose_directions", "parts", "frames",
            "spacing",
        )
    }  # fmt: skip
    mesh = dataclasses.replace(canonical, faces=faces_among(canonical.faces, rows, count), **chosen)
    features = (3 * rows[:, None] + torch.arange(3, device=rows.device)).flatten()  # a row a plane
    return dataclasses.replace(
        surface,
        canonical=mesh,
        samples=surface.samples.of_rows(features),
        neighbours=surface.neighbours.mean_among(rows),
        pliable=surface.pliable[rows],
        rig=Rig.build(mesh),
        residual=tuple(
            region for region in (_part(one, place) for one in surface.residual) if len(region.rows)
        ),
        rows=rows,
    )


def _part(region: Region, place: Tensor) -> Region:
    new = place[region.rows]
    return dataclasses.replace(region, rows=new[new >= 0], encoded=region.encoded[new >= 0])
