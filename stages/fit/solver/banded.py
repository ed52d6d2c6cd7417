"""Symmetric systems whose blocks couple each frame with the next two, solved by block Cholesky.

Accelerations couple three frames in a row, so the normal equations of a clip's poses are a band two
blocks wide beside the diagonal. Time and memory are linear in the number of frames.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

_LEAST = 1e-6  # of a diagonal entry: a variable that nothing depends on does not move
REACH = 2
"""How many frames ahead a frame is coupled with."""


@dataclasses.dataclass(frozen=True)
class Banded:
    """The factor L of D (A + lambda diag A) D, where D scales the diagonal of A to 1.

    Attributes:
        scale: [T, n], the diagonal of D.
        blocks: for each of T frames the blocks L[t, t], L[t, t-1], L[t, t-2], [n, n] each, as far as
            there are such frames.
    """

    scale: Tensor
    blocks: list[list[Tensor]]

    def solve(self, right: Tensor) -> Tensor:
        """Solve for several right-hand sides: [T, n, m] -> [T, n, m]."""
        count, scaled = len(self.blocks), right * self.scale[..., None]
        solved: list[Tensor] = []
        for t, (lower, *behind) in enumerate(self.blocks):
            value = scaled[t]
            for k, block in enumerate(behind, 1):
                value = value - block @ solved[t - k]
            solved.append(torch.linalg.solve_triangular(lower, value, upper=False))
        for t in reversed(range(count)):
            value = solved[t]
            for k in range(1, min(REACH, count - 1 - t) + 1):
                value = value - self.blocks[t + k][k].mT @ solved[t + k]
            solved[t] = torch.linalg.solve_triangular(self.blocks[t][0].mT, value, upper=True)
        return torch.stack(solved) * self.scale[..., None]


def factorise(bands: Tensor, damping: Tensor) -> Banded | None:
    """Factorise A + lambda diag A.

    The diagonal is scaled to 1 first, without which float32 would not do: a root turned by a radian
    moves every landmark, a fingertip hardly one.

    Args:
        bands: [3, T, n, n], the blocks A[t, t], A[t, t+1] and A[t, t+2]; what lies beyond the last
            frame is not read.
        damping: lambda, [T], relative to the diagonal.

    Returns:
        The factor, or None if the damped matrix is not positive definite.
    """
    scale = bands[0].diagonal(dim1=1, dim2=2).clamp_min(_LEAST).rsqrt()
    diagonal = bands[0] * scale[:, :, None] * scale[:, None]
    # Exactly 1 plus lambda also where the diagonal was under the least.
    diagonal.diagonal(dim1=1, dim2=2).copy_((1 + damping)[:, None].expand_as(scale))
    ahead = [
        bands[k, : len(scale) - k] * scale[: len(scale) - k, :, None] * scale[k:, None]
        for k in range(1, min(REACH, len(scale) - 1) + 1)
    ]
    blocks: list[list[Tensor]] = []
    for t, block in enumerate(diagonal):
        behind: dict[int, Tensor] = {}
        for k in range(min(REACH, t), 0, -1):
            coupling = ahead[k - 1][t - k]  # A[t-k, t]
            if k == 1 and 2 in behind:
                coupling = torch.addmm(coupling, blocks[t - 1][1], behind[2].mT, alpha=-1)
            behind[k] = torch.linalg.solve_triangular(blocks[t - k][0], coupling, upper=False).mT
            block = torch.addmm(block, behind[k], behind[k].mT, alpha=-1)
        lower, failed = torch.linalg.cholesky_ex(block)
        if int(failed):
            return None
        blocks.append([lower, *(behind[k] for k in sorted(behind))])
    return Banded(scale, blocks)
