"""The image metrics: the only definition of each number that the project reports.

Images are float tensors [H, W, 3] with values in [0, 1]; masks are [H, W]. Which pixels
count is in :mod:`pipeline.metrics.regions`, compositing in :mod:`pipeline.clip.composite`.
"""

from pipeline.metrics.lpips import Lpips
from pipeline.metrics.psnr import PSNR_CAP, psnr
from pipeline.metrics.regions import EROSION, interior
from pipeline.metrics.ssim import ssim, ssim_loss

__all__ = [
    "EROSION",
    "PSNR_CAP",
    "Lpips",
    "interior",
    "psnr",
    "ssim",
    "ssim_loss",
]
