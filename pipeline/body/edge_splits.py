"""Uneven refinement of a triangle mesh: some of its edges get a vertex in their middle."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pipeline.body.mesh import edges_of_faces


def split_edges(
    faces: Tensor,  # [F, 3]
    chosen: Tensor,  # [S, 2]
    *attributes: Tensor,  # [V, ...]
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The mesh with a new vertex in the middle of each chosen edge.

    A triangle with one, two or three such edges becomes two, three or four triangles, so that no gap opens
    beside one with none. The V vertices stay the first V; the new ones follow in the order of the edges, and
    their attributes are the mean of the edge's two ends.

    Args:
        faces: int64.
        chosen: int64, edges of the mesh, each once, its lower vertex first.
        attributes: floating point; differentiable.

    Returns:
        faces [G, 3] and the attributes [V + S, ...], in order.

    Raises:
        ValueError: a chosen edge is none of the mesh's, or is there twice.

    >>> faces, (vertices,) = split_edges(torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1]]), torch.eye(3))
    >>> faces.tolist(), vertices[3].tolist()
    ([[0, 3, 2], [3, 1, 2]], [0.5, 0.5, 0.0])
    """
    count = len(attributes[0]) if attributes else int(faces.max()) + 1
    all_edges, sides = edges_of_faces(faces)
    middles = torch.full((len(all_edges),), -1, dtype=torch.long, device=faces.device)
    middles[_places(all_edges, chosen)] = count + torch.arange(len(chosen), device=faces.device)
    ends = chosen.unbind(1)
    carried = tuple(torch.cat([values, (values[ends[0]] + values[ends[1]]) / 2]) for values in attributes)
    return _split(faces, middles[sides]), carried


def split_repeatedly(
    faces: Tensor, splits: Sequence[Tensor], *attributes: Tensor
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The mesh after several rounds of ``split_edges``; each round names edges of the mesh before it."""
    for chosen in splits:
        faces, attributes = split_edges(faces, chosen, *attributes)
    return faces, attributes


def _places(all_edges: Tensor, chosen: Tensor) -> Tensor:
    """The rows of sorted edges that the chosen ones are, [S]."""
    if not len(chosen):
        return chosen.new_zeros(0)
    low, high = int(chosen.min()), max(int(chosen.max()), int(all_edges.max()) if len(all_edges) else 0)
    if low < 0:
        raise ValueError("an edge has a negative vertex")
    keys, wanted = (pairs[:, 0] * (high + 1) + pairs[:, 1] for pairs in (all_edges, chosen))
    places = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
    if not len(keys) or not torch.equal(keys[places], wanted):
        raise ValueError("a chosen edge is none of the mesh's edges")
    if len(wanted.unique()) < len(wanted):
        raise ValueError("an edge is chosen twice")
    return places


def _split(
    corners: Tensor,  # [F, 3]
    middles: Tensor,  # [F, 3], of the sides 01, 12 and 20; -1 where a side stays whole
) -> Tensor:
    number = (middles >= 0).sum(1)
    # Each triangle is turned until its split sides come first: 01; 01 and 12.
    first = torch.where(number == 1, (middles >= 0).long().argmax(1), (middles < 0).long().argmax(1) + 1) % 3
    turned = (first[:, None] + torch.arange(3, device=corners.device)) % 3
    corners, middles = corners.gather(1, turned), middles.gather(1, turned)
    (a, b, c), (ab, bc, ca) = corners.unbind(1), middles.unbind(1)
    children = {
        0: ((a, b, c),),
        1: ((a, ab, c), (ab, b, c)),
        2: ((a, ab, bc), (ab, b, bc), (a, bc, c)),
        3: ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)),
    }
    found = []
    for split, triangles in children.items():
        rows = number == split
        found += [torch.stack([corner[rows] for corner in triangle], 1) for triangle in triangles]
    return torch.cat(found)
