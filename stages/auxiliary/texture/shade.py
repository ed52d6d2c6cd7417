"""How bright the light makes each vertex, told from the seen side, so that the unseen side is not lit as it.

The lamp of a frontal clip stands in front. What is seen is the brighter side, and a back that takes the
colours of the front is too bright. Log brightness is fitted as ``c_part + b . n`` over the known vertices,
n being the normal in the world, robustly, since materials differ within a part too; ``b . n`` is then known
for every vertex, and is held to the range that was seen, for nothing says how dark it gets beyond.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix

DARKEST = 4.0  # of 255: logarithms below say nothing
ROUNDS = 10  # of reweighting
SOFT = 0.15  # of log brightness, where an error begins to count linearly
RANGE = (2.0, 98.0)  # percentiles of what was seen, to which shading is held
LEAST = 200  # known vertices, under which there is nothing to fit
RIDGE = 1e-3  # of the summed weight, on the slope


def shading(color: np.ndarray, weight: np.ndarray, normal: np.ndarray, part: np.ndarray) -> np.ndarray:
    """The logarithm of each vertex's shading: [N] float64.

    Args:
        color: [N, 3], RGB in 0 to 255.
        weight: [N], 0 where the colour is not known.
        normal: [N, 3], mean normals in the world; short where the body turned.
        part: [N] int, each with a brightness of its own.
    """
    known = np.flatnonzero((weight > 0) & (color.mean(1) > DARKEST))
    if len(known) < LEAST:
        return np.zeros(len(color))
    brightness = np.log(color[known].mean(1))
    share, groups = np.minimum(weight[known], np.median(weight[known])), part[known]
    slope, level = np.zeros(3), np.zeros(int(part.max()) + 1)
    robust = np.ones(len(known))
    for _ in range(ROUNDS):
        heft = share * robust
        total = np.maximum(_sums(groups, heft, len(level)), 1e-12)
        # Parts' levels are taken out first: what is left is a fit of three numbers.
        centred = (
            normal[known]
            - (_sums(groups, heft[:, None] * normal[known], len(level)) / total[:, None])[groups]
        )
        level_now = (_sums(groups, heft * brightness, len(level)) / total)[groups]
        square = (heft[:, None] * centred).T @ centred + RIDGE * heft.sum() * np.eye(3)
        slope = np.linalg.solve(square, (heft[:, None] * centred).T @ (brightness - level_now))
        error = np.abs(brightness - level_now - centred @ slope)
        robust = np.minimum(1, SOFT / np.maximum(error, 1e-9))
    shade = normal @ slope
    return np.clip(shade, *np.percentile(shade[known], RANGE))


def _sums(groups: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums of values [K] or [K, C] by group: [count] or [count, C]."""
    pick = coo_matrix((np.ones(len(groups)), (groups, np.arange(len(groups)))), (count, len(groups)))
    return np.asarray(pick @ values)
