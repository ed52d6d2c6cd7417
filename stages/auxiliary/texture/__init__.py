"""A texture learnt from the clip without a network: projected, completed, and painted onto the turn."""

from stages.auxiliary.texture.complete import complete
from stages.auxiliary.texture.paint import paint
from stages.auxiliary.texture.project import Seen, gather
from stages.auxiliary.texture.surface import FineSurface, fine_surface

__all__ = ["FineSurface", "Seen", "complete", "fine_surface", "gather", "paint"]
