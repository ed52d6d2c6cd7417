"""The ``texture`` generator: the clip's own colours, completed, on the body as it turns; no network.

What no frame shows is completed as a finished avatar's unseen side is (``pipeline/texture/completion.py``).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.body import posed_vertices
from pipeline.clip.fitted_clip import FittedClip
from pipeline.texture import FineSurface, VertexColors, paint
from pipeline.texture.completion import complete_colors
from stages.auxiliary.generator_output import GeneratedPicture, GeneratorOutput
from stages.auxiliary.turntable_motion import TurntableMotion


def painted(
    clip: FittedClip, turn: TurntableMotion, surface: FineSurface, colors: np.ndarray
) -> GeneratorOutput:
    """The ``texture`` generator: the textured body through the turn."""

    def pictures() -> Iterator[GeneratedPicture]:
        for frame in turn.poses.frames:
            vertices = posed_vertices(clip.body, clip.identity, turn.poses.pose(frame))
            image, mask, _ = paint(turn.camera, surface, vertices, colors)
            yield GeneratedPicture(frame, image, mask)

    return GeneratorOutput(turn.poses, dict.fromkeys(turn.poses.frames, turn.camera), pictures(), exact=True)


def complete(surface: FineSurface, seen: VertexColors, light: bool = True) -> np.ndarray:
    """A colour for every vertex: [N, 3] float32 in 0 to 255.

    Args:
        surface: the fine mesh.
        seen: what the clip shows of it.
        light: colours without their shading are what is completed, and each vertex is shaded as its normal
            says.
    """
    normals = seen.normal if light else None
    found = complete_colors(surface.segments, seen.color / 255, seen.known.astype(float), normals)
    return (255 * found).astype(np.float32)
