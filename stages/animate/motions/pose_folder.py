"""A folder of SMPL-X parameters, one JSON file a frame, as a motion (see ``pipeline.pose_files``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pipeline.body import JOINT_NAMES, BodyModel
from pipeline.clip.camera import facing_camera
from pipeline.errors import UserError
from pipeline.pose_files import (
    InitialPoses,
    into_world,
    is_official_smplx,
    knows_coefficients,
    on_frames,
    read_known_poses,
    with_flat_hands,
)
from stages.animate.motions.motion import MOST_FRAMES, USUAL_FPS, Motion, Span, leg_length


def read_pose_folder(folder: Path, body: BodyModel, body_file: Path, span: Span) -> Motion:
    """Reads a folder such as ``smplx_init`` or ``smplx_optimized/smplx_params``.

    The parameters are in each frame's camera; one that stands still and looks level is assumed. Frames that
    are missing between others come from their neighbours. Nothing there says how fast it was filmed: 30
    frames a second are taken.

    Args:
        folder: holds ``<frame>.json``.
        body_file: the body's file, for the hands' mean.
        span: which frames are wanted, counted from the folder's first.

    Raises:
        UserError: no frame has a usable file, or a file is malformed.
    """
    known = read_known_poses(folder)
    first, last = known.frames[0], known.frames[-1]
    if last - first >= MOST_FRAMES:
        raise UserError(
            f"{folder}: its frames are numbered {first} to {last}: take out what is not of the clip"
        )
    rows, fps = span.rows(last - first + 1, USUAL_FPS, folder.name)
    notes: list[str] = [f"{folder.name} has no clock: {USUAL_FPS:g} frames a second are taken"]
    poses = on_frames(known, range(first, last + 1))
    filled = len(poses.frames) - len(known.frames)
    if filled:
        notes.append(f"{filled} of {len(poses.frames)} frames have no usable file: interpolated")
    poses = with_flat_hands(poses, body_file, is_official_smplx(body), notes.append)
    if poses.transl is None:
        notes.append(f"{folder.name} has no trans: the body stays in its place")
    expression = poses.expression if knows_coefficients(poses, body) else None
    orient, root = _before_camera(poses, rows)
    return Motion(
        name=folder.name,
        fps=fps,
        numbers=tuple((first + rows).tolist()),
        rotation=torch.cat([orient[:, None], poses.rotation[rows][:, 1:].float()], 1),
        expression=None if expression is None else expression[rows].float(),
        root=root,
        leg=leg_length(body, betas=poses.betas if is_official_smplx(body) else None),
        told=JOINT_NAMES,
        faces_camera=True,
        notes=tuple(notes),
    )


def _before_camera(poses: InitialPoses, rows: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """The root's rotation and place in a Y-up world whose +Z is where the camera is, [T, 3] each."""
    camera, nowhere = facing_camera(1, 1, 1.0), torch.zeros(3)
    place = torch.zeros(len(rows), 3) if poses.transl is None else poses.transl[rows]
    pivot = nowhere if poses.pivot is None else poses.pivot
    orient, root = into_world(
        poses.rotation[rows][:, 0], place, pivot,
        camera.rotation.expand(len(rows), 3, 3), camera.translation.expand(len(rows), 3),
    )  # fmt: skip
    return orient.float(), root.float()
