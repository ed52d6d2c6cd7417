"""The clip's colours on the body's surface: gathered from frames, and painted into a view.

A frame counts by the angle at which it sees the surface and by its resolution there, and not at all
where the surface is hidden, seen at a grazing angle, or within a few pixels of the mask's edge, where a
registration that is a little off would paint the wall onto the person. Over the frames the weighted
median is taken, then the mean of what lies near it: a frame that slipped is outvoted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.body import rasterize, vertex_normals
from pipeline.clip.camera import Camera, project, to_camera
from pipeline.clip.fitted_clip import FittedClip
from pipeline.texture.surface import FineSurface

SAMPLES = 2  # a pixel, in each direction
GRAZING = 0.25  # cosine of the angle between normal and view under which no colour is taken
DEPTH = 0.012  # metres behind the nearest surface at which a vertex still counts as seen
EDGE = 0.012  # of the person's height: no colour is taken nearer to the mask's edge
AGREEING = 24.0  # of 255: samples within this distance of the median are averaged
SURE = 0.02  # summed weight from which a vertex is known; a frontal view at full resolution weighs 1


@dataclasses.dataclass(frozen=True)
class VertexColors:
    """The clip's colours on the surface.

    Attributes:
        color: [N, 3] float32, RGB in 0 to 255; meaningless where ``weight`` is 0.
        weight: [N] float32, summed over the frames.
        known: [N] bool, whether the colour can be trusted.
        normal: [N, 3] float32, mean normals in the world over the frames, of all vertices.
    """

    color: np.ndarray
    weight: np.ndarray
    known: np.ndarray
    normal: np.ndarray


@torch.no_grad()
def gather_colors(
    surface: FineSurface,
    clip: FittedClip,
    frames: Sequence[int],
    advance: Callable[[], object] = lambda: None,
) -> VertexColors:
    """The colours that some frames of a clip show of all vertices.

    Args:
        surface: the fine mesh of the clip's body.
        clip: the clip.
        frames: which of its frames.
        advance: called after each frame.
    """
    count = len(frames)
    colors = np.zeros((count, len(surface), 3), np.uint8)
    weights = np.zeros((count, len(surface)), np.float32)
    normal = np.zeros((len(surface), 3), np.float32)
    for row, frame in enumerate(frames):
        vertices = clip.vertices(frame)
        pictures = clip.colors(frame), clip.mask(frame)
        colors[row], weights[row] = sample_frame(surface, clip.camera(frame), vertices, *pictures)
        normal += surface.refine(vertex_normals(vertices, surface.coarse)).numpy()
        advance()
    largest = weights.max()
    weights /= max(float(largest), 1e-12)
    color = robust_mean(colors, weights)
    weight = weights.sum(0)
    return VertexColors(color, weight, weight > SURE, normal / np.float32(max(1, count)))


def sample_frame(
    surface: FineSurface,
    camera: Camera,
    vertices: Tensor,  # [V, 3]
    image: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray,  # [H, W] uint8
) -> tuple[np.ndarray, np.ndarray]:
    """The vertices' colours in one frame, [N, 3] uint8, and how much they count, [N] float32.

    Args:
        surface: the fine mesh.
        camera: of the frame.
        vertices: the body's, metres, in the world.
        image: the frame, RGB.
        mask: the person's soft alpha.
    """
    fine = surface.refine(vertices)
    normals = surface.refine(vertex_normals(vertices, surface.coarse)).numpy()
    view = camera.centre.numpy() - fine.numpy()
    distance = np.linalg.norm(view, axis=1)
    cosine = (normals * view).sum(1) / np.maximum(np.linalg.norm(normals, axis=1) * distance, 1e-9)
    pixels = project(camera, fine).numpy().astype(np.float32)
    depth = to_camera(camera, fine)[:, 2].numpy()
    nearest = _smallest(rasterize(camera, vertices, surface.coarse).depth)
    inner = _inner(mask)
    columns, rows = np.floor(pixels).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < camera.width) & (rows < camera.height) & (depth > 0)
    columns, rows = np.where(inside, columns, 0), np.where(inside, rows, 0)
    # Where the surface runs away from the camera, one pixel spans more depth.
    slope = np.sqrt(np.maximum(1 - cosine**2, 0)) / np.maximum(cosine, 0.1)
    pixel = depth / float(camera.intrinsics[0, 0])
    hidden = depth > nearest[rows, columns] + DEPTH + slope * pixel
    good = inside & ~hidden & (cosine > GRAZING) & inner[rows, columns]
    sampled = sample(image, pixels)
    resolution = 1 / np.maximum(pixel, 1e-6) ** 2
    weight = np.where(good, ((cosine - GRAZING) / (1 - GRAZING)) ** 2 * resolution, 0)
    return sampled, weight.astype(np.float32)


def robust_mean(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Colours of K frames as one, outliers left out.

    Args:
        colors: [K, N, 3] uint8.
        weights: [K, N] float32, at least 0.

    Returns:
        [N, 3] float32: the weighted mean of the samples near the weighted median; 0 without weight.
    """
    median = np.stack([weighted_median(colors[..., c], weights) for c in range(3)], axis=-1)
    away = np.abs(colors.astype(np.float32) - median).max(-1)
    near = np.where(away <= AGREEING, weights, 0)
    empty = near.sum(0) == 0
    near = np.where(empty, weights, near)
    total = near.sum(0)
    mean = (near[..., None] * colors).sum(0) / np.maximum(total, 1e-12)[:, None]
    return mean.astype(np.float32)


def weighted_median(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The value at which half of the weight is reached, along the first axis: [K, N] twice -> [N].

    >>> weighted_median(np.array([[10], [12], [200]]), np.array([[1.0], [1.0], [1.0]]))
    array([12.], dtype=float32)
    """
    order = np.argsort(values, axis=0, kind="stable")
    ordered = np.take_along_axis(values, order, 0)
    reached = np.cumsum(np.take_along_axis(weights, order, 0), axis=0)
    place = (reached >= 0.5 * reached[-1:]).argmax(0)
    return np.take_along_axis(ordered, place[None], 0)[0].astype(np.float32)


def sample(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """A picture's values between its pixels: [H, W, 3] uint8, [N, 2] float32 -> [N, 3] uint8."""
    width = 4096  # OpenCV takes no map of 32,768 rows or more
    height = -(-len(pixels) // width)
    places = np.zeros((2, height * width), np.float32)
    places[:, : len(pixels)] = (pixels - 0.5).T
    x, y = places.reshape(2, height, width)
    found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(-1, 3)[: len(pixels)]


def _smallest(depth: np.ndarray) -> np.ndarray:
    """The nearest depth in each pixel's 3 x 3 neighbourhood's cross; infinite where there is none."""
    kernel = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    finite = np.where(np.isfinite(depth), depth, 1e6).astype(np.float32)
    # The largest of the nearest would forgive too much at a silhouette: a hand before the trunk.
    return cv2.morphologyEx(finite, cv2.MORPH_OPEN, kernel)


def _inner(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool: the person, without the band along the silhouette; the picture's border is no edge."""
    solid = (mask > 127).astype(np.uint8)
    rows = np.flatnonzero(solid.any(1))
    band = max(1, round(EDGE * (rows[-1] - rows[0] + 1))) if len(rows) else 1
    padded = cv2.copyMakeBorder(solid, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    return distance > band


def paint(
    camera: Camera,
    surface: FineSurface,
    vertices: Tensor,  # [V, 3]
    carried: np.ndarray,  # [N, 3 + K]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The textured body as a camera sees it, on black.

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
