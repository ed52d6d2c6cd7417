"""How alike two images are: the only definition of each number that the project reports.

Images are float tensors [H, W, 3] with values in [0, 1]; masks are [H, W]. The protocol (what is
composited on what, which pixels count) is in :mod:`pipeline.metrics.protocol`.
"""

from pipeline.metrics.image import PSNR_CAP, dissimilarity, psnr, ssim
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.protocol import BACKGROUNDS, EROSION, composite, interior, over

__all__ = [
    "BACKGROUNDS",
    "EROSION",
    "PSNR_CAP",
    "Lpips",
    "composite",
    "dissimilarity",
    "interior",
    "over",
    "psnr",
    "ssim",
]
