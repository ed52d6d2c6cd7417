"""A picture and its alpha on a background: premultiplied colour, straight colour, stored frames."""

from __future__ import annotations

from typing import TypeVar, get_args

import numpy as np
import torch
from torch import Tensor

from pipeline.config.choices import Background

BLACK, WHITE = get_args(Background)

BACKGROUNDS = {BLACK: 0.0, WHITE: 1.0}
"""What a person can be composited on -> the value of its pixels."""

AnyBackground = str | float | Tensor
"""One of ``BACKGROUNDS``, the value of a grey one, or a colour [3]."""

Picture = TypeVar("Picture", Tensor, np.ndarray)


def over(
    color: Picture,  # [H, W, 3]
    alpha: Picture,  # [H, W]
    background: AnyBackground = BLACK,
) -> Picture:
    """Premultiplied colour over a background, ``color + (1 - alpha) background``: [H, W, 3].

    Args:
        color: premultiplied with alpha, as a renderer gives it. On black it is returned as it is.
        alpha: in [0, 1].
        background: in the units of ``color``.

    Raises:
        KeyError: a background is named that is not in ``BACKGROUNDS``.
    """
    value = BACKGROUNDS[background] if isinstance(background, str) else background
    if isinstance(value, float) and value == 0:
        return color
    return color + (1 - alpha)[..., None] * value


def composite(
    color: Picture,  # [H, W, 3]
    alpha: Picture,  # [H, W]
    background: AnyBackground = BLACK,
) -> Picture:
    """Straight colour over a background, ``alpha color + (1 - alpha) background``: [H, W, 3].

    Args:
        color: not multiplied with alpha, as a camera gives it.
        alpha, background: as for ``over``.

    >>> red, half = torch.tensor([[[1.0, 0.0, 0.0]]]), torch.tensor([[0.5]])
    >>> composite(red, half, "white")
    tensor([[[1.0000, 0.5000, 0.5000]]])
    """
    return over(color * alpha[..., None], alpha, background)


def composite_frame(
    frame: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray,  # [H, W] uint8
    background: AnyBackground = BLACK,
) -> Tensor:
    """The person of a stored frame on a background: [H, W, 3] float32 in [0, 1].

    Args:
        frame: RGB.
        mask: the person's soft alpha.
        background: as for ``over``.
    """
    color, alpha = torch.from_numpy(frame).float() / 255, torch.from_numpy(mask).float() / 255
    return composite(color, alpha, background)


def cut_out(
    black: Tensor,  # [H, W, 3]
    white: Tensor,  # [H, W, 3]
    mask: np.ndarray,  # [H, W] uint8
    background: AnyBackground = BLACK,
) -> Tensor:
    """A picture of which no more is left than the truth's mask holds: [H, W, 3].

    Its alpha becomes the smaller of its own and the mask's: what lies outside counts for nothing, however
    wrong it is, and what lies inside stays as it is. Multiplying by the mask, as the authors' release does
    with renders that have the scene behind them, would cut half-transparent edges out twice here.

    Args:
        black, white: in [0, 1], the picture on both backgrounds; they differ where it is clear.
        mask: soft alpha.
        background: as for ``over``.
    """
    alpha = 1 - (white - black).mean(-1)
    kept = torch.minimum(alpha, torch.from_numpy(mask).to(black) / 255)
    share = kept / alpha.clamp_min(1e-6)
    return over(black * share[..., None], kept, background)


def to_bytes(image: Tensor) -> np.ndarray:
    """A picture as it is stored: [H, W, 3] float, clamped to [0, 1] -> uint8."""
    return (image.clamp(0, 1) * 255).round().byte().numpy()
