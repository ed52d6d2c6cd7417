"""The terms of the objective, each a pure function (paper, Equation 9; supplement D)."""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as functional
from torch import Tensor

from pipeline.avatar.sparse import SparsePair
from pipeline.device import kernels_serve
from pipeline.metrics.fused_ssim import fused_ssim

WINDOW = 11  # pixels, of SSIM's Gaussian window
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2


def l1(image: Tensor, target: Tensor) -> Tensor:
    """The mean absolute difference of two images, [H, W, 3] -> scalar (L_1)."""
    return (image - target).abs().mean()


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """One minus the structural similarity of two images, scalar (L_ssim).

    Wang et al. 2004 with a Gaussian window of 11 pixels and sigma 1.5 and the image mirrored at its
    border, the mean over all pixels, as torchmetrics takes it. On a CPU one fused kernel (see
    ``pipeline/metrics/fused_ssim.py``) where the target needs no gradient; elsewhere ``plain_ssim``.

    Args:
        image: [H, W, 3] in [0, 1], at least 11 pixels along each side.
        target: [H, W, 3].
    """
    known = image.dtype == target.dtype and image.dtype in (torch.float32, torch.float64)
    if not kernels_serve(image) or target.requires_grad or not known:
        return plain_ssim(image, target)
    return fused_ssim(image, target, _window(), (C1, C2))


def plain_ssim(image: Tensor, target: Tensor) -> Tensor:
    """The same as ``ssim`` in plain torch: [H, W, 3] twice -> scalar.

    The five local moments are one grouped convolution with a single batch entry: the same as a
    batch of single-channel images takes twenty times as long on a CPU.
    """
    both = torch.cat([image.permute(2, 0, 1), target.permute(2, 0, 1)])[None]
    x, y = functional.pad(both, [WINDOW // 2] * 4, mode="reflect").chunk(2, dim=1)
    maps = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    channels = maps.shape[1]
    window = _window().to(maps)
    maps = functional.conv2d(maps, window.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    maps = functional.conv2d(maps, window.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
    mean_x, mean_y, square_x, square_y, product = maps[0].chunk(5)
    mean_xy, mean_xx, mean_yy = mean_x * mean_y, mean_x * mean_x, mean_y * mean_y
    numerator = (2 * mean_xy + C1) * (2 * (product - mean_xy) + C2)
    denominator = (mean_xx + mean_yy + C1) * (square_x - mean_xx + square_y - mean_yy + C2)
    return 1 - (numerator / denominator).mean()


@functools.cache
def _window() -> Tensor:
    offset = torch.arange(WINDOW, dtype=torch.float32) - WINDOW // 2
    weights = torch.exp(-(offset**2) / (2 * SIGMA**2))
    return weights / weights.sum()


def over(color: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
    """Premultiplied colour over a background: [H, W, 3], [H, W], [3] -> [H, W, 3]."""
    return color + (1 - alpha)[..., None] * background


def blend_to_target(image: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """The image blended with its target: image where the weight is 1, target where it is 0, [H, W, 3].

    For targets that are not to be trusted everywhere. Compared with the target, the result's L1 is the
    weighted L1, and SSIM and LPIPS find no difference where the weight is 0; no gradient reaches the image
    there.

    Args:
        image, target: [H, W, 3].
        weight: [H, W] in [0, 1].
    """
    return target + weight[..., None] * (image - target)


def laplacian(values: Tensor, neighbours: SparsePair, weight: Tensor | float = 1.0) -> Tensor:
    """Mean squared uniform Laplacian of per-vertex values, [N, C] -> scalar.

    Args:
        values: [N, C].
        neighbours: [N, N], the mean over each vertex's neighbours. A vertex without neighbours has
            the mean 0, so that its own value is what is penalised.
        weight: of each vertex's square, [N, 1] or a number.
    """
    return (weight * (values - neighbours @ values).square()).mean()


def l2(values: Tensor, weight: Tensor | float = 1.0) -> Tensor:
    """Mean square of per-vertex values, [N, C] -> scalar; each vertex weighted by [N, 1] or a number."""
    return (weight * values.square()).mean()


def scale_growth(log_scale: Tensor) -> Tensor:
    """Mean square of the growth of scales beyond their initial values, [N, 3] logarithms -> scalar.

    Shrinking has no penalty: one on the scale itself shrinks Gaussians that no frame shows, and leaves gaps
    in views that training never had.
    """
    return log_scale.clamp_min(0).square().mean()


def outward_offset(offset: Tensor, normals: Tensor, softness: float = 1e-3) -> Tensor:
    """Mean of ``max(n . offset / |offset|, 0)``, the outward part of offsets' directions (ExAvatar's hands).

    Masks bleed around fingers; without it hands swell to fill them.

    Args:
        offset: [M, 3], metres.
        normals: [M, 3], unit, outward.
        softness: metres under which an offset has no full direction yet: 0 has no gradient to offer.
    """
    direction = offset / (offset.square().sum(1, keepdim=True) + softness**2).sqrt()
    return (normals * direction).sum(1).clamp_min(0).mean()


def color_variance(colors: Tensor) -> Tensor:
    """Mean squared difference of colours from their mean, [M, 3] -> scalar; the mean gets no gradient."""
    return (colors - colors.mean(0).detach()).square().mean()
