"""The canonical mesh that carries the Gaussians: one a vertex (the paper's Section 3.3).

The order of making it: the identity's rest mesh; the vertices that any frame can show (see
``stages/train/visibility_gate.py``); midpoint subdivision of what is left. The gate comes before the
subdivision, so that a finer mesh is gated exactly as the coarse one was.

Canonical positions are those of the rest pose, in metres, Y up, the subject's left at +X.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from pipeline.avatar.sparse import SparsePair
from pipeline.body import (
    PARTS,
    BodyModel,
    Identity,
    edges,
    joint_index,
    mean_identity,
    part_labels,
    pose_body,
    rest_joints,
    rest_vertices,
    subdivide,
    vertex_normals,
)
from pipeline.body.edge_splits import split_repeatedly
from pipeline.body.joints import JAW
from pipeline.body.mesh import close_mouth

HEAD = ("head", "face")
HANDS = ("left_hand", "right_hand")
SMALLEST_SPACING, LARGEST_SPACING = 1e-3, 0.05  # metres; a guard against slivers and huge triangles


@dataclasses.dataclass(frozen=True)
class Canonical:
    """The canonical mesh of one level of subdivision; each vertex carries a Gaussian.

    Attributes:
        vertices: [N, 3], metres.
        faces: [F, 3] int64.
        skinning_weights: [N, 55], rows sum to 1.
        expression_directions: [N, 3, E], metres a unit of expression.
        pose_directions: [P, 3, 486], the body's pose correctives of some vertices; None if it has none.
        corrected: [P] int64, these vertices; None where they are all of them.
        parts: [N] int64, index into ``pipeline.body.parts.PARTS``.
        frames: [N, 3, 3], columns are two tangents and the outward normal at rest.
        spacing: [N, 2], how far a vertex's neighbours lie along each of the two tangents, metres.
        joints: [55, 3], rest joints, metres.
        parents: parent of each joint, -1 for the root.
    """

    vertices: Tensor  # [N, 3]
    faces: Tensor  # [F, 3]
    skinning_weights: Tensor  # [N, 55]
    expression_directions: Tensor  # [N, 3, E]
    pose_directions: Tensor | None  # [P, 3, 486]
    parts: Tensor  # [N]
    frames: Tensor  # [N, 3, 3]
    spacing: Tensor  # [N, 2]
    joints: Tensor  # [55, 3]
    parents: tuple[int, ...]
    corrected: Tensor | None = None

    def __len__(self) -> int:
        return len(self.vertices)

    def is_part(self, *names: str) -> Tensor:
        """[N] bool: the vertices of the named parts."""
        wanted = torch.tensor(
            [PARTS.index(name) for name in names], dtype=torch.long, device=self.parts.device
        )
        return torch.isin(self.parts, wanted)

    def expressive(self) -> tuple[Tensor, Tensor]:
        """The vertices that expressions move, [P] int64, and how, [P, 3, E] metres a unit."""
        rows = torch.nonzero(self.expression_directions.flatten(1).any(1))[:, 0]
        return rows, self.expression_directions[rows].contiguous()

    def neighbour_mean(self) -> SparsePair:
        """[N, N]: the mean over a vertex's neighbours, the uniform Laplacian's second half."""
        start, end = directed_edges(self.faces).unbind(1)
        degree = torch.bincount(start, minlength=len(self)).clamp_min(1)
        return SparsePair.build(start, end, 1.0 / degree[start].float(), (len(self), len(self)))


def corrected_only(canonical: Canonical, *parts: str) -> Canonical:
    """The mesh with the body's pose correctives on some parts alone."""
    if canonical.pose_directions is None:
        return canonical
    rows = torch.nonzero(canonical.is_part(*parts))[:, 0]
    directions = canonical.pose_directions[rows].clone()
    return dataclasses.replace(canonical, pose_directions=directions, corrected=rows)


def open_positions(
    body: BodyModel, identity: Identity, levels: int, vertex_ids: Tensor, splits: Sequence[Tensor] = ()
) -> Tensor:
    """The canonical mesh's vertices on the mean identity with legs apart and the mouth open, [N, 3] metres.

    ExAvatar's coordinates of the triplane: legs that hang side by side, and lips that touch, would share
    texels, and the same place of two people has the same features to begin with. Hips turn about Z by 1 rad
    each, the jaw by a third about X.

    Args:
        body, identity, levels, vertex_ids, splits: as of ``build_canonical``, whose mesh it is.
    """
    rotation = torch.zeros(1, len(body.parents), 3)
    rotation[0, joint_index("left_hip"), 2], rotation[0, joint_index("right_hip"), 2] = 1.0, -1.0
    rotation[0, JAW, 0] = 1 / 3
    nothing = torch.zeros(1, 1)
    vertices, _ = pose_body(body, mean_identity(body), rotation, nothing, torch.zeros(1, 3))
    faces = faces_among(close_mouth(rest_vertices(body, identity), body.faces), vertex_ids, vertices.shape[1])
    faces, (places,) = subdivide(faces, vertices[0, vertex_ids], levels=levels)
    return split_repeatedly(faces, splits, places)[1][0]


