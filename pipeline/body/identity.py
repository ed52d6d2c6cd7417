"""A person's identity in the body model: betas, joint offsets and face offsets, and their file."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pipeline.body.body_model import BodyModel
from pipeline.errors import UserError, first_line


@dataclasses.dataclass(frozen=True)
class Identity:
    """The parameters of a person that do not change with the pose.

    Attributes:
        betas: beta, [B], unitless; B may be less than the body has.
        joint_offset: Delta J, [55, 3], metres, added to the regressed joints.
        face_offset: Delta V_face, [V, 3], metres, added to the template; zero outside the face.
    """

    betas: Tensor  # [B]
    joint_offset: Tensor  # [55, 3]
    face_offset: Tensor  # [V, 3]


def mean_identity(body: BodyModel) -> Identity:
    """The body's own template: all zeros, of the body's dtype and device."""
    template = body.v_template
    return Identity(
        template.new_zeros(body.shape_directions.shape[2]),
        template.new_zeros(len(body.parents), 3),
        torch.zeros_like(template),
    )


def rest_vertices(body: BodyModel, identity: Identity) -> Tensor:
    """The shaped vertices in T pose without expression: T + Delta V_face + B_S(beta).

    Returns:
        [V, 3], metres; differentiable in the identity.
    """
    return body.v_template + identity.face_offset + _blend(body.shape_directions, identity.betas)


def rest_joints(body: BodyModel, identity: Identity) -> Tensor:
    """The joints in T pose: J(T + B_S(beta)) + Delta J.

    Face offsets stay out of the regression: they describe soft tissue, and no bone follows them.

    Returns:
        [55, 3], metres; differentiable in the identity.
    """
    count = identity.betas.shape[-1]
    moved = torch.einsum("jv,vck->jck", body.joint_regressor, body.shape_directions[..., :count])
    return body.joint_regressor @ body.v_template + moved @ identity.betas + identity.joint_offset


def expression_offsets(body: BodyModel, expression: Tensor) -> Tensor:
    """Displacements of the vertices by an expression, B_E(psi).

    Args:
        body: the body.
        expression: psi, [..., E'], unitless; E' may be less than the body has.

    Returns:
        [..., V, 3], metres, in T pose.
    """
    return _blend(body.expression_directions, expression)


def _blend(directions: Tensor, coefficients: Tensor) -> Tensor:
    """[V, 3, K] directions and [..., k <= K] coefficients -> [..., V, 3]."""
    count = coefficients.shape[-1]
    if count > directions.shape[2]:
        raise ValueError(f"{count} coefficients, but the body has {directions.shape[2]} directions")
    flat = directions[..., :count].reshape(-1, count)
    return (coefficients @ flat.mT).unflatten(-1, directions.shape[:2])


def write_identity(path: Path, identity: Identity, body: BodyModel) -> None:
    """Write ``identity.safetensors``: float32, with the body's digest as metadata."""
    arrays = {
        field.name: getattr(identity, field.name).detach().cpu().float().contiguous()
        for field in dataclasses.fields(identity)
    }
    save_file(arrays, path, metadata={"body": body.digest})


def read_identity(path: Path, body: BodyModel) -> Identity:
    """Read what ``write_identity`` wrote.

    Raises:
        UserError: the file is damaged, or it was made with another body model.
    """
    try:
        with safe_open(path, framework="pt") as file:
            if (file.metadata() or {}).get("body") != body.digest:
                raise UserError(f"{path} was fitted with another body model: run the fit stage again")
            names = [field.name for field in dataclasses.fields(Identity)]
            arrays = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read ({first_line(error)}): run the fit stage again") from error
    mean = mean_identity(body)
    for name, array in arrays.items():
        same = name == "betas" and array.ndim == 1 and len(array) <= body.shape_directions.shape[2]
        if not (same or array.shape == getattr(mean, name).shape) or not bool(torch.isfinite(array).all()):
            raise UserError(
                f"{path}: {name} does not fit the body, or is not finite: run the fit stage again"
            )
    return Identity(**arrays)
