"""A camera for every frame of an animation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch

from pipeline.body import BodyModel, Identity, Poses, rest_joints
from pipeline.clip.camera import Camera, facing_camera
from pipeline.clip.frames import spread_end_to_end
from pipeline.orbit_cameras import extent_of, front_camera, orbit, relaxed_pose, visible_box, visible_extent
from pipeline.splat import Gaussians
from stages.animate.motions.motion import Motion
from stages.animate.motions.placement import PlacedMotion
from stages.animate.settings import AnimateSettings

_SAMPLES = 24  # frames that are looked at to place a camera

PosedFrame = Callable[[int], Gaussians]
"""Frame -> Gaussians in world coordinates."""


@dataclasses.dataclass(frozen=True)
class Animation:
    """The poses that are shown, frame by frame.

    Attributes:
        placed: a pose a frame.
        numbers: [T], the frames' numbers in the motion.
        fps: frames a second.
        still: whether all poses are the same one.
        motion: what it was read from; None for a turntable.
    """

    placed: PlacedMotion
    numbers: tuple[int, ...]
    fps: float
    still: bool = False
    motion: Motion | None = None

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def poses(self) -> Poses:
        """The poses, frames numbered from 0."""
        placed = self.placed
        return Poses(tuple(range(len(placed))), placed.rotation, placed.expression, placed.transl)


@dataclasses.dataclass(frozen=True)
class ClipStart:
    """The person's place in the first frame of the own clip.

    Attributes:
        camera: of its first frame.
        pelvis: [3], metres, where the pelvis was, in that camera's axes.
    """

    camera: Camera
    pelvis: torch.Tensor


def turntable(body: BodyModel, identity: Identity, settings: AnimateSettings) -> Animation:
    """The avatar stands still, in the T pose of the paper's supplement or with its arms lowered."""
    count = settings.turntable_frames
    placed = PlacedMotion(
        rotation=relaxed_pose(settings.arm_angle).expand(count, -1, -1),
        expression=torch.zeros(count, body.expression_directions.shape[2]),
        transl=-rest_joints(body, identity)[0].expand(count, 3),
        scale=1.0,
    )
    return Animation(placed, tuple(range(count)), settings.turntable_fps, still=True)


def clip_start(poses: Poses, cameras: dict[int, Camera], body: BodyModel, identity: Identity) -> ClipStart:
    """The camera and the person's place in the clip's first frame."""
    camera = cameras[poses.frames[0]]
    pelvis = rest_joints(body, identity)[0] + poses.transl[0]
    return ClipStart(camera, camera.rotation @ pelvis + camera.translation)


def cameras_of(
    animation: Animation,
    posed: PosedFrame,
    settings: AnimateSettings,
    origin: ClipStart,
    pelvis: torch.Tensor,
) -> list[Camera]:
    """A camera a frame.

    Args:
        posed: makes Gaussians of the animation's frames.
        origin: of the person's own clip.
        pelvis: [3], metres, where the pelvis is in the animation's first frame.
    """
    size, count = (settings.width, settings.height), len(animation)
    if settings.camera == "clip":
        return [clip_camera(origin, pelvis, *size)] * count
    if animation.still:
        return orbit(visible_extent(posed(0)), *size, count, settings.turns)
    rows = spread_end_to_end(range(count), _SAMPLES)
    boxes = np.stack([visible_box(posed(row)) for row in rows])
    if settings.camera == "orbit":
        return orbit(extent_of(boxes), *size, count, settings.turns)
    return [front_camera(boxes, *size)] * count


def clip_camera(origin: ClipStart, pelvis: torch.Tensor, width: int, height: int) -> Camera:
    """The clip's first camera before the motion, in whose axes it looks level along -Z.

    Args:
        origin: of the person's own clip.
        pelvis: [3], where the pelvis begins.
        width, height: pixels that the picture may have at most; both stay even.
    """
    filmed = origin.camera
    share = min(width / filmed.width, height / filmed.height)
    size = (max(2, 2 * round(side * share / 2)) for side in (filmed.width, filmed.height))
    turned = facing_camera(1, 1, 1.0).rotation
    camera = Camera(filmed.width, filmed.height, filmed.intrinsics, turned, origin.pelvis - turned @ pelvis)
    return camera.resized(*size)
