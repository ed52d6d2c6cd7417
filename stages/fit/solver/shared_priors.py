"""Second derivatives of what the objective says of the identity alone: L_sreg, L_sface and L_init of beta."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.fit.face.target import aligned
from stages.fit.objective import FACE_LENGTH, INITIAL_BETAS, JOINT_OFFSET, SFACE, SHAPE, Face, Objective
from stages.fit.parameters import Parameters
from stages.fit.solver.slopes import Layout

_NEAR = 5e-4  # metres; an L1 loss is taken as a parabola no narrower than this


def shared_priors(objective: Objective, parameters: Parameters, layout: Layout, frames: int) -> Tensor:
    """In betas and joint offsets, of the loss summed over frames: [S, S] float64."""
    settings = objective.settings
    priors = torch.zeros(layout.shared, layout.shared, dtype=torch.float64)
    betas = priors[: layout.betas, : layout.betas]
    betas.diagonal().add_(frames * 2 * (SHAPE * settings.lambda_sreg + INITIAL_BETAS * settings.lambda_init))
    if objective.target is not None:
        shape = objective.target.model.shape
        for axis, surface in enumerate(_surface(objective.target, parameters)):
            product = shape[:, axis].mT @ surface @ shape[:, axis]
            betas.add_(frames * settings.lambda_sface * product.double())
    if layout.offsets:
        mirror = torch.kron(objective.mirror_joints, torch.diag(torch.tensor([-1.0, 1.0, 1.0])))
        unlike = (torch.eye(165) - mirror).double()
        offsets = priors[layout.betas :, layout.betas :]
        offsets += 2 * JOINT_OFFSET * frames * settings.lambda_sreg * (torch.eye(165) + unlike.mT @ unlike)
    # No direction is without curvature, whatever the priors' weights.
    priors.diagonal().add_(1e-6)
    return priors


def control_priors(objective: Objective, parameters: Parameters, frames: int) -> list[Tensor]:
    """In the face controls along each axis, of the loss summed over frames: [C, C] three times."""
    settings, face = objective.settings, objective.model.face[objective.face]
    priors = []
    for sign in (-1.0, 1.0, 1.0):
        unlike = face - sign * (objective.mirror_face @ face)
        squares = 2 * FACE_LENGTH * face.mT @ face + 1000 * unlike.mT @ unlike
        priors.append(frames * settings.lambda_sreg * squares)
    if objective.target is not None:
        spread = objective.target.model.face
        for prior, surface in zip(priors, _surface(objective.target, parameters), strict=True):
            prior += frames * settings.lambda_sface * (spread.mT @ surface @ spread)
    return priors


def _surface(face: Face, parameters: Parameters) -> list[Tensor]:
    """Of L_sface in the places of its points along each axis: [F, F] three times.

    L1 losses are reweighted least squares, and an edge's length is taken to change equally by a motion
    along any axis.
    """
    model, target = face.model, face.target
    points = model.rest + model.shape @ parameters.betas + model.face @ parameters.face_control
    away = (points - aligned(target.neutral.to(points.dtype), points)).abs().clamp_min(_NEAR)
    count, edges = len(points), target.edges
    sides = torch.zeros(len(edges), count)
    sides[torch.arange(len(edges)), edges[:, 0]] = 1
    sides[torch.arange(len(edges)), edges[:, 1]] = -1
    smooth = 2 * SFACE["laplacian"] / count * target.laplacian.mT @ target.laplacian
    smooth = smooth + SFACE["edge"] / (3 * max(len(edges), 1) * _NEAR) * sides.mT @ sides
    return [smooth + torch.diag(SFACE["vertex"] / count / away[:, axis]) for axis in range(3)]
