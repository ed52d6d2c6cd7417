"""Triangle meshes: normals, edges, Laplacian, midpoint subdivision, closing the mouth of SMPL-X."""

from __future__ import annotations

import torch
from torch import Tensor

SMPLX_VERTICES = 10_475
SMPLX_LIPS = (2844, 2855, 8977, 1740, 1730, 1789, 8953, 2892)
"""Vertices of SMPL-X on the rim of the hole, in their order around it."""


def face_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Normals as long as twice the triangle's area: [..., V, 3], [F, 3] -> [..., F, 3]."""
    a, b, c = (vertices[..., faces[:, k], :] for k in range(3))
    return torch.linalg.cross(b - a, c - a)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals, area-weighted over the faces around each vertex.

    Args:
        vertices: [..., V, 3], metres; differentiable.
        faces: [F, 3] int64.

    Returns:
        [..., V, 3]; zero at a vertex that no face, or only faces without area, contains.

    >>> triangle = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> vertex_normals(triangle, torch.tensor([[0, 1, 2]]))[0]
    tensor([0., 0., 1.])
    """
    normals = face_normals(vertices, faces)
    summed = torch.zeros_like(vertices)
    for corner in range(3):
        summed = summed.index_add(-2, faces[:, corner], normals)
    return torch.nn.functional.normalize(summed, dim=-1, eps=1e-20)


def edges(faces: Tensor) -> Tensor:
    """The mesh's undirected edges, each once, sorted: [F, 3] -> [E, 2] int64, lower index first."""
    return edges_of_faces(faces)[0]


def edges_of_faces(faces: Tensor) -> tuple[Tensor, Tensor]:
    """The edges, and for each face which three of them are its sides 01, 12 and 20.

    Returns:
        edges [E, 2] as by ``edges``, and sides [F, 3], indices into them.
    """
    sides = torch.stack([faces, faces.roll(-1, dims=1)], dim=2).sort(dim=2).values  # [F, 3 sides, 2 ends]
    count = int(faces.max()) + 1 if len(faces) else 1
    keys = sides[..., 0] * count + sides[..., 1]  # one number an edge: far quicker than unique rows
    unique, inverse = torch.unique(keys, return_inverse=True)
    return torch.stack([unique // count, unique % count], dim=1), inverse


def uniform_laplacian(faces: Tensor, count: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """The matrix whose product with vertex attributes is mean of neighbours minus own value.

    Args:
        faces: [F, 3] int64.
        count: V, the number of vertices.
        dtype: of the matrix.

    Returns:
        [V, V] sparse COO, coalesced; rows of vertices without neighbours are zero.
    """
    pairs = edges(faces)
    rows, columns = torch.cat([pairs, pairs.flip(1)]).unbind(1)
    degree = torch.bincount(rows, minlength=count)
    loops = torch.nonzero(degree)[:, 0]
    indices = torch.stack([torch.cat([rows, loops]), torch.cat([columns, loops])])
    values = torch.cat([1 / degree[rows].to(dtype), degree.new_full((len(loops),), -1, dtype=dtype)])
    return torch.sparse_coo_tensor(indices, values, (count, count), check_invariants=True).coalesce()


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

    >>> faces, (vertices,) = subdivide(torch.tensor([[0, 1, 2]]), torch.eye(3))
    >>> len(faces), vertices[3:].tolist()
    (4, [[0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]])
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


def close_mouth(vertices: Tensor, faces: Tensor) -> Tensor:
    """The mesh's triangles and, where it is SMPL-X's, six more between the lips.

    Through the hole one would look into the back of the head. ExAvatar closes it with six triangles, and so
    does the paper, whose twice subdivided mesh has 167,390 vertices. The open body has an inner mouth.

    Args:
        vertices: [V, 3] at rest, Y up, the face towards +Z.
        faces: [F, 3] int64.

    Returns:
        [F, 3] or [F + 6, 3]; the new ones come last and face forward.
    """
    if len(vertices) != SMPLX_VERTICES:
        return faces
    ring = torch.tensor(SMPLX_LIPS)
    fan = torch.stack([ring[:1].expand(len(ring) - 2), ring[1:-1], ring[2:]], 1)
    forward = face_normals(vertices, fan)[:, 2].sum() >= 0
    return torch.cat([faces, fan if forward else fan.flip(1)])
