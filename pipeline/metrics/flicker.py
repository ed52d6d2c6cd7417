"""Flicker: how much a picture's error changes from one frame to the next.

``mean |(R_t - R_t-1) - (T_t - T_t-1)|`` over the pixels that are the person in both true frames, R being
rendered and T true, on black. A blur that stays costs nothing; what trembles costs, and so does a motion
that the render makes late or not at all. The true motion is subtracted pixel by pixel and nothing is
warped: an optical flow would bring errors of its own, as large as what is measured.
"""

from __future__ import annotations

from torch import Tensor

LEVELS = 255.0
"""Flicker is given in levels of an 8-bit picture."""


def flicker(render: Tensor, before: Tensor, truth: Tensor, truth_before: Tensor, inside: Tensor) -> float:
    """The flicker from a frame to the next.

    Args:
        render, before: [H, W, 3] in [0, 1], the rendered frame and the one before it.
        truth, truth_before: [H, W, 3], the true ones.
        inside: [H, W] bool, the pixels that count.

    Returns:
        Levels of 255; NaN where no pixel counts.

    >>> import torch
    >>> still, all_pixels = torch.zeros(4, 4, 3), torch.ones(4, 4, dtype=torch.bool)
    >>> round(flicker(still + 0.1, still, still, still, all_pixels), 1)
    25.5
    """
    change = (render - truth) - (before - truth_before)
    return float(change.abs()[inside].double().mean()) * LEVELS if bool(inside.any()) else float("nan")
