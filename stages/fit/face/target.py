"""The face that is fitted first, as the registration's target: its places at rest, and its expression.

Frame of reference: the head joint's at rest. Its origin is the rest head joint, its axes are the body's
(Y up, +Z where the face looks, the subject's left is +X). A single uncalibrated camera tells neither how
large a face is nor where the head joint lies below it, so places hold up to a similarity; they are handed
on as near to the body's mean face as that allows, and :func:`sface` moves them onto the prediction.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import roma
import torch
from scipy.spatial import Delaunay
from torch import Tensor

from pipeline.body import BodyModel, edges, mean_identity, rest_joints, uniform_laplacian
from pipeline.body.joints import JAW, joint_index
from pipeline.body.landmarks import PointSet, locate
from stages.fit import terms
from stages.fit.face_offset import on_skin

_LONGEST = 0.03  # metres; a longer side of a triangle between landmarks does not run along the skin
_CENTRE = (0.0, 0.0, -0.06)  # metres from the middle of the face's points to about that of the head


@dataclasses.dataclass(frozen=True)
class FaceTarget:
    """A face fitted first, over T frames.

    Attributes:
        rows: [F] int64, ascending, which of the face's landmarks (478 of the mesh, or 68) it speaks of; all
            lie on skin.
        points: the same F points on the body.
        neutral: [F, 3], metres in the head joint's frame at rest, without expression, mouth shut.
        faces: [K, 3] int64, triangles between the F points.
        edges: [L, 2] int64, their sides.
        laplacian: [F, F], dense; times places it is the mean of a point's neighbours minus itself.
        expression: psi, [T, E], in the body's basis; 0 where not valid.
        jaw: [T, 3], rotation vectors of the jaw; 0 where not valid.
        orientation: [T, 3, 3], the head's rotation from rest to the world; None where the source does
            not say it, the identity where not valid.
        valid: [T] bool, whether a face was fitted in the frame.
        source: ``mesh``, ``points`` (68, without depth) or ``flame``.
    """

    rows: Tensor
    points: PointSet
    neutral: Tensor
    faces: Tensor
    edges: Tensor
    laplacian: Tensor
    expression: Tensor
    jaw: Tensor
    orientation: Tensor | None
    valid: Tensor
    source: str


@dataclasses.dataclass(frozen=True)
class FaceModel:
    """The body's face at its landmarks, as much as a face alone needs.

    Attributes:
        rows: [F], which of the face's landmarks; points: the same on the body.
        mean: [F, 3], metres in the head joint's frame at rest, of the mean body.
        expression: [F, 3, E], metres a unit of psi.
        jaw_weight: [F], how much of the jaw's rotation each point follows.
        jaw_joint: [3], metres, in the same frame.
        faces: [K, 3], triangles between the points.
    """

    rows: Tensor
    points: PointSet
    mean: Tensor
    expression: Tensor
    jaw_weight: Tensor
    jaw_joint: Tensor
    faces: Tensor

    def part(self, chosen: Tensor) -> FaceModel:
        """The same for some of the points: [F] bool."""
        kept = torch.nonzero(chosen)[:, 0]
        new = torch.full((len(self.rows),), -1).scatter(0, kept, torch.arange(len(kept)))
        faces = new[self.faces]
        return FaceModel(
            self.rows[kept], self.points[kept], self.mean[kept], self.expression[kept], self.jaw_weight[kept],
            self.jaw_joint, faces[(faces >= 0).all(1)],
        )  # fmt: skip


def face_model(body: BodyModel, landmarks: PointSet) -> FaceModel:
    """The face of a body at those of its landmarks, 478 of the face mesh or 68, that lie on skin."""
    rows = torch.nonzero(on_skin(body, landmarks))[:, 0]
    points = landmarks[rows]
    joints = rest_joints(body, mean_identity(body))
    head = joints[joint_index("head")]
    share = points.barycentrics
    mean = locate(points, joints, body.v_template) - head
    jaw_weight = (body.skinning_weights[:, JAW][points.vertices] * share).sum(1)
    expression = torch.einsum("fk,fkce->fce", share, body.expression_directions[points.vertices])
    return FaceModel(
        rows, points, mean, expression, jaw_weight, joints[JAW] - head, _triangles(mean, jaw_weight)
    )


def make_target(
    model: FaceModel,
    neutral: Tensor,  # [F, 3]
    expression: Tensor,  # [T, E]
    jaw: Tensor,  # [T, 3]
    valid: Tensor,  # [T]
    source: str,
    orientation: Tensor | None = None,  # [T, 3, 3]
) -> FaceTarget:
    """A target with its triangles' sides and Laplacian; frames that are not valid are blanked."""
    if orientation is not None:
        orientation = torch.where(valid[:, None, None], orientation, torch.eye(3))
    return FaceTarget(
        rows=model.rows,
        points=model.points,
        neutral=neutral,
        faces=model.faces,
        edges=edges(model.faces),
        laplacian=uniform_laplacian(model.faces, len(model.rows)).to_dense(),
        expression=torch.where(valid[:, None], expression, torch.zeros_like(expression)),
        jaw=torch.where(valid[:, None], jaw, torch.zeros_like(jaw)),
        orientation=orientation,
        valid=valid,
        source=source,
    )


