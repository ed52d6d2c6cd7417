"""All levels of subdivision of an avatar's mesh, each with what goes with it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from torch import Tensor

from pipeline.avatar.architecture import Architecture
from pipeline.avatar.canonical import (
    HANDS,
    HEAD,
    Canonical,
    build_canonical,
    corrected_only,
    open_positions,
)
from pipeline.avatar.posed import initial_scales
from pipeline.avatar.residual import regions
from pipeline.avatar.surface import Surface, build_surface, plane_regions
from pipeline.body import BodyModel, Identity


def finest_level(architecture: Architecture, splits: Sequence[Tensor]) -> int:
    """The midpoint subdivisions of the finest mesh: none where edges are split instead."""
    return 0 if splits else architecture.subdivisions


def inset(mesh: Canonical, architecture: Architecture) -> Canonical:
    """The finest mesh moved into itself, see ``Architecture.inset``; the gate looks at the body's own."""
    if architecture.inset == 0:
        return mesh
    depth = architecture.inset * initial_scales(mesh, architecture)[:, :2].mean(1, keepdim=True)
    return dataclasses.replace(mesh, vertices=mesh.vertices - depth * mesh.frames[..., 2])


def build_surfaces(
    body: BodyModel,
    identity: Identity,
    vertex_ids: Tensor,  # [K]
    architecture: Architecture,
    splits: Sequence[Tensor] = (),
) -> tuple[list[Surface], Tensor]:
    """The surfaces from the unsubdivided mesh to the finest, and the boxes of the triplane, [R, 2, 3] metres.

    Args:
        body: the body model.
        identity: the subject's.
        vertex_ids: [K] int64, the body vertices that carry Gaussians, sorted.
        architecture: sizes.
        splits: rounds of edges that make the finest level; midpoint subdivision makes it if there are none.

    Raises:
        ValueError: as of ``build_canonical``.
    """
    finest = finest_level(architecture, splits)
    if splits:
        meshes = [build_canonical(body, identity, 0, vertex_ids, rounds) for rounds in ((), splits)]
    else:
        meshes = [build_canonical(body, identity, level, vertex_ids) for level in range(finest + 1)]
    if architecture.correctives == "face_and_hands":
        meshes = [corrected_only(mesh, *HEAD, *HANDS) for mesh in meshes]
    meshes[-1] = inset(meshes[-1], architecture)
    places = meshes[-1].vertices
    if architecture.plane_pose == "open":
        places = open_positions(body, identity, finest, vertex_ids, splits)
    planes, boxes = plane_regions(meshes[-1], places)
    residual = regions(meshes, architecture.residual_parts, architecture.place_frequencies)
    side = architecture.plane_resolution
    surfaces = [
        build_surface(mesh, places[: len(mesh)], planes[: len(mesh)], boxes, side, parts)
        for mesh, parts in zip(meshes, residual, strict=True)
    ]
    return surfaces, boxes
