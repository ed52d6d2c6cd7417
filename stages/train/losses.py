"""The losses of the objective as pure functions (paper, Equation 9; supplement D).

Each returns its values unreduced, a value a pixel, a vertex or a parameter. ``weighted_mean`` reduces them,
so that masks and weights by body part are applied in one place. SSIM and LPIPS (``pipeline.metrics``) reduce
themselves. The table in ``objective.py`` says which loss is taken of what.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.avatar.sparse import SparsePair
from pipeline.metrics import Lpips

PERSON = 0.5  # alpha from which a pixel is the person's


def weighted_mean(
    values: Tensor,  # [...]
    weight: Tensor | float | None = None,  # broadcast against values
    count: int | None = None,
) -> Tensor:
    """The mean of ``weight * values``, a scalar.

    Args:
        values: a loss's.
        weight: of each value; 1 if None.
        count: what the sum is divided by; the number of values if None.
    """
    weighted = values if weight is None else weight * values
    return weighted.mean() if count is None else weighted.sum() / count


def l1(
    image: Tensor,  # [..., 3]
    target: Tensor,  # [..., 3]
) -> Tensor:
    """The absolute differences of two images, [..., 3] (L_1 and L_face of Equation 9)."""
    return (image - target).abs()


def lpips(
    network: Lpips,
    image: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
) -> Tensor:
    """The LPIPS distance of two images, scalar (L_lpips); gradients reach the image."""
    return network(image, target)[0]


def size(
    values: Tensor,  # [N, C]
) -> Tensor:
    """The sizes of values, [N, C]."""
    return values.abs()


def l2(
    values: Tensor,  # [N, C]
) -> Tensor:
    """The squares of per-vertex values, [N, C]."""
    return values.square()


def laplacian(
    values: Tensor,  # [N, C]
    neighbours: SparsePair,  # [N, N]
) -> Tensor:
    """The squared uniform Laplacian of per-vertex values, [N, C].

    Args:
        values: of each vertex.
        neighbours: the mean over each vertex's neighbours. A vertex without neighbours has the mean 0, so
            that its own value is what is penalised.
    """
    return (values - neighbours @ values).square()


def scale_growth(
    log_scale: Tensor,  # [N, 3]
) -> Tensor:
    """The squared growth of log scales beyond their initial values, [N, 3].

    It is not taken of the scale itself: that would shrink Gaussians that no frame shows, and leave gaps in
    views that training never had.
    """
    return log_scale.clamp_min(0).square()


def scale_shrink(
    log_scale: Tensor,  # [N, 3]
) -> Tensor:
    """The squared fall of log scales below their initial values, at which neighbours just cover, [N, 3].

    A Gaussian that is seen from its edge, or lies outside the mask, could otherwise vanish by shrinking, and
    the surface is a sieve from any other side. With it such a Gaussian moves.
    """
    return log_scale.clamp_max(0).square()


def outward_offset(
    offset: Tensor,  # [M, 3]
    normals: Tensor,  # [M, 3]
    softness: float = 1e-3,
) -> Tensor:
    """``max(n . offset / |offset|, 0)``, the outward part of offsets' directions, [M] (ExAvatar's hands).

    Masks bleed around fingers; without it hands swell to fill them.

    Args:
        offset: metres.
        normals: unit, outward.
        softness: metres under which an offset has no full direction yet: 0 has no gradient to offer.
    """
    direction = offset / (offset.square().sum(1, keepdim=True) + softness**2).sqrt()
    return (normals * direction).sum(1).clamp_min(0)


def color_variance(
    colors: Tensor,  # [M, 3]
) -> Tensor:
    """The squared differences of colours from their mean, [M, 3]; the mean gets no gradient."""
    return (colors - colors.mean(0).detach()).square()


def blend_to_target(
    image: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    weight: Tensor,  # [H, W]
) -> Tensor:
    """The image blended with its target: image where the weight is 1, target where it is 0, [H, W, 3].

    For targets that are not to be trusted everywhere. Compared with the target, the result's L1 is the
    weighted L1, and SSIM and LPIPS find no difference where the weight is 0; no gradient reaches the image
    there.
    """
    return target + weight[..., None] * (image - target)


def person_crop(
    alpha: Tensor,  # [H, W]
    side: int,
    share: float,
) -> tuple[slice, slice]:
    """Rows and columns of a square around a pixel of the person, moved into the picture if it sticks out.

    Args:
        alpha: the person's soft mask.
        side: pixels; 0 for the whole picture. A smaller picture is taken whole along that axis.
        share: in [0, 1), which of the person's pixels, in the order of rows.
    """
    height, width = alpha.shape
    if side == 0:
        return slice(0, height), slice(0, width)
    person = torch.nonzero(alpha.flatten() >= PERSON)[:, 0]
    middle = int(person[int(share * len(person))]) if len(person) else height // 2 * width + width // 2
    return _around(middle // width, side, height), _around(middle % width, side, width)


def _around(middle: int, side: int, length: int) -> slice:
    first = min(max(0, middle - side // 2), max(0, length - side))
    return slice(first, min(length, first + side))
