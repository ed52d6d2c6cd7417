"""From a pose to a picture. What makes Gaussians of a pose is passed in."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from pipeline.avatar import Avatar
from pipeline.avatar.bake import bake
from pipeline.camera import Camera
from pipeline.composite import BLACK, over, to_bytes
from pipeline.splat import Gaussians, Rendering, render
from stages.evaluate.evidence import Evidence, Pose

GREY = 0.82

Animate = Callable[[Tensor, Tensor, Tensor, float | None], Gaussians]
"""rotation [55, 3], expression [E], transl [3], time -> Gaussians in world coordinates.

The real one is that of a baked avatar, see ``animator``.
"""


def animator(avatar: Avatar) -> Animate:
    """The avatar as this stage needs it: posed often, and never learnt from. So it is baked once."""
    return bake(avatar).gaussians


def follower(avatar: Avatar) -> Animate:
    """The avatar as refinement needs it: gradients reach the pose and nothing else.

    A baked avatar has no gradients. What the visibility gate took is not in that one, whatever the avatar
    says, and so it is not in this one.
    """
    avatar.requires_grad_(False)
    avatar.unseen = "nothing"
    return avatar.gaussians


@torch.no_grad()
def render_frame(animate: Animate, evidence: Evidence, index: int, pose: Pose | None = None) -> Rendering:
    """The avatar in a frame's pose, or another, as its camera sees it, of the stored frame's size."""
    gaussians = animate(*(pose or evidence.pose(index)), evidence.seconds(index))
    return render(gaussians, evidence.cameras[index])


def scored_picture(rendering: Rendering, background: str = BLACK) -> Tensor:
    """The picture that is scored: [H, W, 3] float32 in [0, 1]."""
    return over(rendering.color.float(), rendering.alpha.float(), background).clamp(0, 1)


def on_grey(rendering: Rendering) -> np.ndarray:
    """The picture for people: dark hair and a white shirt both stand out; [H, W, 3] uint8 RGB."""
    return to_bytes(over(rendering.color, rendering.alpha, GREY))


@torch.no_grad()
def turn_pictures(gaussians: Gaussians, cameras: list[Camera]) -> Iterator[np.ndarray]:
    """What each camera sees on grey, [H, W, 3] uint8 RGB."""
    for camera in cameras:
        yield on_grey(render(gaussians, camera))
