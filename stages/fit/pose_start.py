"""Where the optimisation starts if another program has estimated the poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel
from pipeline.pose_files.axes import into_world
from pipeline.pose_files.coefficients import knows_coefficients
from pipeline.pose_files.read import InitialPoses
from stages.fit.facing import pose_facing
from stages.fit.initialise import weak_perspective
from stages.fit.observations import Observations
from stages.fit.parameters import LandmarkModel, Parameters, parameters_of
from stages.fit.views import Views

_CHUNK = 256  # frames posed at a time


def initial_facing(start: InitialPoses, body: BodyModel, views: Views) -> np.ndarray:
    """Whether the estimated heads look at the camera, see ``facing.pose_facing``: [T]."""
    nowhere = torch.zeros(len(start.frames), 3)
    orient, _ = into_world(start.rotation[:, 0], nowhere, nowhere[0], views.rotation, views.translation)
    rotation = torch.cat([orient[:, None].to(start.rotation), start.rotation[:, 1:]], dim=1)
    return pose_facing(rotation, body.parents, views)


def initial_from_files(
    start: InitialPoses,
    body: BodyModel,
    observations: Observations,
    model: LandmarkModel,
    views: Views,
    log: Callable[[str], None] = lambda note: None,
    believe: bool = False,
) -> Parameters:
    """The start of the optimisation for T frames, from pose files.

    All rotations are the files'. The place is the files' ``trans`` where they have one and it agrees with
    this clip's cameras; it was found for another focal length, maybe, and then points reproject better
    from the place that a weak perspective gives them (``initialise.weak_perspective``).

    Args:
        start: poses of the observations' frames.
        body: the body.
        observations: what the fit aims at.
        model: the landmarks.
        views: the cameras.
        log: told in one line each what of the files was not used.
        believe: take the files' place also where the landmarks know a better one.

    Raises:
        ValueError: ``start`` is of other frames.
    """
    if start.frames != tuple(observations.frames.tolist()):
        raise ValueError("the initial poses are not of the observed frames")
    sizes = model.shape.shape[2], model.expression.shape[2], model.face.shape[1]
    nowhere = torch.zeros(len(start.frames), 3)
    shared = _coefficients(start, body, sizes, log)
    pivot = model.joints[0] + model.joint_shape[0] @ shared["betas"]
    trans = nowhere if start.transl is None else start.transl
    orient, placed = into_world(start.rotation[:, 0], trans, pivot, views.rotation, views.translation)
    rotation = torch.cat([orient[:, None].to(start.rotation), start.rotation[:, 1:]], dim=1)
    parameters = dataclasses.replace(parameters_of(rotation, nowhere, sizes), **shared)
    points = _landmarks(model, parameters)
    transl = weak_perspective(points, observations, views)
    if start.transl is not None:
        given = placed.to(transl)
        if start.pivot is not None:
            given = given + start.pivot.to(given) - pivot
        errors = [_error(points, place, observations, views) for place in (given, transl)]
        if believe or errors[0] <= errors[1]:
            transl = given
        else:
            log("the pose files' translations are not used: they do not agree with the clip's cameras")
    return dataclasses.replace(parameters, transl=transl)


def _coefficients(
    start: InitialPoses, body: BodyModel, sizes: tuple[int, int, int], log: Callable[[str], None]
) -> dict[str, Tensor]:
    """Betas [B] and expression [T, E]: the files' where they mean something to the body, else zero."""
    shared = {"betas": torch.zeros(sizes[0]), "expression": torch.zeros(len(start.frames), sizes[1])}
    found = {"betas": start.betas, "expression": start.expression}
    if knows_coefficients(start, body):
        for name, values in found.items():
            if values is not None:
                count = min(values.shape[-1], shared[name].shape[-1])
                shared[name][..., :count] = values[..., :count]
    elif any(values is not None for values in found.values()):
        whose = {"smplx": "SMPL-X's", "smpl": "SMPL's"}.get(start.model, "another's")
        log(f"shape and expression of the pose files are not used: they are {whose}, the body is not")
    return shared


def _landmarks(model: LandmarkModel, parameters: Parameters) -> Tensor:
    """The posed landmarks, [T, N, 3], some frames at a time."""
    count = len(parameters.transl)
    pieces = [parameters.rows(low, min(low + _CHUNK, count)) for low in range(0, count, _CHUNK)]
    return torch.cat([model.posed(piece, piece.matrices)[0] for piece in pieces])


def _error(points: Tensor, transl: Tensor, observations: Observations, views: Views) -> float:
    """The median distance of trusted landmarks from where they were seen, pixels; 0 if none is."""
    pixels = views.to_pixels(views.to_camera(points + transl[:, None]))
    errors = (pixels - observations.pixels).norm(dim=-1)[observations.mask]
    return float(errors.median()) if len(errors) else 0.0
