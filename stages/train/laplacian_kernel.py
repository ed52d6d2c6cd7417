"""The weighted mean of squared Laplacians in one pass over the neighbours, and its gradient in a second.

``losses.weighted_mean`` of ``losses.laplacian`` says what is computed. In torch that is a product with a
sparse matrix, a difference, a square, a product with weights and a sum, each a pass of its own over every
vertex, and as many backward.
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipeline.avatar.sparse import SparsePair
from pipeline.device import kernels_serve
from pipeline.numba_kernels import kernel, parallel_kernel, use_torch_threads
from stages.train import losses

CHUNKS = 16  # of vertices; their sums are added up chunk by chunk, whatever the number of threads
CHANNELS = 3  # that the kernels know: x, y, z or red, green, blue


def mean_laplacian(
    values: Tensor,  # [N, 3]
    neighbours: SparsePair,  # [N, N]
    weight: Tensor | None = None,  # [N, 1]
) -> Tensor:
    """The mean of ``weight * losses.laplacian(values, neighbours)``, a scalar.

    Args:
        values: of each vertex.
        neighbours: the mean over each vertex's neighbours.
        weight: of each vertex, without gradient; 1 if None.
    """
    single = values.dtype == torch.float32 and values.shape[1:] == (CHANNELS,) and len(values) > 0
    if not kernels_serve(values) or not single:
        return losses.weighted_mean(losses.laplacian(values, neighbours), weight)
    weights = np.empty(0, np.float32) if weight is None else weight.detach().flatten().contiguous().numpy()
    return _MeanLaplacian.apply(values, neighbours, weights)


class _MeanLaplacian(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, neighbours: SparsePair, weights: np.ndarray) -> Tensor:
        use_torch_threads()
        rough, sums = torch.empty(values.shape), np.empty(CHUNKS)
        arrays = values.detach().contiguous().numpy(), rough.numpy()
        weighted_roughness(*_rows(neighbours.matrix), weights, *arrays, sums)
        ctx.rough, ctx.transpose = rough, neighbours.transpose
        return torch.tensor(sums.sum() / values.numel(), dtype=values.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None, None]:
        use_torch_threads()
        found = torch.empty_like(ctx.rough)
        factor = np.float32(2 * float(gradient) / found.numel())
        roughness_gradient(*_rows(ctx.transpose), ctx.rough.numpy(), factor, found.numpy())
        return found, None, None


def _rows(matrix: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The compressed rows of a sparse matrix: starts, columns and entries."""
    parts = matrix.crow_indices(), matrix.col_indices(), matrix.values()
    return tuple(part.numpy() for part in parts)  # type: ignore[return-value]


@kernel
def _difference(starts, columns, entries, values, row):
    """A row's three values less the matrix's product with them."""
    # Unsigned: a signed number might count from the end for all that the compiler knows.
    x, y, z = values[row, 0], values[row, 1], values[row, 2]
    for place in range(np.uint64(starts[row]), np.uint64(starts[row + np.uint64(1)])):
        column, entry = np.uint64(columns[place]), entries[place]
        x -= entry * values[column, 0]
        y -= entry * values[column, 1]
        z -= entry * values[column, 2]
    return x, y, z


@parallel_kernel
def weighted_roughness(starts, columns, entries, weights, values, rough, sums):
    """Each vertex's Laplacian times its weight, and the sum of all ``weight * Laplacian^2``.

    Args:
        starts, columns, entries: the mean over neighbours, [N, N] in compressed rows.
        weights: [N]; [0] for 1.
        values: [N, 3].
        rough: output [N, 3].
        sums: output [CHUNKS] float64.
    """
    count, weighted = values.shape[0], len(weights) > 0
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        total = 0.0
        for i in range(np.uint64(chunk * step), np.uint64(min(count, (chunk + 1) * step))):
            x, y, z = _difference(starts, columns, entries, values, i)
            weight = weights[i] if weighted else np.float32(1)
            rough[i, 0], rough[i, 1], rough[i, 2] = weight * x, weight * y, weight * z
            total += weight * (x * x + y * y + z * z)
        sums[chunk] = total


@parallel_kernel
def roughness_gradient(starts, columns, entries, rough, factor, gradient):
    """``factor * (rough - transpose @ rough)``: the gradient of the sum that ``weighted_roughness`` gives.

    Args:
        starts, columns, entries: the transpose of the mean over neighbours.
        rough: [N, 3], as ``weighted_roughness`` gives it.
        factor: twice the gradient of that sum.
        gradient: output [N, 3].
    """
    count = rough.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        for i in range(np.uint64(chunk * step), np.uint64(min(count, (chunk + 1) * step))):
            x, y, z = _difference(starts, columns, entries, rough, i)
            gradient[i, 0], gradient[i, 1], gradient[i, 2] = factor * x, factor * y, factor * z
