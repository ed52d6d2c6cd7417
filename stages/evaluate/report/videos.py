"""The report's videos: the avatar turned about, and in a motion that was never filmed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from pipeline.body import Pose
from pipeline.clip.camera import Camera
from pipeline.motion.novel_motion import motion_poses
from pipeline.orbit_cameras import Extent, orbit, visible_extent
from pipeline.splat import Gaussians, render
from stages.evaluate.methods import Animate
from stages.evaluate.report.pictures import on_grey


@torch.no_grad()
def turntable_pictures(gaussians: Gaussians, cameras: list[Camera]) -> Iterator[np.ndarray]:
    """The picture of each camera, [H, W, 3] uint8 RGB on grey."""
    for camera in cameras:
        yield on_grey(render(gaussians, camera))


@torch.no_grad()
def motion_pictures(
    animate: Animate, expressions: int, count: int, arm_angle: float, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    """The avatar in the motion from the front, [H, W, 3] uint8 RGB on grey.

    Args:
        animate: a pose -> Gaussians.
        expressions: the number of expression coefficients, all of which are zero.
        count: frames.
        arm_angle: radians.
        size: width and height in pixels.
    """

    def frame(rotation: Tensor) -> Gaussians:
        return animate(Pose(rotation, torch.zeros(expressions), torch.zeros(3)), None)

    poses = list(motion_poses(count, arm_angle))
    # The middle of the motion reaches highest, the quarters furthest aside.
    extents = [visible_extent(frame(poses[count * part // 4])) for part in range(4)]
    camera = orbit(_around(extents), *size, 1)[0]
    for rotation in poses:
        yield on_grey(render(frame(rotation), camera))


def _around(extents: list[Extent]) -> Extent:
    """One extent that holds others of nearly the same centre."""
    centre = torch.stack([one.centre for one in extents]).mean(0)
    shifts = [(one.centre - centre).abs() for one in extents]
    radius = [one.radius + float(shift.norm()) for one, shift in zip(extents, shifts, strict=True)]
    height = [one.height + float(shift[1]) for one, shift in zip(extents, shifts, strict=True)]
    return Extent(centre, np.concatenate(radius), np.concatenate(height))