def sface(points: Tensor, target: FaceTarget) -> dict[str, Tensor]:
    """The terms of L_sface, Eq. 4, unreduced.

    The prediction is first brought onto the target by the similarity that fits it best: what the target
    cannot know (size, and where the head joint lies) exerts no pull. The gradient runs through the
    similarity, which makes that exact; and it is not the target that is moved, since small faces would
    then have small errors.

    Args:
        points: [F, 3], V_face + Delta V_face: the target's points of the identity at rest, metres, in
            body axes about any origin.
        target: V_FLAME, or the estimator's face.

    Returns:
        ``vertex`` [F] metres, ``laplacian`` [F] square metres, ``edge`` [L] metres.
    """
    goal, laplacian = target.neutral.to(points.dtype), target.laplacian.to(points.dtype)
    points = aligned(points, goal)
    return {
        "vertex": terms.face_vertex_loss(points, goal),
        "laplacian": terms.face_laplacian_loss(points, goal, laplacian),
        "edge": terms.face_edge_loss(points, goal, target.edges),
    }


def aligned(source: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """``source`` brought onto ``target`` by the best similarity: [..., F, 3] twice -> [..., F, 3]."""
    rotation, shift, scale = roma.rigid_points_registration(source, target, weights, compute_scaling=True)
    return scale[..., None, None] * source @ rotation.mT + shift[..., None, :]


def _triangles(mean: Tensor, jaw_weight: Tensor) -> Tensor:
    """Triangles between points of a face, [K, 3] int64, counter-clockwise seen from outside.

    Delaunay's, of the directions in which the points are seen from inside the head. Triangles with a
    side over 3 cm, and those between a lip that follows the jaw and one that does not, are no skin.
    """
    seen_from = mean.mean(0) + mean.new_tensor(_CENTRE)
    away = (mean - seen_from).double().numpy()
    # Azimuth runs to the subject's left and elevation up: counter-clockwise from outside.
    azimuth = np.arctan2(away[:, 0], away[:, 2])
    elevation = np.arctan2(away[:, 1], np.hypot(away[:, 0], away[:, 2]))
    corners = Delaunay(np.stack([azimuth, elevation], axis=1)).simplices.astype(np.int64)
    places = mean[torch.from_numpy(corners)]  # [K, 3, 3]
    longest = (places - places.roll(-1, dims=1)).norm(dim=-1).amax(1)
    lips = jaw_weight[torch.from_numpy(corners)]
    kept = (longest < _LONGEST) & (lips.amax(1) - lips.amin(1) < 0.5)
    return torch.from_numpy(corners)[kept]
