"""Linear maps of per-Gaussian tensors with cheap gradients: constant sparse matrices, and a choice of rows.

What never moves during training (which texels a canonical point reads, which vertices are
neighbours) is written once as a sparse matrix. Its transpose is kept beside it, because the
gradient is a product with the transpose and torch would rebuild that on every backward pass.

Torch's own gradient of indexing adds up, row by row, because rows might repeat. In ``gather_rows`` they do
not, and its gradient is a copy.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from pipeline.device import moved


@dataclasses.dataclass(frozen=True)
class SparsePair:
    """A constant sparse matrix and its transpose, both in compressed rows.

    Attributes:
        matrix: [M, K] sparse CSR, float32.
        transpose: [K, M] sparse CSR, float32.
    """

    matrix: Tensor  # [M, K]
    transpose: Tensor  # [K, M]

    @classmethod
    def build(cls, rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int]) -> SparsePair:
        """The pair for the given entries; entries at the same place add up.

        Args:
            rows: [E] int64.
            columns: [E] int64.
            values: [E] floating point.
            shape: (M, K).
        """
        places = rows.int().cpu().numpy(), columns.int().cpu().numpy()
        entries = scipy.sparse.coo_array((values.cpu().numpy(), places), shape)
        return moved(cls(_to_torch(entries.tocsr()), _to_torch(entries.T.tocsr())), values.device)

    def of_rows(self, rows: Tensor) -> SparsePair:
        """Some of the rows, [R] int64 -> a pair of shape [R, K]."""
        return self._like(_to_scipy(self.matrix)[rows.cpu().numpy()])

    def mean_among(self, members: Tensor) -> SparsePair:
        """A square matrix of means over neighbours, among some of its members alone.

        Each row is divided by what is left of its sum; a member that no neighbour is left of is its own.

        Args:
            members: [R] int64.

        Returns:
            A pair of shape [R, R].
        """
        chosen = members.cpu().numpy()
        among = _to_scipy(self.matrix)[chosen][:, chosen]
        left = np.asarray(among.sum(1), np.float64).ravel()
        scaled = scipy.sparse.diags_array(1 / np.where(left > 0, left, 1)) @ among
        alone = scipy.sparse.diags_array((left == 0).astype(np.float64))
        return self._like((scaled + alone).astype(np.float32).tocsr())

    def _like(self, matrix: scipy.sparse.csr_array) -> SparsePair:
        """Another matrix, where this one is."""
        matrix.eliminate_zeros()
        return moved(SparsePair(_to_torch(matrix), _to_torch(matrix.T.tocsr())), self.matrix.device)

    def __matmul__(self, dense: Tensor) -> Tensor:
        """``matrix @ dense``, [K, C] -> [M, C]; the backward pass is ``transpose @ gradient``."""
        return _Product.apply(dense, self)


def _to_scipy(matrix: Tensor) -> scipy.sparse.csr_array:
    matrix = matrix.cpu()
    parts = (matrix.values(), matrix.col_indices(), matrix.crow_indices())
    return scipy.sparse.csr_array(tuple(part.numpy() for part in parts), shape=tuple(matrix.shape))


def _to_torch(matrix: scipy.sparse.csr_array) -> Tensor:
    matrix.sort_indices()
    rows, columns, values = (torch.from_numpy(part) for part in (matrix.indptr, matrix.indices, matrix.data))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(rows, columns, values, matrix.shape, check_invariants=False)


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx, dense: Tensor, pair: SparsePair) -> Tensor:
        ctx.pair = pair
        return pair.matrix @ dense

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.pair.transpose @ gradient.contiguous(), None


def gather_rows(values: Tensor, rows: Tensor) -> Tensor:
    """The rows of a tensor, differentiably: [N, C] -> [M, C].

    Args:
        values: [N, C].
        rows: [M] int64, each at most once.
    """
    return _GatherRows.apply(values, rows)


def scatter_rows(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """The inverse of ``gather_rows``: [M, C] -> [count, C], zero in all other rows."""
    return _ScatterRows.apply(values, rows, count)


class _GatherRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor) -> Tensor:
        ctx.rows, ctx.count = rows, len(values)
        return values.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return scatter_rows(gradient, ctx.rows, ctx.count), None


class _ScatterRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor, count: int) -> Tensor:
        ctx.rows = rows
        return values.new_zeros(count, *values.shape[1:]).index_copy_(0, rows, values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return gather_rows(gradient, ctx.rows), None, None
