"""MimicMotion on the parts of Stable Video Diffusion that diffusers has; the extra ``diffusion``.

No weights are to be had where this was written: shapes, tiling, blending, determinism and loading are
tested with tiny random weights, and no real ones were ever run.
"""

from stages.auxiliary.mimicmotion.denoising import animate, tile_weights, tiles
from stages.auxiliary.mimicmotion.model import Model, PoseNet, load_model

__all__ = ["Model", "PoseNet", "animate", "load_model", "tile_weights", "tiles"]
