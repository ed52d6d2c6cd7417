"""Initial poses of another program: the fit starts from them, or publishes them as they are.

They come with a dataset, or from the files of ``fit.pose_init``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, Poses, mean_identity, rest_joints
from pipeline.clip.records import read_footage
from pipeline.errors import UserError
from pipeline.pose_files import (
    INITIAL_POSES,
    InitialPoses,
    into_world,
    is_official_smplx,
    knows_coefficients,
    on_frames,
    read_hand_mean,
    read_initial_poses,
    read_smplx_json,
    with_flat_hands,
)
from stages.fit.camera_batch import CameraBatch
from stages.fit.face_direction import pose_facing
from stages.fit.initialise import weak_perspective
from stages.fit.observations import Observations
from stages.fit.parameters import LandmarkModel, Parameters, parameters_of
from stages.fit.settings import FitSettings

_CHUNK = 256  # frames posed at a time


def given_poses(
    settings: FitSettings,
    ingest: Path,
    body: BodyModel,
    body_file: Path,
    frames: Sequence[int],
    log: Callable[[str], None],
) -> InitialPoses | None:
    """The poses to start from: those of ``fit.pose_init``, else those that ingest has published.

    Args:
        ingest: what ingest has published.
        body_file: the body's file, for the hands.
        frames: the frame numbers, increasing.
        log: told in a line each what a user should know.

    Returns:
        Poses of the frames with hands relative to flat hands; None where there are none or
        ``fit.given=ignore``.

    Raises:
        UserError: they cannot be read, or are to be kept and are not there.
    """
    if settings.pose_init:
        clip, folder = read_footage(ingest / "footage.json").all_frames, Path(settings.pose_init)
        hands = read_hand_mean(body_file)
        return read_smplx_json(folder, frames, hands, log, clip, settings.first_number)
    if settings.given == "ignore":
        return None
    path = ingest / INITIAL_POSES
    if not path.is_file():
        if settings.given == "keep":
            raise UserError(
                f"{ingest} has no poses to keep: fit.given=keep is for datasets that bring fitted poses"
            )
        return None
    poses = on_frames(read_initial_poses(path), frames)
    log(f"starts from the poses that came with the footage: {int(poses.valid.sum())} of {len(frames)} frames")
    return with_flat_hands(poses, body_file, is_official_smplx(body), log)


def keep_given(start: InitialPoses, body: BodyModel, views: CameraBatch) -> tuple[Identity, Poses]:
    """Identity and poses as another program has fitted them (ExAvatar's ``smplx_optimized``).

    Their joint offsets add to joints of a template with its face offsets, and their root joint has none
    (``pose_files.export``): so Delta J = theirs + J(Delta V_face), except the root, which is theirs as it is.

    Args:
        start: with hands relative to flat hands and a place in every frame.
        body: the body that the coefficients belong to.
        views: the cameras of the frames.

    Raises:
        UserError: they lack a place, or their coefficients belong to another body.
    """
    remedy = "leave out fit.given=keep to fit from these poses"
    if start.transl is None:
        raise UserError(f"the poses that came with the footage have no place in space: {remedy}")
    if start.betas is not None and not knows_coefficients(start, body):
        raise UserError(
            "the poses that came with the footage were fitted with another body: give it, "
            f"body=SMPLX_NEUTRAL.npz, or {remedy}"
        )
    identity = given_identity(start, body, remedy)
    pivot = rest_joints(body, identity)[0]
    theirs = pivot if start.pivot is None else start.pivot
    rotation, transl = _in_world(start, start.transl, theirs, views)
    expression = torch.zeros(len(start.frames), body.expression_directions.shape[2])
    if start.expression is not None:
        expression = _resized(start.expression, expression.shape[1])
    transl = (transl + (theirs - pivot).double()).float()
    return identity, Poses(start.frames, rotation.float(), expression, transl, start.valid)


def given_identity(start: InitialPoses, body: BodyModel, remedy: str) -> Identity:
    """The identity of fitted poses: beta, Delta J and Delta V_face; the mean's where they have none.

    Args:
        body: the body that the coefficients belong to.
        remedy: ends an error's message.

    Raises:
        UserError: the face offsets are another mesh's.
    """
    identity = mean_identity(body)
    if start.betas is not None:
        betas = _resized(start.betas, body.shape_directions.shape[2])
        identity = dataclasses.replace(identity, betas=betas)
    if start.face_offset is not None:
        if start.face_offset.shape != body.v_template.shape:
            counts = len(start.face_offset), len(body.v_template)
            raise UserError(f"the fitted face has {counts[0]} vertices, the body {counts[1]}: {remedy}")
        identity = dataclasses.replace(identity, face_offset=start.face_offset)
    if start.joint_offset is not None:
        followed = body.joint_regressor @ identity.face_offset
        offset = start.joint_offset + followed
        offset[0] = followed[0]
        identity = dataclasses.replace(identity, joint_offset=offset)
    return identity


def _resized(values: Tensor, length: int) -> Tensor:
    """[..., K] as ``length`` numbers: zeros are appended, or the last ones cut off."""
    return torch.nn.functional.pad(values, (0, length - values.shape[-1]))


def initial_facing(start: InitialPoses, body: BodyModel, views: CameraBatch) -> np.ndarray:
    """The cosine at which the estimated heads look at the camera, see ``face_direction.pose_facing``: [T]."""
    nowhere = torch.zeros(len(start.frames), 3)
    rotation, _ = _in_world(start, nowhere, nowhere[0], views)
    return pose_facing(rotation, body.parents, views)


def initial_from_files(
    start: InitialPoses,
    body: BodyModel,
    observations: Observations,
    model: LandmarkModel,
    views: CameraBatch,
    log: Callable[[str], None] = lambda note: None,
    believe: bool = False,
) -> Parameters:
    """The start of the optimisation for T frames, from pose files.

    All rotations are the files'. The place is the files' ``trans`` where they have one and it agrees with
    this clip's cameras; it was found for another focal length, maybe, and then points reproject better
    from the place that a weak perspective gives them (``initialise.weak_perspective``).

    Args:
        start: poses of the observations' frames.
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
    rotation, placed = _in_world(start, trans, pivot, views)
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


def _error(points: Tensor, transl: Tensor, observations: Observations, views: CameraBatch) -> float:
    """The median distance of trusted landmarks from where they were seen, pixels; 0 if none is."""
    pixels = views.to_pixels(views.to_camera(points + transl[:, None]))
    errors = (pixels - observations.pixels).norm(dim=-1)[observations.mask]
    return float(errors.median()) if len(errors) else 0.0


def _in_world(
    start: InitialPoses, transl: Tensor, pivot: Tensor, views: CameraBatch
) -> tuple[Tensor, Tensor]:
    """Rotation vectors [T, 55, 3] and places [T, 3] in the world, of poses in their cameras' axes.

    Args:
        transl: [T, 3], metres, their places.
        pivot: [3], metres, the point that the root turns about.
    """
    orient, placed = into_world(start.rotation[:, 0], transl, pivot, views.rotation, views.translation)
    return torch.cat([orient[:, None].to(start.rotation), start.rotation[:, 1:]], dim=1), placed
