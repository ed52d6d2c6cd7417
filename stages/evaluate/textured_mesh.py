"""The textured mesh: the fitted body in the clip's colours, to which an avatar adds its Gaussians.

It has the same poses as the avatar and so the same errors of the fit. What the avatar has over it are hair,
clothes, and colours that follow the pose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from pipeline.clip.camera import Camera
from pipeline.clip.composite import composite_frame
from pipeline.texture import FineSurface, fine_surface, gather_colors, paint
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.methods import MESH, OnBackground

LEVELS = 1  # of subdivision: vertices 4 to 8 mm apart


@dataclasses.dataclass(frozen=True)
class TexturedMesh:
    """The fitted body, a colour a vertex, in the avatar's poses.

    Attributes:
        clip: gives the posed body and the cameras.
        surface: the subdivided body.
        colors: [N, 3] float32, 0 to 255, of the subdivided body.
        known: the share of its vertices that the frames show; the others have the nearest known colour.
        name: ``MESH``.
    """

    clip: EvaluatedClip
    surface: FineSurface
    colors: np.ndarray  # [N, 3]
    known: float
    name: str = MESH

    @property
    def frames(self) -> Collection[int]:
        """The held-out frames."""
        return self.clip.split.test

    def render(self, frame: int, camera: Camera | None = None) -> OnBackground:
        """The mesh in a frame's pose, seen by the frame's camera or by another."""
        camera = camera or self.clip.camera(frame)
        image, mask, _ = paint(camera, self.surface, self.clip.vertices(frame), self.colors)
        return partial(composite_frame, image, mask)


def textured_mesh(
    clip: EvaluatedClip, frames: Sequence[int], advance: Callable[[], object] = lambda: None
) -> TexturedMesh:
    """Gathers the colours that some training frames show of the fitted body.

    Args:
        clip: the clip.
        frames: those whose colours are taken.
        advance: called after each frame.
    """
    surface = fine_surface(clip.body, LEVELS)
    seen = gather_colors(surface, clip, frames, advance)
    template = surface.refine(clip.body.v_template).numpy()
    colors = nearest_known(seen.color, seen.known, template)
    return TexturedMesh(clip, surface, colors, float(seen.known.mean()))


def nearest_known(color: np.ndarray, known: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Colours in which what is not known has that of the nearest known place; grey where nothing is.

    Args:
        color: [N, 3].
        known: [N] bool.
        places: [N, 3].

    Returns:
        [N, 3] float32.
    """
    if not known.any():
        return np.full_like(color, 128, np.float32)
    nearest = cKDTree(places[known]).query(places)[1]
    return np.where(known[:, None], color, color[known][nearest]).astype(np.float32)
