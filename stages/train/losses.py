"""The terms of the objective, each a pure function (paper, Equation 9; supplement D)."""

from __future__ import annotations

from torch import Tensor

from pipeline.avatar.sparse import SparsePair


def l1(image: Tensor, target: Tensor) -> Tensor:
    """The mean absolute difference of two images, [H, W, 3] -> scalar (L_1)."""
    return (image - target).abs().mean()


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
