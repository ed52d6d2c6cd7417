"""LPIPS as a loss term: on a crop of the person, in one of several drawn frames."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.metrics import Lpips

PERSON = 0.5  # alpha from which a pixel is the person's


def due(position: int, every: int) -> bool:
    """True where LPIPS takes part in the ``position``-th draw of a run."""
    return position % every == 0


def crop(alpha: Tensor, side: int, share: float) -> tuple[slice, slice]:
    """A square around a pixel of the person, moved into the picture where it would stick out.

    Args:
        alpha: [H, W], the person's soft mask.
        side: pixels; 0 for the whole picture. A smaller picture is taken whole along that axis.
        share: in [0, 1), which of the person's pixels, in the order of rows.

    Returns:
        Rows and columns.
    """
    height, width = alpha.shape
    if side == 0:
        return slice(0, height), slice(0, width)
    person = torch.nonzero(alpha.flatten() >= PERSON)[:, 0]
    middle = int(person[int(share * len(person))]) if len(person) else height // 2 * width + width // 2
    return _range(middle // width, side, height), _range(middle % width, side, width)


def perceptual(network: Lpips, image: Tensor, target: Tensor, place: tuple[slice, slice]) -> Tensor:
    """LPIPS of a crop, [H, W, 3] twice -> scalar; gradients reach the image."""
    return network(image[place], target[place])[0]


def _range(middle: int, side: int, length: int) -> slice:
    first = min(max(0, middle - side // 2), max(0, length - side))
    return slice(first, min(length, first + side))
