"""The clip's colours on the surface of the fitted body: gathered from frames, and painted into a view."""

from pipeline.texture.projection import VertexColors, gather_colors, paint, robust_mean, weighted_median
from pipeline.texture.surface import FineSurface, fine_surface

__all__ = [
    "FineSurface", "VertexColors", "fine_surface", "gather_colors", "paint", "robust_mean", "weighted_median",
]  # fmt: skip
