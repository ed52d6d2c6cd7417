"""The ``texture`` generator: the clip's own colours, completed, on the body as it turns; no network.

Colours for what no frame shows come from the body's other side, then from what lies around.
Both steps are membranes over the mesh (Laplace's equation; on an image: Perez et al., Poisson image
editing, 2003). First the difference between a vertex and its mirror image is taken where both are
known, and carried smoothly to where only the mirror image is: what is copied meets what was seen
without a step, though the lamp stood on one side. Then what is left takes a smooth surface through the
colours at its rim.

The unseen side is not lit as the seen one: the lamp of a frontal clip stands in front. So log brightness is
fitted as ``c_part + b . n`` over the known vertices, n being the normal in the world, robustly, since
materials differ within a part too; ``b . n`` is then known for every vertex, and is held to the range that
was seen, for nothing says how dark it gets beyond.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import cg, splu

from pipeline.body import posed_vertices
from pipeline.clip.fitted_clip import FittedClip
from pipeline.texture import FineSurface, VertexColors, paint
from stages.auxiliary.generator_output import GeneratedPicture, GeneratorOutput
from stages.auxiliary.turntable_motion import TurntableMotion

DARKEST = 4.0  # of 255: logarithms below say nothing
ROUNDS = 10  # of reweighting
SOFT = 0.15  # of log brightness, where an error begins to count linearly
RANGE = (2.0, 98.0)  # percentiles of what was seen, to which shading is held
LEAST = 200  # known vertices, under which there is nothing to fit
RIDGE = 1e-3  # of the summed weight, on the slope
_TOLERANCE, _ITERATIONS = 1e-3, 300
_PULL = 1e-7  # towards the mean, so that a part without any known neighbour has an answer


def painted(
    clip: FittedClip, turn: TurntableMotion, surface: FineSurface, colors: np.ndarray
) -> GeneratorOutput:
    """The ``texture`` generator: the textured body through the turn."""

    def pictures() -> Iterator[GeneratedPicture]:
        for frame in turn.poses.frames:
            vertices = posed_vertices(clip.body, clip.identity, turn.poses.pose(frame))
            image, mask, _ = paint(turn.camera, surface, vertices, colors)
            yield GeneratedPicture(frame, image, mask)

    return GeneratorOutput(turn.poses, dict.fromkeys(turn.poses.frames, turn.camera), pictures(), exact=True)


def complete(surface: FineSurface, seen: VertexColors, light: bool = True) -> np.ndarray:
    """A colour for every vertex: [N, 3] float32 in 0 to 255.

    With ``light`` it is colours without their shading that spread, and each vertex is shaded as its
    normal says (``shading``). Nothing spreads from the face or the neck to the scalp, where only hair
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
    pick = sparse.coo_matrix((np.ones(len(groups)), (groups, np.arange(len(groups)))), (count, len(groups)))
    return np.asarray(pick @ values)