def directed_edges(faces: Tensor) -> Tensor:
    """Every edge of a triangle mesh once in each direction: [F, 3] -> [2 E, 2]."""
    once = edges(faces)
    return torch.cat([once, once.flip(1)])


def dilate(mask: Tensor, faces: Tensor, rings: int) -> Tensor:
    """Adds the neighbours of the marked vertices, ``rings`` times: [V] bool -> [V] bool."""
    start, end = directed_edges(faces).unbind(1)
    for _ in range(rings):
        mask = mask.clone()
        mask[end[mask[start]]] = True
    return mask


def build_canonical(
    body: BodyModel,
    identity: Identity,
    levels: int,
    vertex_ids: Tensor | None = None,
    splits: Sequence[Tensor] = (),
) -> Canonical:
    """The canonical mesh of one identity.

    Args:
        body: the body model.
        identity: the subject's fitted identity.
        levels: of midpoint subdivision: 0, 1 or 2.
        vertex_ids: [K] int64, body vertices that stay, sorted; all of them if None. A triangle stays if
            its three vertices do, a vertex stays even when no triangle of it does.
        splits: rounds of edges that are split instead, see ``density.py``; with ``levels`` 0.

    Raises:
        ValueError: if ``vertex_ids`` is empty or names a vertex that the body has not, or ``splits`` an edge
            that the mesh has not.
    """
    vertices = rest_vertices(body, identity)
    faces = close_mouth(vertices, body.faces)
    if vertex_ids is None:
        vertex_ids = torch.arange(len(vertices))
    if len(vertex_ids) == 0 or int(vertex_ids.max()) >= len(vertices):
        raise ValueError(f"the kept vertices must be some of the body's {len(vertices)}")
    carried = [
        vertices,
        body.skinning_weights,
        body.expression_directions,
        functional.one_hot(part_labels(body).long(), len(PARTS)).float(),
        vertex_normals(vertices, faces),
    ]
    if body.pose_directions is not None:
        carried.append(body.pose_directions)
    faces = faces_among(faces, vertex_ids, len(vertices))
    faces, attributes = subdivide(faces, *(attribute[vertex_ids] for attribute in carried), levels=levels)
    faces, attributes = split_repeatedly(faces, splits, *attributes)
    vertices, weights, directions, labels, normals, *correctives = attributes
    frames = tangent_frames(functional.normalize(normals, dim=-1))
    return Canonical(
        vertices=vertices,
        faces=faces,
        skinning_weights=weights,
        expression_directions=directions,
        pose_directions=correctives[0] if correctives else None,
        parts=labels.argmax(1),
        frames=frames,
        spacing=tangent_spacing(vertices, faces, frames),
        joints=rest_joints(body, identity),
        parents=body.parents,
    )


def tangent_frames(normals: Tensor) -> Tensor:
    """A right-handed frame at each normal: [N, 3] -> [N, 3, 3], columns tangent, bitangent, normal.

    The first tangent is horizontal where the normal is not nearly vertical, so that neighbours have
    similar frames; there it is taken across the body's Z axis instead.
    """
    up = torch.tensor([0.0, 1.0, 0.0]).expand_as(normals)
    forward = torch.tensor([0.0, 0.0, 1.0]).expand_as(normals)
    axis = torch.where(normals[:, 1:2].abs() > 0.95, forward, up)
    tangent = functional.normalize(torch.linalg.cross(axis, normals), dim=-1)
    return torch.stack([tangent, torch.linalg.cross(normals, tangent), normals], -1)


def tangent_spacing(vertices: Tensor, faces: Tensor, frames: Tensor) -> Tensor:
    """The distance of each vertex's neighbours along its two tangents, [N, 2], metres, clamped.

    ``sqrt(2 mean (e . t)^2)`` over the edges e at the vertex: the edge length where triangles are
    regular, and more along than across where they are long and thin. Round Gaussians of the mean
    edge length would leave gaps there, as on the limbs.
    """
    start, end = directed_edges(faces).unbind(1)
    along = torch.einsum("ec,eck->ek", vertices[end] - vertices[start], frames[start][:, :, :2]).square()
    total = torch.zeros(len(vertices), 2).index_add_(0, start, along)
    degree = torch.bincount(start, minlength=len(vertices)).clamp_min(1)
    return (2 * total / degree[:, None]).sqrt().clamp(SMALLEST_SPACING, LARGEST_SPACING)


def faces_among(faces: Tensor, vertex_ids: Tensor, count: int) -> Tensor:
    """The triangles whose three corners are kept, in the numbers that these then have: [F, 3] -> [G, 3]."""
    new_index = torch.full((count,), -1, dtype=torch.long, device=faces.device)
    new_index[vertex_ids] = torch.arange(len(vertex_ids), device=faces.device)
    inside = (new_index[faces] >= 0).all(1)
    return new_index[faces[inside]]
