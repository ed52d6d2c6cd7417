"""Membranes over a graph: values that meet what is known at a rim and are smooth inside it."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import cg

TOLERANCE, ITERATIONS = 1e-7, 1000


def neighbours(edges: np.ndarray, count: int) -> sparse.csr_matrix:
    """[N, N] with 1 for every edge in both directions: edges [E, 2], each once."""
    rows = np.concatenate([edges[:, 0], edges[:, 1]])
    columns = np.concatenate([edges[:, 1], edges[:, 0]])
    return sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (count, count))


def screened_membrane(
    adjacency: sparse.csr_matrix,  # [N, N]
    values: np.ndarray,  # [N, C]
    hold: np.ndarray,  # [N]
    sink: np.ndarray,  # [N]
) -> np.ndarray:
    """The values that are smooth, near what is held, and fade to zero away from it: [N, C] float64.

    They minimise ``sum over edges (x_i - x_j)^2 + sum hold_i (x_i - values_i)^2 + sum sink_i x_i^2``
    (Laplace's equation with a screen).

    Args:
        adjacency: of the graph.
        values: what is held.
        hold: at least 0, how firmly each is held.
        sink: above 0, how strongly each is drawn to zero.
    """
    degree = np.asarray(adjacency.sum(1)).ravel()
    diagonal = degree + hold + sink
    matrix, scale = sparse.diags(diagonal) - adjacency, sparse.diags(1 / diagonal)
    result = np.empty(values.shape, np.float64)
    for channel in range(values.shape[1]):
        side = hold * values[:, channel]
        start = side / diagonal
        result[:, channel] = cg(matrix, side, x0=start, M=scale, rtol=TOLERANCE, maxiter=ITERATIONS)[0]
    return result
