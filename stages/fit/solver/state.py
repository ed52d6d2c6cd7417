"""The unknowns as the second-order solver moves them: rotations as matrices, steps in their tangent space."""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor

from stages.fit.parameters import ROTATIONS, Parameters

_MOST = 0.6  # radians a joint turns in one step: beyond, the linearisation says nothing


@dataclasses.dataclass(frozen=True)
class Step:
    """A change of everything, or a gradient with respect to one.

    Attributes:
        rotation: [T, 55, 3]; a joint's matrix R becomes R exp(rotation), so axes are the joint's own.
        expression: [T, E].
        transl: [T, 3].
        betas: [B].
        joint_offset: [55, 3].
        face_control: [C, 3].
    """

    rotation: Tensor
    expression: Tensor
    transl: Tensor
    betas: Tensor
    joint_offset: Tensor
    face_control: Tensor


def gradient_step(parameters: Parameters, gradient: Parameters) -> Step:
    """The gradient with respect to a step from the one with respect to the parameters.

    The columns of R exp(d) move by R (d x e_c), so the gradient in d is the sum over the two columns
    of e_c x R^T g_c.

    Args:
        parameters: with orthonormal rotations.
        gradient: of a loss, of the same shapes.
    """
    six = torch.cat([getattr(gradient, name) for name in ROTATIONS], dim=1).unflatten(-1, (3, 2))
    local = parameters.matrices.mT @ six
    zero = torch.zeros_like(local[..., 0, 0])
    first = torch.stack([zero, -local[..., 2, 0], local[..., 1, 0]], dim=-1)
    second = torch.stack([local[..., 2, 1], zero, -local[..., 0, 1]], dim=-1)
    shared = (gradient.betas, gradient.joint_offset, gradient.face_control)
    return Step(first + second, gradient.expression, gradient.transl, *shared)


def moved(parameters: Parameters, step: Step, share: Tensor) -> Parameters:
    """Parameters after a share of a step in each frame, and the mean share of what frames have in common.

    Args:
        parameters: of T frames.
        step: where to; no joint turns by more than 0.6 radians in a whole one.
        share: [T], how much of it, at least 0.
    """
    length = step.rotation.norm(dim=-1, keepdim=True)
    turn = step.rotation * (_MOST / length.clamp_min(_MOST)) * share[:, None, None]
    common = share.mean()
    turned = parameters.with_matrices(parameters.matrices @ roma.rotvec_to_rotmat(turn))
    return dataclasses.replace(
        turned,
        expression=parameters.expression + share[:, None] * step.expression,
        transl=parameters.transl + share[:, None] * step.transl,
        betas=parameters.betas + common * step.betas,
        joint_offset=parameters.joint_offset + common * step.joint_offset,
        face_control=parameters.face_control + common * step.face_control,
    )


def between(parameters: Parameters, known: Tensor, times: Tensor) -> Parameters:
    """Parameters of every frame from those of some: straight lines, and geodesics for rotations.

    Args:
        parameters: of K frames.
        known: [K], increasing: which frames they are.
        times: [T], increasing, in frames.
    """
    after = torch.searchsorted(known, torch.arange(len(times))).clamp(max=len(known) - 1)
    before = (after - 1).clamp_min(0)
    start, end = times[known][before], times[known][after]
    share = ((times - start) / (end - start).clamp_min(1e-6)).clamp(0, 1)[:, None]
    matrices = parameters.matrices
    change = roma.rotmat_to_rotvec(matrices[before].mT @ matrices[after])
    turned = matrices[before] @ roma.rotvec_to_rotmat(share[..., None] * change)
    mixed = {
        name: torch.lerp(getattr(parameters, name)[before], getattr(parameters, name)[after], share)
        for name in ("expression", "transl")
    }
    return dataclasses.replace(parameters, **mixed).with_matrices(turned)
