"""Structural similarity (Wang et al. 2004), as a score in float64 and as a loss with a gradient.

``(2 mx my + c1)(2 sxy + c2) / ((mx^2 + my^2 + c1)(sx^2 + sy^2 + c2))`` with means, variances and covariance
under a Gaussian of 11 x 11 pixels and sigma 1.5, c1 = 0.01^2, c2 = 0.03^2, at every pixel and channel; the
mean over all of them. The image is mirrored at its border. An image that is smaller than the window is
first widened to it with what the person stands on. This is torchmetrics' definition.

``ssim`` and ``ssim_loss`` share it; they differ in precision. Variances of a flat image drown in float32's
rounding: a float32 score is up to 0.001 off there, so that the score is computed in float64. A loss may be
off by as much, and is computed in the images' own precision, on a CPU by the kernel in ``ssim_kernel.py``.
"""

from __future__ import annotations

import functools
from typing import TypeVar

import cv2
import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from pipeline.device import kernels_serve
from pipeline.metrics.psnr import require_pair
from pipeline.metrics.ssim_kernel import fused_ssim_loss

WINDOW = 11
"""The side of the Gaussian window, pixels."""

SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2

Map = TypeVar("Map", np.ndarray, Tensor)


def ssim(
    image: Tensor,  # [H, W, 3]
    truth: Tensor,  # [H, W, 3]
    background: float = 0.0,
) -> float:
    """The structural similarity of two images, in float64 without gradient.

    Equal to torchmetrics in float64 (tests/unit/test_metrics.py), in a hundredth of its time.

    Args:
        image, truth: float in [0, 1].
        background: the value of the pixels that small images are widened with.

    Returns:
        At most 1, which identical images get.

    Raises:
        ValueError: the images differ in shape or are not [H, W, 3].

    >>> image = torch.rand(32, 32, 3)
    >>> ssim(image, image)
    1.0
    """
    require_pair(image, truth)
    x, y = (_at_least_window(one.detach().cpu().double(), background).numpy() for one in (image, truth))

    def local_mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (WINDOW, WINDOW), SIGMA, borderType=cv2.BORDER_REFLECT_101)

    similarity = _similarity(*(local_mean(values) for values in (x, y, x * x, y * y, x * y)))
    return float(similarity.mean())


def ssim_loss(
    image: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    background: float = 0.0,
    window: Tensor | None = None,  # [11]
) -> Tensor:
    """One minus the structural similarity, scalar, in the images' own precision (L_ssim of Equation 9).

    On a CPU one fused kernel where the target needs no gradient; elsewhere ``plain_ssim_loss``.

    Args:
        image, target: float in [0, 1].
        background: as for ``ssim``.
        window: along one axis; ``gaussian_window()`` if None.

    Raises:
        ValueError: the images differ in shape or are not [H, W, 3].

    >>> image = torch.full((32, 32, 3), 0.5, requires_grad=True)
    >>> loss = ssim_loss(image, torch.zeros(32, 32, 3))
    >>> loss.backward()
    >>> image.grad.shape
    torch.Size([32, 32, 3])
    """
    require_pair(image, target)
    if min(image.shape[:2]) < WINDOW:
        image, target = (_at_least_window(one, background) for one in (image, target))
    window = gaussian_window() if window is None else window
    known = image.dtype == target.dtype and image.dtype in (torch.float32, torch.float64)
    if not kernels_serve(image) or target.requires_grad or not known:
        return plain_ssim_loss(image, target, window)
    return fused_ssim_loss(image, target, window, (C1, C2))


def plain_ssim_loss(
    image: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    window: Tensor | None = None,  # [11]
) -> Tensor:
    """``ssim_loss`` in plain torch, of images at least as large as the window.

    The five local means are one grouped convolution with a single batch entry: the same as a
    batch of single-channel images takes twenty times as long on a CPU.
    """
    both = torch.cat([image.permute(2, 0, 1), target.permute(2, 0, 1)])[None]
    x, y = functional.pad(both, [WINDOW // 2] * 4, mode="reflect").chunk(2, dim=1)
    maps = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    channels = maps.shape[1]
    taps = (gaussian_window() if window is None else window).to(maps)
    maps = functional.conv2d(maps, taps.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    maps = functional.conv2d(maps, taps.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
    return 1 - _similarity(*maps[0].chunk(5)).mean()


def _similarity(mean_x: Map, mean_y: Map, square_x: Map, square_y: Map, product: Map) -> Map:
    """The similarity at each pixel from five local means: of x, y, x^2, y^2 and x y."""
    mean_xy, mean_xx, mean_yy = mean_x * mean_y, mean_x * mean_x, mean_y * mean_y
    numerator = (2 * mean_xy + C1) * (2 * (product - mean_xy) + C2)
    denominator = (mean_xx + mean_yy + C1) * (square_x - mean_xx + square_y - mean_yy + C2)
    return numerator / denominator


@functools.cache
def gaussian_window() -> Tensor:
    """The window along one axis, computed in float32 throughout: [11]."""
    offset = torch.arange(WINDOW, dtype=torch.float32) - WINDOW // 2
    weights = torch.exp(-(offset**2) / (2 * SIGMA**2))
    return weights / weights.sum()


@functools.cache
def rounded_gaussian_window() -> Tensor:
    """The window along one axis, computed in float64 and then rounded: [11] float32.

    Four taps differ from ``gaussian_window`` in the last bit. Refined test poses have always been found with
    this one and avatars trained with the other; a change of either would change published bytes.
    """
    return torch.from_numpy(cv2.getGaussianKernel(WINDOW, SIGMA)[:, 0]).float()


def _at_least_window(image: Tensor, background: float) -> Tensor:
    """The image with background added on the right and below until both sides reach the window's."""
    height, width = image.shape[:2]
    margins = (0, 0, 0, max(0, WINDOW - width), 0, max(0, WINDOW - height))
    return functional.pad(image, margins, value=background)
