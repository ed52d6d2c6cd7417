"""The driving motion: the fitted person turns once about the vertical before a camera that stands still."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import JOINT_NAMES, Poses, posed_vertices, rest_joints
from pipeline.clip.camera import Camera, facing_camera
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.clip.frames import spread_end_to_end
from pipeline.errors import UserError
from stages.auxiliary.settings import AuxiliarySettings

ID_OFFSET = 100_000
"""Generated frames are numbered from here, as in the authors' release, so that no clip's frame has their
numbers."""

_FIELD = math.radians(25)  # of view along the picture's height: a long lens, as portraits are taken
_FILL = 0.9  # of the picture, by the body at its widest
_CHUNK = 32  # frames that are posed at once, which bounds the memory


def read_numbered_clip(ingest: Path, fit: Path, body_file: Path) -> FittedClip:
    """The clip, whose frame numbers leave those of generated frames free.

    Raises:
        UserError: as of ``read_fitted_clip``, or frame numbers reach those of generated frames.
    """
    clip = read_fitted_clip(ingest, fit, body_file)
    if clip.poses.frames[-1] >= ID_OFFSET:
        raise UserError(f"{ingest}: frame {clip.poses.frames[-1]} has the number of a generated frame")
    return clip


@dataclasses.dataclass(frozen=True)
class TurntableMotion:
    """The driving motion. Its frames are numbered from 0.

    Attributes:
        poses: T frames.
        camera: stands still.
        azimuth: [T] float64, how far the body has turned to its left, radians.
    """

    poses: Poses
    camera: Camera
    azimuth: np.ndarray


def make_turntable_motion(clip: FittedClip, settings: AuxiliarySettings) -> TurntableMotion:
    """A full turn of the fitted person, upright, at a distance at which nothing is cut off."""
    count = settings.frames
    azimuth = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    rotation = _postures(clip, settings)
    tilt = rotation[:, 0]
    turning = torch.zeros(count, 3)
    turning[:, 1] = azimuth.float()
    rotation[:, 0] = roma.rotvec_composition([turning, tilt])
    expression = clip.poses.expression.median(0).values.expand(count, -1).clone()
    pelvis = rest_joints(clip.body, clip.identity)[0]
    poses = Poses(tuple(range(count)), rotation, expression, -pelvis.expand(count, 3).clone())
    camera, place = _placed(clip, poses, settings)
    poses = dataclasses.replace(poses, transl=poses.transl + place)
    return TurntableMotion(poses, camera, azimuth.numpy())


def _postures(clip: FittedClip, settings: AuxiliarySettings) -> Tensor:
    """The rotations of every joint before the turn, [T, 55, 3]; the root's own faces the camera."""
    count = settings.frames
    if settings.motion == "clip":
        trained = sorted(clip.split.train)
        frames = [trained[k * len(trained) // count] for k in range(count)]
        rotation = clip.poses.select(frames).rotation
        rotation[:, 0] = _without_heading(rotation[:, 0])
        return rotation
    rotation = torch.zeros(count, len(JOINT_NAMES), 3)
    rotation[:, JOINT_NAMES.index("left_shoulder"), 2] = -settings.arm_angle
    rotation[:, JOINT_NAMES.index("right_shoulder"), 2] = settings.arm_angle
    return rotation


def _without_heading(orient: Tensor) -> Tensor:
    """Root rotations without their turn about the vertical: [T, 3] -> [T, 3] rotation vectors."""
    forward = roma.rotvec_to_rotmat(orient)[:, :, 2]
    heading = torch.zeros_like(orient)
    heading[:, 1] = -torch.atan2(forward[:, 0], forward[:, 2])
    return roma.rotvec_composition([heading, orient])


def _placed(clip: FittedClip, poses: Poses, settings: AuxiliarySettings) -> tuple[Camera, Tensor]:
    """The camera, and where the pelvis has to be before it: [3]."""
    width, height = settings.width, settings.height
    focal = height / 2 / math.tan(_FIELD / 2)
    some = [poses.pose(frame) for frame in spread_end_to_end(poses.frames, 24)]
    vertices = torch.cat([posed_vertices(clip.body, clip.identity, pose) for pose in some])
    low, high = vertices.amin(0), vertices.amax(0)
    middle = torch.stack([torch.zeros(()), (low[1] + high[1]) / 2, torch.zeros(())])
    away = (vertices - middle).abs()
    # Beside the axis by x and before it by z, a point is in view from d if x f / (d - z) is inside.
    across = (away[:, 0] * focal / (_FILL * width / 2) + vertices[:, 2]).max()
    up = (away[:, 1] * focal / (_FILL * height / 2) + vertices[:, 2]).max()
    place = torch.tensor([0.0, 0.0, -float(torch.maximum(across, up))]) - middle
    return facing_camera(width, height, focal), place
