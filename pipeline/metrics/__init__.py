"""How alike two images are: the only definition of each number that the project reports.

Images are float tensors [H, W, 3] with values in [0, 1]; masks are [H, W]. The protocol (what is
composited on what, which pixels count) is in :mod:`pipeline.metrics.protocol`.
"""

from pipeline.metrics.image import PSNR_CAP, psnr, ssim
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.protocol import EROSION, composite, interior

__all__ = ["EROSION", "PSNR_CAP", "Lpips", "composite", "interior", "psnr", "ssim"]
