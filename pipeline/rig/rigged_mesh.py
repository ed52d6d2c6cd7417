"""The body of one person as glTF wants a skinned mesh: seams of the texture cut, few joints a vertex."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, rest_joints, rest_vertices, vertex_normals
from pipeline.body.expressions import Expressions

SET = 4  # joints in one of glTF's sets
MOST = 2 * SET  # joints a vertex that are written; readers must know one set, and most know two
_STILL = 1e-6  # metres; a vertex that a morph target moves less is not part of it


@dataclasses.dataclass(frozen=True)
class MorphTarget:
    """One expression as displacements.

    Attributes:
        name: of the expression.
        rows: [M] int64, increasing, the vertices that it moves; may be none.
        offsets: [M, 3] float32, metres at weight 1, in the rest pose.
    """

    name: str
    rows: np.ndarray
    offsets: np.ndarray


@dataclasses.dataclass(frozen=True)
class RiggedMesh:
    """A skinned mesh in its rest pose, the T pose; metres, Y up, it faces +Z.

    Attributes:
        vertices: [N, 3] float32.
        normals: [N, 3] float32.
        uv: [N, 2] float32, origin at the top left as glTF has it; [N, 0] where the body has no texture
            coordinates.
        faces: [F, 3] int64.
        source: [N] int64, the body's vertex that each one is.
        joint_ids: [N, 4 or 8] int64, those with the largest weights first.
        weights: [N, 4 or 8] float32, rows sum to 1.
        cut: the largest sum of skinning weights that a vertex lost because only 8 are kept; 0 mostly.
        joints: [55, 3] float32, rest joints.
        parents: of the joints, -1 for the root.
        joint_names: of the joints.
        morphs: the expressions that move something.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    source: np.ndarray
    joint_ids: np.ndarray
    weights: np.ndarray
    cut: float
    joints: np.ndarray
    parents: tuple[int, ...]
    joint_names: tuple[str, ...]
    morphs: tuple[MorphTarget, ...]

    def __len__(self) -> int:
        return len(self.vertices)


def rigged_mesh(
    body: BodyModel, identity: Identity, expressions: Expressions, shown: Tensor | None = None
) -> RiggedMesh:
    """The mesh of one person, without the body's pose correctives: glTF has no word for them.

    Args:
        body: the body model.
        identity: the person's.
        expressions: those that become morph targets.
        shown: [V] bool, the vertices that are wanted; a triangle stays if all of its corners are. All if
            None.
    """
    rest = rest_vertices(body, identity)
    normals = vertex_normals(rest, body.faces)
    kept = torch.ones(len(body.faces), dtype=torch.bool) if shown is None else shown[body.faces].all(1)
    source, faces, uv = _corners(body, kept.numpy())
    joint_ids, weights, cut = strongest_joints(body.skinning_weights.numpy()[source])
    moved = torch.einsum("vck,mk->mvc", body.expression_directions[source], expressions.coefficients)
    targets = (_morph(name, one.numpy()) for name, one in zip(expressions.names, moved, strict=True))
    return RiggedMesh(
        vertices=rest.numpy()[source],
        normals=normals.numpy()[source],
        uv=uv,
        faces=faces,
        source=source,
        joint_ids=joint_ids,
        weights=weights,
        cut=cut,
        joints=rest_joints(body, identity).numpy(),
        parents=body.parents,
        joint_names=body.joint_names,
        morphs=tuple(target for target in targets if len(target.rows)),
    )


def strongest_joints(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The joints that matter to each vertex, and their weights.

    Args:
        weights: [N, 55], rows sum to 1.

    Returns:
        joints [N, 4 or 8] int64 and weights float32, the largest first, unused ones 0; and the largest sum of
        weights that a row lost.
    """
    most = int((weights > 0).sum(1).max(initial=0))
    count = SET if most <= SET else MOST
    order = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    kept = np.take_along_axis(weights.astype(np.float64), order, 1)
    total = kept.sum(1, keepdims=True)
    cut = float((weights.sum(1, dtype=np.float64) - total[:, 0]).max(initial=0)) if most > count else 0.0
    shares = (kept / total).astype(np.float32)
    return np.where(shares > 0, order, 0), shares, cut


def _corners(body: BodyModel, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Body vertex of each mesh vertex [N], triangles [F, 3], and texture coordinates [N, 2] or [N, 0].

    A vertex at a seam of the texture, which has several places in it, becomes several.
    """
    faces = body.faces.numpy()[kept]
    if not len(body.uv):
        source, corners = np.unique(faces, return_inverse=True)
        return source, corners.reshape(-1, 3), np.zeros((len(source), 0), np.float32)
    pairs = np.stack([faces, body.uv_faces.numpy()[kept]], -1).reshape(-1, 2)
    unique, corners = np.unique(pairs, axis=0, return_inverse=True)
    uv = body.uv.numpy()[unique[:, 1]] * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
    return unique[:, 0], corners.reshape(-1, 3), uv


def _morph(name: str, offsets: np.ndarray) -> MorphTarget:
    rows = np.flatnonzero(np.abs(offsets).max(1, initial=0) > _STILL)
    return MorphTarget(name, rows, offsets[rows].astype(np.float32))
