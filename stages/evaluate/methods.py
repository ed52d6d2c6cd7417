"""The methods that are compared: each shows the person of a frame, and all of them are scored alike.

The avatar is here, in the fit's poses and in refined ones. The others are in ``baselines.py``,
``textured_mesh.py`` and ``second_mask.py``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

from pipeline.avatar import Avatar
from pipeline.avatar.bake import bake
from pipeline.body import Pose
from pipeline.clip.camera import Camera
from pipeline.clip.composite import BLACK, over
from pipeline.splat import Gaussians, Rendering, render
from stages.evaluate.evaluated_clip import EvaluatedClip

AVATAR, REFINED, MEAN, NEAREST, MESH, CEILING = METHODS = (
    "avatar", "avatar_refined", "mean_frame", "nearest_frame", "textured_mesh", "second_mask",
)  # fmt: skip
"""The methods' names: the avatar, the avatar with test poses refined, the three baselines, and the true
frame itself under a second mask."""

BASELINES = (MEAN, NEAREST, MESH)

OnBackground = Callable[[str], Tensor]
"""A picture before it is composited: background -> [H, W, 3] float32 in [0, 1]."""

Animate = Callable[[Pose, float | None], Gaussians]
"""A pose, and seconds from the clip's start or None -> Gaussians in world coordinates."""


class Method(Protocol):
    """A way to show the person of a frame.

    Attributes:
        name: one of ``METHODS``.
        frames: those that it is scored on.
    """

    @property
    def name(self) -> str: ...

    @property
    def frames(self) -> Collection[int]: ...

    def render(self, frame: int) -> OnBackground:
        """The picture of a frame, of the frame's size.

        A method that shows the same picture in several frames returns the same object, so that what was
        computed of it is kept.
        """
        ...


@dataclasses.dataclass(frozen=True)
class AvatarMethod:
    """The avatar in each frame's pose, seen by the frame's camera.

    Attributes:
        name: ``AVATAR`` or ``REFINED``.
        clip: gives poses, seconds and cameras.
        animate: a pose -> Gaussians.
        frames: those that it is scored on.
        poses: frame -> its pose, in place of the clip's.
    """

    name: str
    clip: EvaluatedClip
    animate: Animate
    frames: Collection[int]
    poses: Mapping[int, Pose] = dataclasses.field(default_factory=dict)

    def render(self, frame: int, camera: Camera | None = None) -> OnBackground:
        """The picture of a frame, seen by its camera or by another."""
        return partial(on_background, self.rendering(frame, camera))

    @torch.no_grad()
    def rendering(self, frame: int, camera: Camera | None = None) -> Rendering:
        """The same with its alpha."""
        pose = self.poses[frame] if frame in self.poses else self.clip.pose(frame)
        gaussians = self.animate(pose, self.clip.seconds.get(frame))
        return render(gaussians, camera or self.clip.camera(frame))


def baked_animation(avatar: Avatar) -> Animate:
    """The avatar to be posed often and never learnt from."""
    return bake(avatar).gaussians


def pose_gradient_animation(avatar: Avatar) -> Animate:
    """The avatar with gradients that reach the pose and nothing else.

    A baked avatar has no gradients. What the visibility gate took is not in that one, whatever the avatar
    says, and so it is not in this one.
    """
    avatar.requires_grad_(False)
    avatar.unseen = "nothing"
    return avatar.gaussians


def on_background(rendering: Rendering, background: str = BLACK) -> Tensor:
    """A rendering as it is scored: [H, W, 3] float32 in [0, 1]."""
    return over(rendering.color.float(), rendering.alpha.float(), background).clamp(0, 1)
