"""Midpoint subdivision of a triangle mesh with whatever its vertices carry."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.body.mesh import edges_of_faces


def subdivide(faces: Tensor, *attributes: Tensor, levels: int = 1) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Split each triangle into four, ``levels`` times, at its edges' midpoints.

    The V vertices stay the first V rows; each level appends one vertex an edge, whose attributes
    are the mean of the edge's two ends. Positions, skinning weights and blendshapes are all
    carried alike, and every one of them stays linear over an original triangle. Face k's four
    children are the rows 4k (towards its first corner), 4k + 1, 4k + 2 and 4k + 3 (the middle).

    Args:
        faces: [F, 3] int64.
        attributes: floating point, [V, ...] each; differentiable.
        levels: at least 0.

    Returns:
        faces [F * 4^levels, 3] and the attributes, in order.
    """
    if any(not attribute.is_floating_point() for attribute in attributes):
        raise TypeError("only floating-point attributes have a midpoint")
    for _ in range(levels):
        count = len(attributes[0]) if attributes else int(faces.max()) + 1
        edges, sides = edges_of_faces(faces)
        attributes = tuple(torch.cat([a, (a[edges[:, 0]] + a[edges[:, 1]]) / 2]) for a in attributes)
        faces = _split(faces, sides + count)
    return faces, attributes


def _split(corners: Tensor, middles: Tensor) -> Tensor:
    """[F, 3] corners and [F, 3] midpoints of the sides 01, 12, 20 -> [4F, 3]."""
    a, b, c = corners.unbind(1)
    ab, bc, ca = middles.unbind(1)
    children = [a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca]
    return torch.stack(children, dim=1).reshape(-1, 3)
