"""The terms of the objective, each a pure function (paper, Equation 9; supplement D)."""

from __future__ import annotations

import torch.nn.functional as functional
from torch import Tensor

from pipeline.avatar.sparse import SparsePair


def l1(image: Tensor, target: Tensor) -> Tensor:
    """The mean absolute difference of two images, [H, W, 3] -> scalar (L_1)."""
    return (image - target).abs().mean()


def trust(alpha: Tensor, band: int) -> Tensor:
    """How far a mask is to be believed at each pixel, [H, W] -> [H, W] in [0, 1].

    ``1 - 4 a (1 - a)``, one minus the scaled variance of a coin with the mask's mean a over the
    surrounding square: 0 on the silhouette, 1 where all of the square agrees.

    Args:
        alpha: [H, W], a soft mask.
        band: pixels on either side of the silhouette that are in doubt; the square has
            ``2 band + 1`` pixels a side.
    """
    mean = functional.avg_pool2d(alpha[None], 2 * band + 1, 1, band, count_include_pad=False)[0]
    return 1 - 4 * mean * (1 - mean)


def believed(image: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """The image moved towards the target where the target is in doubt, [H, W, 3].

    Compared with the target, its L1 is the weighted L1, and SSIM and LPIPS see agreement where there
    is nothing to be believed. No gradient reaches the image where the weight is 0.

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


def size(values: Tensor, weight: Tensor | float = 1.0) -> Tensor:
    """Mean square of per-vertex values, [N, C] -> scalar, each weighted by [N, 1] or a number."""
    return (weight * values.square()).mean()


def growth(log_scale: Tensor) -> Tensor:
    """Mean square of what scales have grown beyond their initial values, [N, 3] logarithms -> scalar.

    Shrinking costs nothing here and gains nothing: a penalty on the size itself draws in what no
    frame holds open, and leaves gaps in views that training never had.
    """
    return log_scale.clamp_min(0).square().mean()


def outward(offset: Tensor, normals: Tensor, softness: float = 1e-3) -> Tensor:
    """How far offsets point outwards, mean of ``max(n . offset / |offset|, 0)`` (ExAvatar's hands).

    Masks bleed around fingers; without it hands swell to fill them.

    Args:
        offset: [M, 3], metres.
        normals: [M, 3], unit, outward.
        softness: metres under which an offset has no full direction yet: 0 has no gradient to offer.
    """
    direction = offset / (offset.square().sum(1, keepdim=True) + softness**2).sqrt()
    return (normals * direction).sum(1).clamp_min(0).mean()


def spread_of_color(colors: Tensor) -> Tensor:
    """Mean squared difference of colours from their mean, which gets no gradient: [M, 3] -> scalar."""
    return (colors - colors.mean(0).detach()).square().mean()
