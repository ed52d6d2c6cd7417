"""The textured mesh: the fitted body in the clip's colours, to which an avatar adds its Gaussians.

It has the same poses as the avatar and so the same errors of the fit. What the avatar has over it are hair,
clothes, and colours that follow the pose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body import BodyModel, Identity, pose_body
from pipeline.camera import Camera
from pipeline.metrics.protocol import composite
from pipeline.texture import FineSurface, View, fine_surface, gather, paint
from stages.evaluate.evaluated_clip import EvaluatedClip, Pose
from stages.evaluate.methods import MESH, OnBackground

LEVELS = 1  # of subdivision: vertices 4 to 8 mm apart


@dataclasses.dataclass(frozen=True)
class TexturedMesh:
    """The fitted body, a colour a vertex, in the avatar's poses.

    Attributes:
        clip: gives poses and cameras.
        body, identity: as they were fitted.
        surface: the subdivided body.
        colors: [N, 3] float32, 0 to 255, of the subdivided body.
        known: the share of its vertices that the frames show; the others have the nearest known colour.
        name: ``MESH``.
    """

    clip: EvaluatedClip
    body: BodyModel
    identity: Identity
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
        vertices = posed(self.body, self.identity, self.clip.pose(frame))
        image, mask, _ = paint(camera or self.clip.cameras[frame], self.surface, vertices, self.colors)
        return partial(composite, image, mask)


def textured_mesh(
    clip: EvaluatedClip,
    body: BodyModel,
    identity: Identity,
    frames: Sequence[int],
    advance: Callable[[], object] = lambda: None,
) -> TexturedMesh:
    """Gathers the colours that some training frames show of the fitted body.

    Args:
        clip: the clip.
        body, identity: as they were fitted.
        frames: which to look at.
        advance: called after each frame.
    """
    surface = fine_surface(body, LEVELS)

    def views() -> Iterator[View]:
        for frame in frames:
            vertices = posed(body, identity, clip.pose(frame))
            yield View(clip.cameras[frame], vertices, clip.frame(frame), clip.mask(frame))
            advance()

    seen = gather(surface, views(), len(frames))
    template = surface.refine(body.v_template).numpy()
    colors = nearest_known(seen.color, seen.known, template)
    return TexturedMesh(clip, body, identity, surface, colors, float(seen.known.mean()))


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


@torch.no_grad()
def posed(body: BodyModel, identity: Identity, pose: Pose) -> Tensor:
    """The fitted surface in a pose: [V, 3], metres, in the world."""
    rotation, expression, transl = (part[None] for part in pose)
    return pose_body(body, identity, rotation, expression, transl)[0][0]
