"""The face first from FLAME: DECA's identity and expressions, carried over to the body's face.

The mean FLAME head is laid onto the mean body's face by a similarity. Each landmark of the body then
takes the nearest point of FLAME's surface as its own, and what FLAME says of that point is the target.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import roma
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body import BodyModel, mean_identity, rest_joints
from pipeline.body.joints import JAW, LEFT_EYE, RIGHT_EYE, joint_index
from pipeline.errors import UserError
from stages.fit.face.deca import FlameParameters
from stages.fit.face.flame_model import FlameModel
from stages.fit.face.target import FaceModel, FaceTarget, make_target

_FARTHEST = 0.01  # metres from a landmark to FLAME's surface
_ROUNDS = 15  # of nearest points and alignment
_AROUND = 8  # nearest vertices whose triangles are searched
_SAME = 0.1  # of a basis' size by which two bases of the same origin may differ
_RIDGE = 1e-3  # metres: an expression that moves the face less is not worth a coefficient of 1
_LIMIT = 3.0  # of a coefficient that is carried over to another basis


@dataclasses.dataclass(frozen=True)
class Correspondence:
    """Places of the body's landmarks on FLAME's surface.

    Attributes:
        kept: [F] bool, the landmarks that have a place there.
        vertices: [K, 3] int64, the corners of the triangle that each kept one lies on.
        barycentrics: [K, 3].
        rotation: [3, 3], scale and shift [3]: from FLAME's axes to the head joint's frame.
        scale: a number.
        shift: [3], metres.
    """

    kept: Tensor
    vertices: Tensor
    barycentrics: Tensor
    rotation: Tensor
    scale: Tensor
    shift: Tensor

    def of(self, attribute: Tensor) -> Tensor:
        """A vertex attribute at the kept landmarks: [V, ...] -> [K, ...]."""
        return torch.einsum("kc,kc...->k...", self.barycentrics, attribute[self.vertices])


def face_from_flame(
    model: FaceModel, body: BodyModel, flame: FlameModel, parameters: FlameParameters
) -> FaceTarget | None:
    """The clip's face as FLAME and DECA's parameters describe it.

    Args:
        body: the body, for its joints.
        parameters: DECA's, of T frames.

    Returns:
        None where DECA found no face in any frame.

    Raises:
        UserError: the parameters are longer than the model's bases, or the surfaces do not meet.
    """
    sizes = (len(parameters.shape), parameters.expression.shape[1])
    most = (flame.shape_directions.shape[2], flame.expression_directions.shape[2])
    if sizes[0] > most[0] or sizes[1] > most[1]:
        raise UserError(
            f"DECA's files have {sizes[0]} shapes and {sizes[1]} expressions, but the FLAME model has "
            f"{most[0]} and {most[1]}: give the FLAME model that DECA ran with as fit.flame_model"
        )
    if not parameters.valid.any():
        return None
    match = correspond(model, body, flame)
    if int(match.kept.sum()) < len(match.kept) / 2:
        raise UserError(
            "fit.flame_model and the body do not meet: of the face's landmarks, "
            f"{int(match.kept.sum())} of {len(match.kept)} lie within 1 cm of FLAME's surface"
        )
    part = model.part(match.kept)
    places = match.of(flame.shaped(parameters.shape))
    neutral = match.scale * places @ match.rotation.mT + match.shift
    basis = match.of(flame.expression_directions[..., : sizes[1]])
    basis = match.scale * torch.einsum("ab,kbe->kae", match.rotation, basis)
    expression = transfer(part.expression, basis, parameters.expression)
    return make_target(part, neutral, expression, parameters.jaw, parameters.valid, "flame")


def correspond(model: FaceModel, body: BodyModel, flame: FlameModel) -> Correspondence:
    """Lay FLAME's mean head onto the body's, and find each landmark's nearest point on it.

    The alignment starts from the joints that both skeletons have (head, jaw, eyes) and is refined by
    nearest points, of which the farther half is left out each time.
    """
    joints = rest_joints(body, mean_identity(body))
    ours = joints[[joint_index("head"), JAW, LEFT_EYE, RIGHT_EYE]] - joints[joint_index("head")]
    rotation, shift, scale = roma.rigid_points_registration(
        flame.joints[1:].double(), ours.double(), compute_scaling=True
    )
    triangles = flame.faces.numpy()
    around = _triangles_around(triangles, len(flame.v_template))
    mean = model.mean.double()
    for _ in range(_ROUNDS):
        vertices = scale * flame.v_template.double() @ rotation.mT + shift
        face, places = _nearest(mean.numpy(), vertices.numpy(), triangles, around)
        away = (torch.from_numpy(places) - mean).norm(dim=1)
        near = away <= away.median()
        source = (torch.from_numpy(places)[near] - shift) @ rotation / scale
        rotation, shift, scale = roma.rigid_points_registration(source, mean[near], compute_scaling=True)
    vertices = scale * flame.v_template.double() @ rotation.mT + shift
    face, places = _nearest(mean.numpy(), vertices.numpy(), triangles, around)
    kept = np.linalg.norm(places - mean.numpy(), axis=1) <= _FARTHEST
    corners = triangles[face[kept]]
    barycentrics = trimesh.triangles.points_to_barycentric(vertices.numpy()[corners], places[kept])
    return Correspondence(
        torch.from_numpy(kept), torch.from_numpy(corners), torch.from_numpy(barycentrics).float(),
        rotation.float(), scale.float(), shift.float(),
    )  # fmt: skip


def transfer(ours: Tensor, theirs: Tensor, expression: Tensor) -> Tensor:
    """Expressions of another basis in the body's own: [T, K] -> [T, E].

    The official SMPL-X shares its expression basis with FLAME, coefficient by coefficient. Whether two
    bases are such twins is measured, not guessed from names: where the common columns move the face
    alike to within a tenth, coefficients are copied; else they are fitted by ridge least squares.

    Args:
        ours: [F, 3, E], metres a unit.
        theirs: [F, 3, K], metres a unit, at the same points and in the same axes.
        expression: [T, K].
    """
    common = min(ours.shape[2], theirs.shape[2])
    away = (ours[..., :common] - theirs[..., :common]).norm()
    if common >= 10 and away <= _SAME * theirs[..., :common].norm():
        copied = expression.new_zeros(len(expression), ours.shape[2])
        copied[:, :common] = expression[:, :common]
        return copied
    ours, theirs = ours.flatten(0, 1).double(), theirs.flatten(0, 1).double()
    points = len(ours) / 3
    normal = ours.mT @ ours + points * _RIDGE**2 * torch.eye(ours.shape[1], dtype=ours.dtype) / 10
    carried = torch.linalg.solve(normal, ours.mT @ theirs)  # [E, K]
    return (expression.double() @ carried.mT).clamp(-_LIMIT, _LIMIT).float()


def _triangles_around(triangles: np.ndarray, count: int) -> np.ndarray:
    """The triangles around each vertex, [V, most], filled up with the first of them."""
    order = np.argsort(triangles.ravel(), kind="stable")
    owners = order // 3
    degree = np.bincount(triangles.ravel(), minlength=count)
    begins = np.concatenate([[0], np.cumsum(degree)[:-1]])
    column = np.arange(max(int(degree.max()), 1))
    place = begins[:, None] + np.where(column < degree[:, None], column, 0)
    return owners[np.minimum(place, len(owners) - 1)]


def _nearest(
    points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, around: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest point of a surface: triangles [N] and places [N, 3]; searched near the nearest vertices."""
    used = np.unique(triangles)  # a vertex without triangles is no surface
    _, close = cKDTree(vertices[used]).query(points, k=min(_AROUND, len(used)))
    candidates = around[used[close.reshape(len(points), -1)]].reshape(len(points), -1)
    corners = vertices[triangles[candidates.ravel()]]
    places = trimesh.triangles.closest_point(corners, np.repeat(points, candidates.shape[1], axis=0))
    places = places.reshape(*candidates.shape, 3)
    best = np.linalg.norm(places - points[:, None], axis=2).argmin(1)
    rows = np.arange(len(points))
    return candidates[rows, best], places[rows, best]
