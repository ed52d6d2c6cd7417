"""A texture learnt from the clip without a network: gathered, completed, and painted onto the turn."""

from pipeline.texture import FineSurface, VertexColors, fine_surface, gather_colors, paint
from stages.auxiliary.texture.complete import complete

__all__ = ["FineSurface", "VertexColors", "complete", "fine_surface", "gather_colors", "paint"]
