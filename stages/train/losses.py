"""The terms of the objective, each a pure function (paper, Equation 9; supplement D)."""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as functional
from torch import Tensor

from pipeline.avatar.sparse import SparsePair

WINDOW = 11  # pixels, of SSIM's Gaussian window
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2


def l1(image: Tensor, target: Tensor) -> Tensor:
    """The mean absolute difference of two images, [H, W, 3] -> scalar (L_1)."""
    return (image - target).abs().mean()


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """One minus the structural similarity of two images, scalar (L_ssim).

    Wang et al. 2004 with a Gaussian window of 11 pixels and sigma 1.5 and the image mirrored at its
    border, the mean over all pixels, as torchmetrics takes it.

    The five local moments are one grouped convolution with a single batch entry: the same as a
    batch of single-channel images takes twenty times as long on a CPU.

    Args:
        image: [H, W, 3] in [0, 1], at least 11 pixels along each side.
        target: [H, W, 3].
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


def laplacian(values: Tensor, neighbours: SparsePair) -> Tensor:
    """Mean squared uniform Laplacian of per-vertex values, [N, C] -> scalar.

    Args:
        values: [N, C].
        neighbours: [N, N], the mean over each vertex's neighbours. A vertex without neighbours has
            the mean 0, so that its own value is what is penalised.
    """
    return (values - neighbours @ values).square().mean()


def size(values: Tensor, chosen: Tensor | None = None) -> Tensor:
    """Mean square of per-vertex values, [N, C] -> scalar, over the chosen vertices alone if given.

    Args:
        values: [N, C].
        chosen: [N] bool; the result is 0 where it chooses none.
    """
    if chosen is None:
        return values.square().mean()
    count = int(chosen.sum()) * values.shape[1]
    return (values.square() * chosen[:, None]).sum() / max(count, 1)
