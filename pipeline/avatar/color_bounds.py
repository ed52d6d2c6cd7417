"""Bounds within which the colours of Gaussians are held while training ends.

About skin and cloth they are a box. Hair is bounded in its tint and its darkness alone: a few Gaussians
beyond the horizon make its soft rim, which is bright before a bright wall.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

DARKEST, BRIGHTEST = 0.02, 0.98  # colours stay where the sigmoid still has a slope
ANYWHERE = 2.0  # farther than two colours can be from each other


@dataclasses.dataclass(frozen=True)
class ColorBounds:
    """Bounds of the colours of N Gaussians.

    Attributes:
        field: [N, 3], RGB in [0, 1], what each one's segment shows there.
        around: [N], how far from it a colour may lie, in [0, 1], or ``ANYWHERE``.
        hair: [N] bool, only tint and darkness are bounded.
    """

    field: Tensor  # [N, 3]
    around: Tensor  # [N]
    hair: Tensor  # [N]

    def held(self, color: Tensor) -> Tensor:
        """Colours brought within the bounds, [N, 3]; those that are within stay to the bit.

        Every value that is changed lies within ``DARKEST`` and ``BRIGHTEST``, which may leave a very bright
        or dark one of hair a little outside.

        Args:
            color: [N, 3], RGB in [0, 1].
        """
        away, around = color - self.field, self.around[:, None]
        grey = away.mean(1, keepdim=True)
        tint = away - grey
        shorter = (around / tint.norm(dim=1, keepdim=True).clamp_min(1e-12)).clamp_max(1)
        as_hair = torch.maximum(grey, -around) + shorter * tint
        hair_is_out, skin_is_out = (grey < -around) | (shorter < 1), away.abs() > around
        outside = torch.where(self.hair, hair_is_out[:, 0], skin_is_out.any(1))[:, None]
        inside = torch.where(self.hair[:, None], as_hair, away.clamp(-around, around))
        return torch.where(outside, (self.field + inside).clamp(DARKEST, BRIGHTEST), color)

    def pick(self, rows: Tensor) -> ColorBounds:
        """The bounds of some Gaussians: [K]."""
        return ColorBounds(self.field[rows], self.around[rows], self.hair[rows])
