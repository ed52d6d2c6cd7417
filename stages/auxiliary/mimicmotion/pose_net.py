"""From skeleton frames to what is added to the UNet's first features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_WIDTHS = ((3, 1), (16, 2), (16, 1), (32, 2), (32, 1), (64, 2), (64, 1), (128, 1))
"""Channels and stride of the eight convolutions; together they divide the picture's sides by 8."""


class PoseNet(nn.Module):
    """Eight convolutions with SiLU, then one of a pixel that starts at zero, times a learnt number.

    At the start of its training nothing is added, so that the video model is what it was.
    """

    def __init__(self, channels: int = 320):
        """Args: channels of the UNet's first features."""
        super().__init__()
        layers: list[nn.Module] = []
        before = 3
        for width, stride in _WIDTHS:
            kernel = 4 if stride == 2 else 3
            layers += [nn.Conv2d(before, width, kernel, stride, padding=1), nn.SiLU()]
            before = width
        self.conv_layers = nn.Sequential(*layers)
        self.final_proj = nn.Conv2d(before, channels, 1)
        nn.init.zeros_(self.final_proj.weight)
        nn.init.zeros_(self.final_proj.bias)  # type: ignore[arg-type]
        self.scale = nn.Parameter(torch.full((1,), 2.0))

    def forward(self, poses: Tensor) -> Tensor:
        """Skeletons [F, 3, H, W] in [-1, 1] -> [F, channels, H / 8, W / 8]."""
        return self.final_proj(self.conv_layers(poses)) * self.scale
