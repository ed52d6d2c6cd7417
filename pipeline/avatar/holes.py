"""Holes: where light passes a turned body, though the surface between its Gaussians is there."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.body import rasterize
from pipeline.device import moved
from pipeline.orbit_cameras import orbit, visible_extent
from pipeline.splat import Gaussians, render

CLOSED = 0.95  # alpha from which a pixel is no hole
SHRUNK = 2  # pixels by which the silhouette is made smaller
ANGLES, WIDTH, HEIGHT = 16, 240, 320  # of the pictures that are searched, pixels


def inner_silhouette(covered: np.ndarray) -> np.ndarray:
    """A silhouette, [H, W] bool, made smaller."""
    kernel = np.ones((2 * SHRUNK + 1,) * 2, np.uint8)
    inner = cv2.erode(covered.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return inner > 0


@torch.no_grad()
def around_holes(
    gaussians: Gaussians,
    faces: Tensor,  # [F, 3]
) -> Tensor:
    """The Gaussians about the holes that are seen from all around, [N] bool.

    Args:
        gaussians: posed, facing +Z at the origin; N of them.
        faces: int64, of the surface between them.
    """
    found = torch.zeros(len(gaussians), dtype=torch.bool, device=faces.device)
    for camera in moved(orbit(visible_extent(gaussians), WIDTH, HEIGHT, ANGLES), faces.device):
        raster = rasterize(camera, gaussians.means, faces)
        alpha = render(gaussians, camera).alpha.cpu().numpy()
        holes = inner_silhouette(raster.covered) & (alpha < CLOSED)
        found[faces[torch.from_numpy(np.unique(raster.face[holes])).long().to(faces.device)]] = True
    return found
