"""The motion of another subject, as it was fitted to its clip."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import roma

from pipeline.body import JOINT_NAMES, BodyModel, read_identity, read_poses, rest_joints
from pipeline.clip.camera import facing_camera
from pipeline.clip.records import Footage, read_cameras, read_footage
from pipeline.errors import UserError
from stages.animate.motions.motion import USUAL_FPS, Motion, Span, leg_length
from stages.animate.motions.seen_parts import seen_parts

_FACE_JOINTS = [JOINT_NAMES.index(name) for name in ("jaw", "left_eye", "right_eye")]


def read_fitted(name: str, folders: Mapping[str, Path], body: BodyModel, span: Span) -> Motion:
    """Reads the poses that were fitted to a clip.

    Their world is turned so that the first frame's camera stands at +Z and Y is up in its picture.

    Args:
        name: of the other subject.
        folders: of its ingest and fit, see ``source.SUBJECT_FILES``.
        body: the body that both were fitted with.
        span: which of its kept frames are wanted, counted from the first.

    Raises:
        UserError: a file is damaged or the other subject was fitted with another body.
    """
    poses = read_poses(folders["fit"] / "poses.parquet")
    identity = read_identity(folders["fit"] / "identity.safetensors", body)
    camera = read_cameras(folders["ingest"] / "cameras.parquet").get(poses.frames[0])
    if camera is None:
        raise UserError(f"{folders['ingest']}: frame {poses.frames[0]} has no camera: doit run ingest:{name}")
    own_fps = _rate(read_footage(folders["ingest"] / "footage.json"))
    clock = () if own_fps else (f"{name}'s clip has no clock: {USUAL_FPS:g} frames a second are taken",)
    rows, fps = span.rows(len(poses), own_fps or USUAL_FPS, f"subject {name}")
    seen = seen_parts(folders["ingest"], poses, rows)
    turn = facing_camera(1, 1, 1.0).rotation.mT @ camera.rotation
    rotation = poses.rotation[rows].clone()
    rotation[:, 0] = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(rotation[:, 0]))
    rotation[:, _FACE_JOINTS] *= seen.of("face") > 0
    pelvis = poses.transl[rows] + rest_joints(body, identity)[0]
    return Motion(
        name=f"subject {name}",
        fps=fps,
        numbers=tuple(np.asarray(poses.frames)[rows].tolist()),
        rotation=rotation,
        expression=poses.expression[rows] if seen.of("face") else None,
        root=pelvis @ turn.mT,
        leg=leg_length(body, identity=identity),
        told=tuple(name for name in JOINT_NAMES if name not in seen.untold()),
        faces_camera=True,
        notes=(*seen.notes(name), *clock),
    )


def _rate(footage: Footage) -> float | None:
    """Kept frames a second; None where the clip has no clock, whose seconds are places in a folder."""
    if not footage.fps > 0:
        return None
    steps = [b - a for a, b in itertools.pairwise(footage.seconds) if b > a]
    return 1 / statistics.median(steps) if steps else None
