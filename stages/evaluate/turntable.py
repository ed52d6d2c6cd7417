"""A full turn of the canonical avatar in a relaxed pose."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from pipeline.camera import Camera
from pipeline.splat import Gaussians, render
from pipeline.turntable import Extent, orbit, relaxed_pose, visible_extent
from stages.evaluate.rendering import on_grey

__all__ = ["Extent", "orbit", "relaxed_pose", "turn_pictures", "visible_extent"]


@torch.no_grad()
def turn_pictures(gaussians: Gaussians, cameras: list[Camera]) -> Iterator[np.ndarray]:
    """What each camera sees on grey, [H, W, 3] uint8 RGB."""
    for camera in cameras:
        yield on_grey(render(gaussians, camera))
