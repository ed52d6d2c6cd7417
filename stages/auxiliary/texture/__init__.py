"""A texture learnt from the clip without a network: gathered, completed, and painted onto the turn."""

from pipeline.texture import FineSurface, Seen, fine_surface, gather, paint
from stages.auxiliary.texture.complete import complete

__all__ = ["FineSurface", "Seen", "complete", "fine_surface", "gather", "paint"]
