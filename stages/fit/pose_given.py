"""Poses that came with a dataset: where the fit starts, or what it publishes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, Poses, mean_identity, rest_joints
from pipeline.errors import UserError
from pipeline.pose_files import (
    RECORD,
    InitialPoses,
    on_frames,
    read_hand_mean,
    read_initial_poses,
    read_record,
    with_flat_hands,
)
from pipeline.pose_files.axes import into_world
from pipeline.pose_files.coefficients import is_official_smplx, knows_coefficients
from stages.fit.settings import FitSettings
from stages.fit.views import Views


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
        settings: the stage's.
        ingest: what ingest has published.
        body: the body.
        body_file: its file, for the hands.
        frames: the frame numbers, increasing.
        log: told in a line each what a user should know.

    Returns:
        Poses of the frames with hands relative to flat hands; None where there are none or
        ``fit.given=ignore``.

    Raises:
        UserError: they cannot be read, or are to be kept and are not there.
    """
    if settings.pose_init:
        return read_initial_poses(Path(settings.pose_init), frames, read_hand_mean(body_file), log)
    if settings.given == "ignore":
        return None
    path = ingest / RECORD
    if not path.is_file():
        if settings.given == "keep":
            raise UserError(
                f"{ingest} has no poses to keep: fit.given=keep is for datasets that bring fitted poses"
            )
        return None
    poses = on_frames(read_record(path), frames)
    log(f"starts from the poses that came with the footage: {int(poses.valid.sum())} of {len(frames)} frames")
    return with_flat_hands(poses, body_file, is_official_smplx(body), log)


def keep_given(start: InitialPoses, body: BodyModel, views: Views) -> tuple[Identity, Poses]:
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
    identity = _identity(start, body, remedy)
    pivot = rest_joints(body, identity)[0]
    theirs = pivot if start.pivot is None else start.pivot
    orient, transl = into_world(start.rotation[:, 0], start.transl, theirs, views.rotation, views.translation)
    rotation = torch.cat([orient[:, None].to(start.rotation), start.rotation[:, 1:]], dim=1)
    expression = torch.zeros(len(start.frames), body.expression_directions.shape[2])
    if start.expression is not None:
        expression = _resized(start.expression, expression.shape[1])
    transl = (transl + (theirs - pivot).double()).float()
    return identity, Poses(start.frames, rotation.float(), expression, transl, start.valid)


def _identity(start: InitialPoses, body: BodyModel, remedy: str) -> Identity:
    """Beta, Delta J, Delta V_face."""
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
