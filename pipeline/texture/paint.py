"""The textured body as a camera sees it."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from pipeline.body import rasterize
from pipeline.clip.camera import Camera
from pipeline.texture.surface import FineSurface

SAMPLES = 2  # a pixel, in each direction


def paint(
    camera: Camera,
    surface: FineSurface,
    vertices: Tensor,  # [V, 3]
    carried: np.ndarray,  # [N, 3 + K]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture on black.

    Args:
        camera: the view.
        surface: the fine mesh.
        vertices: the body's, posed, metres, in the world.
        carried: the fine vertices' colours, in 0 to 255, and whatever else they carry.

    Returns:
        image [H, W, 3] uint8, not premultiplied; mask [H, W] uint8; and what else is carried,
        [H, W, K] float32, averaged over the part of the pixel that the body covers.
    """
    size = (camera.width, camera.height)
    fine = camera.resized(size[0] * SAMPLES, size[1] * SAMPLES)
    raster = rasterize(fine, surface.refine(vertices), surface.faces)
    samples = raster.interpolate(surface.faces.numpy(), carried)
    samples = np.concatenate([samples, raster.covered[..., None].astype(np.float32)], axis=-1)
    pixels = _shrunk(samples, size)
    alpha = pixels[..., -1:]
    over = pixels[..., :-1] / np.maximum(alpha, 1e-6)
    image = np.clip(np.round(over[..., :3]), 0, 255).astype(np.uint8)
    return image, np.round(alpha[..., 0] * 255).astype(np.uint8), over[..., 3:]


def _shrunk(samples: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Means of ``SAMPLES`` squared samples: [H S, W S, C] -> [H, W, C]."""
    width, height = size
    return samples.reshape(height, SAMPLES, width, SAMPLES, -1).mean((1, 3))
