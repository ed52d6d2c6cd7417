"""Colours for what no frame shows: from the body's other side, then from what lies around.

Both steps are membranes over the mesh (Laplace's equation; on an image: Perez et al., Poisson image
editing, 2003). First the difference between a vertex and its mirror image is taken where both are
known, and carried smoothly to where only the mirror image is: what is copied meets what was seen
without a step, though the lamp stood on one side. Then what is left takes a smooth surface through the
colours at its rim.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import cg, splu

from pipeline.texture import FineSurface, VertexColors
from stages.auxiliary.texture.shade import shading

_TOLERANCE, _ITERATIONS = 1e-3, 300
_PULL = 1e-7  # towards the mean, so that a part without any known neighbour has an answer


def complete(surface: FineSurface, seen: VertexColors, light: bool = True) -> np.ndarray:
    """A colour for every vertex: [N, 3] float32 in 0 to 255.

    With ``light`` it is colours without their shading that spread, and each vertex is shaded as its
    normal says (``shade.py``). Nothing spreads from the face or the neck to the scalp, where only hair
    that was seen is a guide.
    """
    if not seen.known.any():
        return np.full((len(surface), 3), 128, np.float32)
    known = seen.known.copy()
    shade = np.ones((len(surface), 1))
    if light:
        shade = np.exp(shading(seen.color, seen.weight * known, seen.normal, surface.part))[:, None]
    color = seen.color / shade
    adjacency = neighbours(surface.edges(), len(surface))
    mirror = surface.mirrored
    copied = ~known & known[mirror]
    if copied.any():
        both = known & known[mirror]
        difference = np.where(both[:, None], color - color[mirror], 0)
        difference = membrane(adjacency, difference, ~copied, np.zeros(3))
        color[copied] = color[mirror[copied]] + difference[copied]
        known |= copied
    mean = np.average(color[known], axis=0)
    body = int(surface.coarse.max()) + 1
    rough = membrane(neighbours(surface.edges(coarse=True), body), color[:body], known[:body], mean)
    start = surface.refine(torch.from_numpy(rough)).numpy()
    return np.clip(shade * membrane(adjacency, color, known, mean, start), 0, 255).astype(np.float32)


def neighbours(edges: np.ndarray, count: int) -> sparse.csr_matrix:
    """[N, N] with 1 for every edge in both directions."""
    rows = np.concatenate([edges[:, 0], edges[:, 1]])
    columns = np.concatenate([edges[:, 1], edges[:, 0]])
    return sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (count, count))


def membrane(
    adjacency: sparse.csr_matrix,  # [N, N]
    values: np.ndarray,  # [N, C]
    fixed: np.ndarray,  # [N] bool
    rest: np.ndarray,  # [C]
    start: np.ndarray | None = None,  # [N, C]
) -> np.ndarray:
    """The smoothest values that keep the fixed ones: each free one is its neighbours' mean.

    Args:
        adjacency: of the graph.
        values: what is fixed; the others are ignored.
        fixed: which.
        rest: what a part of the graph without any fixed value takes.
        start: values that are nearly right, from which the rest is iterated; solved directly if None.
            Iteration alone stops where residuals are small, which on a large hole is long before its
            middle has heard of its rim.

    Returns:
        [N, C] float64.
    """
    free = np.flatnonzero(~fixed)
    result = np.asarray(values, np.float64).copy()
    if not len(free):
        return result
    degree = np.asarray(adjacency.sum(1)).ravel()
    inner = adjacency[free][:, free]
    diagonal = np.maximum(degree[free], 1e-9) + _PULL
    matrix = (sparse.diags(diagonal) - inner).tocsc()
    sides = adjacency[free][:, np.flatnonzero(fixed)] @ result[fixed] + _PULL * rest
    if start is None:
        solver = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        result[free] = solver.solve(sides)
        return result
    scale = sparse.diags(1 / diagonal)
    for channel in range(result.shape[1]):
        known = {"x0": start[free, channel], "M": scale, "rtol": _TOLERANCE, "maxiter": _ITERATIONS}
        result[free, channel] = cg(matrix, sides[:, channel], **known)[0]
    return result
