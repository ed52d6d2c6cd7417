"""Cropping a full-body picture to the clip's framing (supplement B), with a map of what is new in it."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.body import rasterize
from pipeline.body.rasterize import Raster
from pipeline.clip.boxes import Box
from pipeline.clip.camera import Camera, project, to_camera
from pipeline.clip.fitted_clip import FittedClip
from pipeline.texture import FineSurface

SHOWN = 0.5  # share of the training frames that must have a vertex within their borders
LOOKED_AT = 24  # training frames that are asked
MARGIN = 0.04  # of the box's longer side, around what the clip frames
SMALLEST = 16  # pixels of a side; SSIM's window needs 11
DOUBT = 0.03  # of the body's height: beside it hair and clothes may be, or not


@dataclasses.dataclass(frozen=True)
class Framing:
    """The part of the body that the clip frames, and its size there.

    Attributes:
        shown: [V] float32, 1 for vertices that lie within the picture's borders in half of the frames or
            more, hidden or not.
        density: pixels in a metre of the person in the clip.
    """

    shown: Tensor
    density: float


@dataclasses.dataclass(frozen=True)
class Cropped:
    """A generated frame as training reads it.

    Attributes:
        image: [H, W, 3] uint8.
        mask: [H, W] uint8.
        trust: [H, W] uint8, 255 where the picture shows what the clip does not.
        camera: of the crop.
        news: the share of the person's pixels that are trusted.
    """

    image: np.ndarray
    mask: np.ndarray
    trust: np.ndarray
    camera: Camera
    news: float


def find_framing(clip: FittedClip) -> Framing:
    """Look at some training frames of the clip."""
    frames = clip.spread(LOOKED_AT)
    shown, densities = torch.zeros(len(clip.body.v_template)), []
    for frame in frames:
        camera, vertices = clip.camera(frame), clip.vertices(frame)
        pixels, depth = project(camera, vertices), to_camera(camera, vertices)[:, 2]
        inside = (pixels >= 0).all(1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        inside &= depth > 0
        shown += inside.float()
        if bool(inside.any()):
            densities.append(float(camera.intrinsics[0, 0] / depth[inside].median()))
    share = shown / len(frames)
    return Framing((share >= SHOWN).float(), float(np.median(densities)) if densities else 0.0)


def crop(
    image: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray,  # [H, W] uint8
    camera: Camera,
    vertices: Tensor,  # [V, 3]
    surface: FineSurface,
    carried: Tensor,  # [N, 2]
    framing: Framing,
) -> Cropped | None:
    """Cut a full-body picture to what the clip frames, at no more than the clip's resolution.

    Args:
        image, mask: the picture and its person.
        vertices: the registered body's.
        carried: of its vertices: 1 where the clip shows nothing, and 1 where the clip frames it.

    Returns:
        None where the picture shows nothing of what the clip frames.
    """
    box = _box(camera, vertices[framing.shown > 0.5])
    if box is None:
        return None
    view = camera.cropped(box.left, box.top, box.width, box.height)
    fine = surface.refine(vertices)
    raster = rasterize(view, fine, surface.faces)
    marks = raster.interpolate(surface.faces.numpy(), carried.numpy())
    cut = mask[box.slices].copy()
    # What the clip never frames, a hand beside the hip of an upper body, is not the person's here; but nor
    # is it empty: Gaussians at the border would learn the background's random colours, which are grey.
    beyond = _outside(raster, marks[..., 1])
    cut[beyond] = 0
    trust = _trust(raster, marks[..., 0], cut)
    trust[beyond] = 0
    person = cut > 127
    news = float((trust[person] > 127).mean()) if person.any() else 0.0
    scale = min(1.0, framing.density * float(to_camera(view, fine)[:, 2].median() / view.intrinsics[0, 0]))
    size = (max(SMALLEST, round(view.width * scale)), max(SMALLEST, round(view.height * scale)))
    parts = [image[box.slices], cut, trust]
    if size != (view.width, view.height):
        parts = [cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts]
    image, cut, trust = (np.ascontiguousarray(part) for part in parts)
    return Cropped(image, cut, trust, view.resized(*size), news)


def pixel_map(source: Camera, target: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Scale and shift, [2] each, from the pixels of a camera to those of one with other intrinsics."""
    scale = (target.intrinsics.diagonal()[:2] / source.intrinsics.diagonal()[:2]).numpy()
    return scale, target.intrinsics[:2, 2].numpy() - scale * source.intrinsics[:2, 2].numpy()


def _box(camera: Camera, points: Tensor) -> Box | None:
    """The box of what the points cover in the picture, with a margin; None where that is too little."""
    if not len(points):
        return None
    pixels = project(camera, points)
    low, high = pixels.amin(0), pixels.amax(0)
    margin = MARGIN * float((high - low).max())
    left, top = (int(value - margin) for value in low.tolist())
    right, bottom = (int(value + margin) + 1 for value in high.tolist())
    box = Box(left, top, right, bottom).clipped(camera.width, camera.height)
    return box if min(box.width, box.height) >= SMALLEST else None


def _outside(raster: Raster, shown: np.ndarray) -> np.ndarray:
    """[H, W] bool: nearer to a part of the body that the clip never frames than to one that it does."""
    if not raster.covered.any():
        return np.zeros(raster.covered.shape, bool)
    return _nearest(raster.covered, np.where(raster.covered, shown, 0)) < 0.5


def _trust(raster: Raster, unseen: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """255 where there is news: on unseen surface, and where there is nobody at all.

    Close beside the body the picture is not asked: the clip knows better how far hair and clothes reach,
    and the body has none.
    """
    body = raster.covered
    if not body.any():
        return np.zeros(body.shape, np.uint8)
    nearest = _nearest(body, np.where(body, unseen, 0))
    away = cv2.distanceTransform((~body).astype(np.uint8), cv2.DIST_L2, 5)
    rows = np.flatnonzero(body.any(1))
    band = DOUBT * (rows[-1] - rows[0] + 1)
    on_person = body | (mask > 127)
    trusted = np.where(on_person, nearest, away > band)
    return (255 * np.clip(trusted, 0, 1)).astype(np.uint8)


def _nearest(body: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The values of each pixel's nearest body pixel: [H, W]."""
    _, labels = cv2.distanceTransformWithLabels(
        (~body).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(labels.max()) + 1, np.float32)
    table[labels[body]] = values[body]
    return table[labels]
