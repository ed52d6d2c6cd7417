"""The textured mesh: the fitted body in the clip's colours, what any avatar adds its Gaussians to.

It has the same poses as the avatar and so the same errors of the fit. What the avatar has over it are hair,
clothes, and colours that follow the pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body import BodyModel, Identity, pose_body
from pipeline.camera import Camera
from pipeline.composite import composite_frame
from pipeline.texture import FineSurface, View, fine_surface, gather, paint
from stages.evaluate.evidence import Evidence, Pose

LEVELS = 1  # of subdivision: vertices 4 to 8 mm apart


class TexturedMesh:
    """The fitted body, a colour a vertex.

    Attributes:
        colors: [N, 3] float32, 0 to 255, of the subdivided body.
        known: the share of its vertices that the frames show; the others have the nearest known colour.
    """

    def __init__(
        self, body: BodyModel, identity: Identity, surface: FineSurface, colors: np.ndarray, known: float
    ):
        self._body, self._identity, self._surface = body, identity, surface
        self.colors, self.known = colors, known

    def on(self, pose: Pose, camera: Camera) -> Callable[[str], Tensor]:
        """A background -> the mesh in a pose on it, [H, W, 3] float in [0, 1]."""
        vertices = posed(self._body, self._identity, pose)
        image, mask, _ = paint(camera, self._surface, vertices, self.colors)
        return lambda background: composite_frame(image, mask, background)


def textured_mesh(
    evidence: Evidence,
    body: BodyModel,
    identity: Identity,
    frames: Sequence[int],
    advance: Callable[[], object] = lambda: None,
) -> TexturedMesh:
    """Gathers the colours that some training frames show of the fitted body.

    Args:
        evidence: the clip.
        body, identity: as they were fitted.
        frames: which to look at.
        advance: called after each frame.
    """
    surface = fine_surface(body, LEVELS)

    def views() -> Iterator[View]:
        for frame in frames:
            vertices = posed(body, identity, evidence.pose(frame))
            yield View(evidence.cameras[frame], vertices, evidence.frame(frame), evidence.mask(frame))
            advance()

    seen = gather(surface, views(), len(frames))
    template = surface.refine(body.v_template).numpy()
    return TexturedMesh(
        body, identity, surface, nearest_known(seen.color, seen.known, template), seen.known.mean()
    )


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
