"""The avatar from all sides: pictures, and three numbers that need no truth.

- **holes**: the share of the posed body's silhouette, two pixels smaller, where the avatar's alpha is under
  0.95;
- **speckle**: how much colours differ from their neighbours' on guessed surface, over the same on surface
  that frames showed; above 1 the guess is noisier than what was seen;
- **a face behind**: a face is found where the back of the head is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipeline.avatar import Avatar
from pipeline.avatar.holes import CLOSED, inner_silhouette
from pipeline.avatar.sparse import SparsePair
from pipeline.body import rasterize
from pipeline.clip.camera import Camera
from pipeline.orbit_cameras import orbit, visible_extent
from pipeline.splat import Gaussians, render
from stages.evaluate.report.pictures import on_grey

ANGLES = 8
WIDTH, HEIGHT = 240, 320  # pixels
SURE = 0.5  # trust from which a Gaussian counts as seen
GUESSED = (0.95, 0.35, 0.10)  # the colour that marks what was guessed
BEHIND = 4  # of the eight angles: straight from behind; from 135 degrees the profile of a true face is seen

FaceFinder = Callable[[np.ndarray], bool]
"""True where a picture, [H, W, 3] uint8 RGB, shows a face."""


@dataclasses.dataclass(frozen=True)
class SeenSurface:
    """An avatar's surface as its pictures are judged by.

    Attributes:
        faces: [F, 3] int64, triangles between the Gaussians.
        neighbours: the mean over each one's neighbours.
        trust: [N] in [0, 1], how far frames showed each Gaussian's colour.
    """

    faces: Tensor
    neighbours: SparsePair
    trust: Tensor


@dataclasses.dataclass(frozen=True)
class Turned:
    """An avatar from all sides.

    Attributes:
        pictures: of each angle, [H, W, 3] uint8 RGB, the first from the front, then towards its left.
        marked: the same with what was guessed in one colour.
        holes: mean share of the silhouettes.
        speckle: of guessed over seen surface; None where there is too little of either.
        guessed: share of the Gaussians.
        face_behind: None where nobody looked.
    """

    pictures: Sequence[np.ndarray]
    marked: Sequence[np.ndarray]
    holes: float
    speckle: float | None
    guessed: float
    face_behind: bool | None

    @property
    def numbers(self) -> dict[str, Any]:
        """The part that ``summary.json`` holds."""
        names = ("holes", "speckle", "guessed", "face_behind")
        return {name: getattr(self, name) for name in names}


def seen_surface(avatar: Avatar) -> SeenSurface:
    """The surface of an avatar's ungated Gaussians."""
    surface = avatar.surface()
    return SeenSurface(surface.canonical.faces, surface.neighbours, surface.pick(avatar.trust)[:, 0])


@torch.no_grad()
def look_around(gaussians: Gaussians, surface: SeenSurface, finder: FaceFinder | None = None) -> Turned:
    """An avatar from eight sides.

    Args:
        gaussians: in a pose, facing +Z at the origin.
        surface: of these Gaussians.
        finder: of faces, if the back of the head is to be looked at.
    """
    share = surface.trust[:, None]
    colors = share * gaussians.colors + (1 - share) * gaussians.colors.new_tensor(GUESSED)
    marks = dataclasses.replace(gaussians, colors=colors)
    pictures, marked, holes = [], [], []
    for camera in orbit(visible_extent(gaussians), WIDTH, HEIGHT, ANGLES):
        rendering = render(gaussians, camera)
        pictures.append(on_grey(rendering))
        marked.append(on_grey(render(marks, camera)))
        holes.append(hole_share(rendering.alpha.numpy(), silhouette(camera, gaussians, surface)))
    face = None if finder is None else finder(pictures[BEHIND])
    return Turned(
        pictures=pictures,
        marked=marked,
        holes=float(np.mean(holes)),
        speckle=speckle(gaussians.colors, surface),
        guessed=float((surface.trust < SURE).float().mean()),
        face_behind=face,
    )


def silhouette(camera: Camera, gaussians: Gaussians, surface: SeenSurface) -> np.ndarray:
    """The pixels that the surface between the Gaussians covers, [H, W] bool."""
    return rasterize(camera, gaussians.means, surface.faces).covered


def hole_share(alpha: np.ndarray, covered: np.ndarray) -> float:
    """The share of a silhouette, made smaller, where alpha is under ``CLOSED``; 0 where nothing is left."""
    inner = inner_silhouette(covered)
    return float((alpha[inner] < CLOSED).mean()) if inner.any() else 0.0


def speckle(colors: Tensor, surface: SeenSurface) -> float | None:
    """The mean difference of colours from their neighbours', of guessed over seen Gaussians."""
    away = (colors - surface.neighbours @ colors).abs().mean(1)
    guessed, seen = surface.trust < SURE, surface.trust >= SURE
    if not (bool(guessed.any()) and bool(seen.any())):
        return None
    return float(away[guessed].mean() / away[seen].mean().clamp_min(1e-6))
