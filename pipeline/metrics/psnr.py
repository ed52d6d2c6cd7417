"""PSNR, the peak signal-to-noise ratio."""

from __future__ import annotations

import math

from torch import Tensor

PSNR_CAP = 100.0
"""The PSNR of identical images, dB. 8-bit images that differ at all stay far below it."""


def psnr(
    image: Tensor,  # [H, W, 3]
    truth: Tensor,  # [H, W, 3]
    mask: Tensor | None = None,  # [H, W]
) -> float:
    """Peak signal-to-noise ratio, ``-10 log10(mean((image - truth)^2))``, in dB.

    Args:
        image, truth: float in [0, 1].
        mask: bool; the mean runs over these pixels alone. None: over the whole image.

    Returns:
        dB, at most ``PSNR_CAP`` (100), which identical images get. NaN if the mask is empty.

    Raises:
        ValueError: the images differ in shape or are not [H, W, 3].

    >>> import torch
    >>> round(psnr(torch.zeros(4, 4, 3), torch.full((4, 4, 3), 0.1)), 3)
    20.0
    """
    require_pair(image, truth)
    if mask is not None:
        image, truth = image[mask], truth[mask]
    if image.numel() == 0:
        return float("nan")
    error = float((image.double() - truth.double()).square().mean())
    return min(-10 * math.log10(error), PSNR_CAP) if error else PSNR_CAP


def require_pair(image: Tensor, truth: Tensor) -> None:
    """Refuses what are not two images of one size.

    Raises:
        ValueError: the shapes differ or are not [H, W, 3].
    """
    if image.shape != truth.shape or image.ndim != 3 or image.shape[-1] != 3:
        shapes = f"{tuple(image.shape)} and {tuple(truth.shape)}"
        raise ValueError(f"two images [H, W, 3] were expected, not {shapes}")
