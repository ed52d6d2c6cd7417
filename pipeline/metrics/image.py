"""PSNR and SSIM, as torchmetrics defines them."""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from pipeline.metrics.fused_ssim import fused_ssim

PSNR_CAP = 100.0
"""The PSNR of identical images, dB. 8-bit images that differ at all stay far below it."""

SSIM_WINDOW = 11
"""The side of SSIM's Gaussian window, pixels."""

SSIM_SIGMA = 1.5
SSIM_CONSTANTS = (0.01**2, 0.03**2)


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio, ``-10 log10(mean((image - truth)^2))``, in dB.

    Args:
        image: [H, W, 3] float in [0, 1].
        truth: [H, W, 3] float in [0, 1].
        mask: [H, W] bool; the mean runs over these pixels alone. None: over the whole image.

    Returns:
        dB, at most ``PSNR_CAP`` (100), which identical images get. NaN if the mask is empty.
    """
    _check_pair(image, truth)
    if mask is not None:
        image, truth = image[mask], truth[mask]
    if image.numel() == 0:
        return float("nan")
    ratio = peak_signal_noise_ratio(image.double(), truth.double(), data_range=1.0)
    return min(float(ratio), PSNR_CAP)


def ssim(image: Tensor, truth: Tensor, background: float = 0.0) -> float:
    """Structural similarity (Wang et al. 2004), the mean over pixels and channels.

    ``(2 mx my + c1)(2 sxy + c2) / ((mx^2 + my^2 + c1)(sx^2 + sy^2 + c2))`` with means, variances and
    covariance under a Gaussian of 11 x 11 pixels and sigma 1.5, c1 = 0.01^2, c2 = 0.03^2, at every pixel;
    the image is mirrored at its border. An image that is smaller than the window is first widened to it
    with what the person stands on.

    This is torchmetrics' definition, and equal to it in float64 (tests/unit/test_metrics.py). float32,
    as it is commonly run in, takes up to 0.001 off where an image is flat, because variances drown in
    rounding there; in float64 torchmetrics takes two seconds an image, and this takes a hundredth of it.

    Args:
        image: [H, W, 3] float in [0, 1].
        truth: [H, W, 3] float in [0, 1].
        background: the value of the pixels that small images are widened with.

    Returns:
        At most 1, which identical images get.
    """
    _check_pair(image, truth)
    x, y = (_at_least(one.detach().cpu().double(), background).numpy() for one in (image, truth))
    mx, my = _local_mean(x), _local_mean(y)
    variances = _local_mean(x * x) - mx**2 + _local_mean(y * y) - my**2
    covariance = _local_mean(x * y) - mx * my
    c1, c2 = SSIM_CONSTANTS
    similarity = (2 * mx * my + c1) * (2 * covariance + c2) / ((mx**2 + my**2 + c1) * (variances + c2))
    return float(similarity.mean())


def dissimilarity(image: Tensor, truth: Tensor, background: float = 0.0) -> Tensor:
    """One minus SSIM as a loss: scalar, with a gradient to ``image``, in the images' own precision.

    On a CPU one fused kernel, see ``fused_ssim.py``: torchmetrics takes 0.8 s an image there.

    Args:
        image, truth, background: as for ``ssim``.
    """
    _check_pair(image, truth)
    x, y = (_at_least(one, background) for one in (image, truth.detach()))
    if x.device.type == "cpu":
        return fused_ssim(x, y, _window(), SSIM_CONSTANTS)
    x, y = (one.permute(2, 0, 1)[None] for one in (x, y))
    return 1 - torch.as_tensor(structural_similarity_index_measure(x, y, data_range=1.0))


def _window() -> Tensor:
    """SSIM's window along one axis, [11] float32."""
    taps = cv2.getGaussianKernel(SSIM_WINDOW, SSIM_SIGMA)[:, 0]
    return torch.from_numpy(taps).float()


def _local_mean(image: np.ndarray) -> np.ndarray:
    """The mean under SSIM's window around each pixel, [H, W, 3] float64."""
    return cv2.GaussianBlur(image, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA, borderType=cv2.BORDER_REFLECT_101)


def _at_least(image: Tensor, background: float) -> Tensor:
    """The image with background added on the right and below until both sides reach SSIM's window."""
    height, width = image.shape[:2]
    margins = (0, 0, 0, max(0, SSIM_WINDOW - width), 0, max(0, SSIM_WINDOW - height))
    return F.pad(image, margins, value=background)


def _check_pair(image: Tensor, truth: Tensor) -> None:
    if image.shape != truth.shape or image.ndim != 3 or image.shape[-1] != 3:
        shapes = f"{tuple(image.shape)} and {tuple(truth.shape)}"
        raise ValueError(f"two images [H, W, 3] were expected, not {shapes}")
