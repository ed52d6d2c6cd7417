"""Body regions that regularisers weigh apart: hands, face, scalp, undersides of arms (Section 3.6, D).

What is regularised is what is rendered. ExAvatar also renders and regularises the avatar without its
pose-dependent part; the paper's Equation 9 does not, and neither does this. The terms on joint offsets
have no place here: the identity is the fit's, and training leaves it alone. The terms themselves stand in
the table in ``objective.py``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import scipy.spatial
import torch
from torch import Tensor

from pipeline.avatar import Canonical
from pipeline.avatar.canonical import HANDS
from pipeline.avatar.sparse import SparsePair
from pipeline.device import moved

ARMS = ("left_arm", "right_arm")
STEEP = 0.5  # cosine of 60 degrees: steeper normals count as above or below an arm
NEAREST, STRIP = 50, 0.01  # of the upper side's vertices, at most so many within so many metres along X

PartWeights = tuple[float, float, float, float]
"""A term's weights on the hands, on the face, on the rest of the head, and elsewhere."""


@dataclasses.dataclass(frozen=True)
class Regions:
    """The regions of one level's mesh that the regularisers tell apart.

    Attributes:
        hands: [N] bool; None where the level has no hands.
        undersides: the arms' lower sides; None where no term asks for them or there are none.
        weights: [N, 1], for each term that is weighted by body part.
    """

    hands: Tensor | None  # [N]
    undersides: Undersides | None
    weights: Mapping[str, Tensor]  # [N, 1] each

    def on_hands(self, values: Tensor) -> Tensor | None:
        """The values of the hands' vertices, [N, C] -> [M, C]; None without hands."""
        return None if self.hands is None else values[self.hands]


@dataclasses.dataclass(frozen=True)
class Undersides:
    """The lower sides of the arms, which frontal views never show, and the upper sides above them.

    Attributes:
        rows: [M] int64, vertices below.
        above: [M, N], the mean over the vertices above each.
    """

    rows: Tensor  # [M]
    above: SparsePair  # [M, N]


def find_regions(canonical: Canonical, weights: Mapping[str, PartWeights], arms: bool) -> Regions:
    """The regions of a mesh.

    Args:
        canonical: the mesh, N vertices.
        weights: by the name of the term.
        arms: the arms' lower sides are asked for.
    """
    hands = canonical.is_part(*HANDS)
    return Regions(
        hands=hands if bool(hands.any()) else None,
        undersides=find_undersides(canonical) if arms else None,
        weights={name: weight_by_part(canonical, *values) for name, values in weights.items()},
    )


def weighted_by(regions: Regions, factors: Mapping[str, Tensor]) -> Regions:
    """The regions with the weights of some terms multiplied by a factor for each vertex, [N, 1]."""
    changed = {name: regions.weights[name] * factor for name, factor in factors.items()}
    return dataclasses.replace(regions, weights={**regions.weights, **changed})


def weight_by_part(canonical: Canonical, hands: float, face: float, scalp: float, elsewhere: float) -> Tensor:
    """A weight for each vertex by its body part, [N, 1]; the scalp is the head without the face."""
    values = torch.full((len(canonical), 1), elsewhere, device=canonical.vertices.device)
    values[canonical.is_part(*HANDS)] = hands
    values[canonical.is_part("face")] = face
    values[canonical.is_part("head")] = scalp
    return values


def unmixed(
    rows: Tensor,  # [M] int64
    neighbours: SparsePair,  # [N, N]
    count: int,
) -> Tensor:
    """The weight of smoothness terms, [N, 1]: 1 where a vertex and its neighbours are of one kind, else 0.

    The pose heads are asked for some vertices only. At the border of these, what is posed lies beside what
    is not, and a difference between the two says nothing of how smooth either is.

    Args:
        rows: the vertices asked for.
        neighbours: the mean over each vertex's neighbours.
        count: N.
    """
    inside = torch.zeros(count, 1, device=rows.device).index_fill_(0, rows, 1.0)
    return ((neighbours @ inside - inside).abs() < 1e-3).float()


def find_undersides(canonical: Canonical) -> Undersides | None:
    """Pairs of each arm's lower side with the upper side at the same place along the arm, or None.

    In the rest pose the arms lie along X, so a slice of an arm is a range of X.
    """
    up, along = canonical.frames[:, 1, 2].cpu(), canonical.vertices[:, :1].cpu().numpy()
    rows, columns, start = [], [], []
    for arm in ARMS:
        inside = canonical.is_part(arm).cpu()
        above, below = (torch.nonzero(inside & side)[:, 0] for side in (up > STEEP, up < -STEEP))
        if not len(above):
            continue
        tree = scipy.spatial.cKDTree(along[above])
        count = min(NEAREST, len(above))
        _, nearest = tree.query(along[below], count, distance_upper_bound=STRIP)
        found = torch.from_numpy(nearest.reshape(len(below), count)).long()
        there = found < len(above)  # the tree's mark for none is its size
        paired = there.any(1)
        start.append(below[paired])
        place = torch.arange(int(paired.sum()))[:, None].expand(-1, count)[there[paired]]
        rows.append(place + sum(len(one) for one in start[:-1]))
        columns.append(above[found[paired][there[paired]]])
    if not start or not sum(len(one) for one in start):
        return None
    lower, row, column = torch.cat(start), torch.cat(rows), torch.cat(columns)
    share = 1.0 / torch.bincount(row, minlength=len(lower))[row].float()
    pairs = Undersides(lower, SparsePair.build(row, column, share, (len(lower), len(canonical))))
    return moved(pairs, canonical.vertices.device)
