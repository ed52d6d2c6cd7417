"""Whose shape and expression coefficients a body can read."""

from __future__ import annotations

from pipeline.body import BodyModel
from pipeline.pose_files.read import InitialPoses

_VERTICES, _TRIANGLES = 10_475, 20_908  # of every release of SMPL-X


def is_official_smplx(body: BodyModel) -> bool:
    """Whether coefficients of SMPL-X mean to this body what they mean to SMPL-X.

    Poses carry over between bodies of one skeleton, betas and expressions do not: the open body's are
    components of its own. The official model is known by its mesh, 10,475 vertices and 20,908 triangles,
    and by at least ten shape and ten expression directions, which every release has. Gender and release
    cannot be told, so the coefficients are a start and no more.
    """
    counts = body.shape_directions.shape[2], body.expression_directions.shape[2]
    return len(body.v_template) == _VERTICES and len(body.faces) == _TRIANGLES and min(counts) >= 10


def knows_coefficients(start: InitialPoses, body: BodyModel) -> bool:
    """Whether the shape and the expression that came with poses mean to this body what they meant there."""
    if start.model == "smplx":
        return is_official_smplx(body)
    return start.model == body.digest
