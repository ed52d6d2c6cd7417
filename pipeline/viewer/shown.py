"""The content of a page: an avatar, the motions that it can play, and the expressions that have sliders."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from pipeline.avatar import Avatar
from pipeline.avatar.linear_avatar import LinearAvatar, linear_avatar
from pipeline.body import Poses
from pipeline.body.expressions import read_expressions
from pipeline.clip.camera import Camera
from pipeline.motion.novel_motion import motion_poses
from pipeline.orbit_cameras import relaxed_pose
from pipeline.viewer.packed import ViewedMotion, pack

ARM_ANGLE = 1.0  # radians below the T pose, where nothing else is said
NOVEL_FRAMES, NOVEL_FPS = 96, 30.0
MOST_FRAMES = 600  # of a motion in a page: 0.4 KB each


def novel_motion(
    arm_angle: float = ARM_ANGLE, frames: int = NOVEL_FRAMES, fps: float = NOVEL_FPS
) -> ViewedMotion:
    """The motion that nobody filmed; the body stands at the origin."""
    rotation = torch.stack(list(motion_poses(frames, arm_angle))).numpy()
    nothing = np.zeros((frames, 0), np.float32)
    return ViewedMotion("arms up, head turned", fps, rotation, nothing, np.zeros((frames, 3), np.float32))


def posed_motion(name: str, fps: float, poses: Poses) -> ViewedMotion:
    """A motion of so many poses, the first ``MOST_FRAMES`` of them."""
    some = slice(0, MOST_FRAMES)
    rotation, expression = poses.rotation[some].numpy(), poses.expression[some].numpy()
    return ViewedMotion(name, fps, rotation, expression, poses.transl[some].numpy())


def filmed_motion(
    poses: Poses, cameras: Mapping[int, Camera], fps: float, pictures: bool = False
) -> ViewedMotion:
    """What the person did in the clip, where the camera saw it.

    Args:
        poses: of the clip's frames.
        cameras: of these frames at least.
        fps: of the kept frames; 0 where the source has no clock.
        pictures: whether the filmed frames can be shown beside it.
    """
    motion = posed_motion("as filmed", fps or NOVEL_FPS, poses)
    frames = poses.frames[: len(motion)]
    if not all(frame in cameras for frame in frames):
        return motion
    numbers = frames if pictures else ()
    return dataclasses.replace(motion, cameras=[cameras[frame] for frame in frames], numbers=numbers)


def packed_avatar(
    avatar: Avatar | LinearAvatar,
    poses: Poses | None,
    motions: Sequence[ViewedMotion],
    body_file: Path,
    arm_angle: float = ARM_ANGLE,
) -> bytes:
    """An avatar and motions as the page reads them.

    Args:
        avatar: what is shown.
        poses: of its clip, to which the bases of a triplane are fitted; None if nothing is known of them.
        motions: the first is the one that the page begins with.
        body_file: that it was made on, which may name its expressions.
        arm_angle: of the pose in which it stands still.

    Raises:
        UserError: the gate left none of its Gaussians.
    """
    if isinstance(avatar, Avatar):
        known = [] if poses is None else [poses.pose(frame) for frame in poses.frames]
        avatar = linear_avatar(avatar, known)
    expressions = expression_sliders(body_file, avatar.expressions.shape[2])
    return pack(avatar, motions, expressions, relaxed_pose(arm_angle).numpy())


def expression_sliders(body_file: Path, count: int) -> dict[str, tuple[float, ...]]:
    """Name -> coefficients of its full range, [count]; left and right apart where the body has both.

    A body whose file names nothing gets its first ten coefficients, by number.

    Raises:
        UserError: the file cannot be read.
    """
    known = read_expressions(body_file, count)
    if not known.named:
        return {f"expression {row + 1}": tuple(2.0 * np.eye(count)[row]) for row in range(min(count, 10))}
    return dict(zip(known.names, map(tuple, known.coefficients.tolist()), strict=True))
