"""Some rows of a per-Gaussian tensor, and back, with gradients that cost a copy.

Torch's own gradient of indexing adds up, row by row, because rows might repeat. Here they do not.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def take(values: Tensor, rows: Tensor) -> Tensor:
    """The rows of a tensor, differentiably: [N, C] -> [M, C].

    Args:
        values: [N, C].
        rows: [M] int64, each at most once.
    """
    return _Take.apply(values, rows)


def put(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """The inverse of ``take``: [M, C] -> [count, C], zero in all other rows."""
    return _Put.apply(values, rows, count)


class _Take(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor) -> Tensor:
        ctx.rows, ctx.count = rows, len(values)
        return values.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return put(gradient, ctx.rows, ctx.count), None


class _Put(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor, count: int) -> Tensor:
        ctx.rows = rows
        return values.new_zeros(count, *values.shape[1:]).index_copy_(0, rows, values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return take(gradient, ctx.rows), None, None
