"""Shape and expression directions, and the regressor from vertices to joints."""

from __future__ import annotations

import dataclasses
import re

import numpy as np

from open_body.makehuman import MacroTargets, Phenotype
from open_body.skeleton import JOINTS, PARENTS, TPoser


@dataclasses.dataclass(frozen=True)
class Samples:
    """Random adults in T pose with the pelvis at the origin.

    Attributes:
        vertices: [N, V, 3] float64, metres.
        joints: [N, 55, 3] float64.
    """

    vertices: np.ndarray
    joints: np.ndarray


def draw_samples(targets: MacroTargets, t_pose: TPoser, count: int, rng: np.random.Generator) -> Samples:
    """Pose random persons.

    MakeHuman's height slider spans 1.2 to 2.4 m, so it is drawn about 0.41, which gives real adults.
    """
    vertices, joints = [], []
    for _ in range(count):
        gender, age = rng.beta(0.5, 0.5), rng.beta(1, 2.5)
        muscle, weight, proportions = np.clip(rng.normal(0.5, 0.22, 3), 0, 1)
        height = np.clip(rng.normal(0.41, 0.085), 0.15, 0.7)
        african, asian, caucasian = rng.dirichlet([0.7] * 3)
        person = Phenotype(gender, age, muscle, weight, height, proportions, (african, asian, caucasian))
        posed, rest = t_pose(targets.person(person))
        vertices.append(posed - rest[0])
        joints.append(rest - rest[0])
    return Samples(np.stack(vertices), np.stack(joints))


def shape_directions(samples: Samples, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Principal components of the sampled bodies, scaled so that betas have unit variance.

    Their signs are chosen so that a positive beta makes the body taller.

    Returns:
        mean [V, 3] and directions [V, 3, count], metres a unit of beta.
    """
    number = len(samples.vertices)
    mean = samples.vertices.mean(0)
    centred = (samples.vertices - mean).reshape(number, -1)
    _, singular, components = np.linalg.svd(centred, full_matrices=False)
    scaled = components[:count] * (singular[:count, None] / np.sqrt(number))
    directions = scaled.reshape(count, *mean.shape)
    top, bottom = mean[:, 1].argmax(), mean[:, 1].argmin()
    signs = np.where(directions[:, top, 1] < directions[:, bottom, 1], -1, 1)
    return mean, (directions * signs[:, None, None]).transpose(1, 2, 0)


def expression_directions(units: dict[str, np.ndarray]) -> tuple[list[str], np.ndarray]:
    """The face units, symmetric ones first, so that no direction mixes left and right.

    A unit that comes as a left and a right one gives two directions: both sides together, and left
    without right. A coefficient of 3 is a unit's full range, so that unit variance is about what faces
    do.

    Args:
        units: name -> [V, 3] displacements at full range, metres.

    Returns:
        names of the K directions, and the directions [V, 3, K].
    """
    together: dict[str, np.ndarray] = {}
    apart: dict[str, np.ndarray] = {}
    for name, displacement in units.items():
        stem = re.sub("(Left|Right)$", "", name)
        sign = -1 if name.endswith("Right") else 1
        together[stem] = together.get(stem, 0) + displacement
        if stem != name:
            apart[f"{stem}LeftMinusRight"] = apart.get(f"{stem}LeftMinusRight", 0) + sign * displacement
    ordered = _strongest_first(together) | _strongest_first(apart)
    return list(ordered), np.stack(list(ordered.values()), axis=2).astype(np.float64) / 3


def _strongest_first(named: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return dict(sorted(named.items(), key=lambda item: -float(np.square(item[1]).sum())))


def joint_regressor(
    samples: Samples,
    mean: np.ndarray,  # [V, 3]
    weights: np.ndarray,  # [V, 55]
    expressions: np.ndarray,  # [V, 3, K]
    rng: np.random.Generator,
) -> np.ndarray:
    """Sparse rows, each summing to 1, that give the joints of any shape and move with no expression.

    Each row is a ridge regression towards equal weights under the constraint on the sum. Rows are
    not convex: a convex fit left 34 mm at the knee.

    Returns:
        [55, V] float64.
    """
    chosen = rng.choice(len(samples.vertices), min(150, len(samples.vertices)), replace=False)
    vertices, joints = samples.vertices[chosen], samples.joints[chosen]
    regressor = np.zeros((len(JOINTS), len(mean)))
    for joint in range(len(JOINTS)):
        support = _support(joint, mean, weights, samples.joints[:, joint].mean(0))
        seen = vertices[:, support].transpose(0, 2, 1).reshape(-1, len(support))
        still = 0.3 * expressions[support].transpose(2, 1, 0).reshape(-1, len(support))
        wanted = np.concatenate([joints[:, joint].ravel(), np.zeros(len(still))])
        regressor[joint, support] = _constrained_ridge(np.concatenate([seen, still]), wanted, 2e-3)
    return regressor


def _support(joint: int, mean: np.ndarray, weights: np.ndarray, position: np.ndarray) -> np.ndarray:
    """At most 220 vertices that the joint or its neighbours in the tree move.

    The 60 nearest, then the farthest from those already taken, so that the joint lies well among
    them on every shape.
    """
    near = [joint, *(k for k, parent in enumerate(PARENTS) if parent == joint)]
    near += [PARENTS[joint]] if PARENTS[joint] >= 0 else []
    relevant = weights[:, joint] > 0.99 if "eye" in JOINTS[joint] else weights[:, near].sum(1) > 0.02
    candidates = np.flatnonzero(relevant)
    by_distance = np.argsort(np.linalg.norm(mean[candidates] - position, axis=1), kind="stable")
    candidates = candidates[by_distance[:1200]]
    if len(candidates) <= 220:
        return candidates
    points = mean[candidates]
    taken = list(range(60))
    distance = np.linalg.norm(points[:, None] - points[None, :60], axis=2).min(1)
    while len(taken) < 220:
        taken.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[taken[-1]], axis=1))
    return candidates[taken]


def _constrained_ridge(matrix: np.ndarray, wanted: np.ndarray, strength: float) -> np.ndarray:
    """Find argmin |A x - b|^2 + strength |x - 1/n|^2 under sum(x) = 1, by eliminating the constraint."""
    count = matrix.shape[1]
    start = np.full(count, 1 / count)
    free = np.eye(count)[:, 1:]
    free[0] = -1
    normal = free.T @ (matrix.T @ matrix + strength * np.eye(count)) @ free
    return start + free @ np.linalg.solve(normal, free.T @ (matrix.T @ (wanted - matrix @ start)))
