"""The regularisers of the objective, each weighted by body part (paper, Section 3.6, after ExAvatar).

What is regularised is what is rendered. ExAvatar also renders and regularises the avatar without its
pose-dependent part; the paper's Equation 9 does not, and neither does this. The terms on joint offsets
have no place here: the identity is the fit's, and training leaves it alone.
"""

from __future__ import annotations

import dataclasses

import scipy.spatial
import torch
from torch import Tensor

from pipeline.avatar import Canonical, Decoded, Posed, Surface
from pipeline.avatar.canonical import HANDS
from pipeline.avatar.sparse import SparsePair
from pipeline.device import moved
from stages.train import losses
from stages.train.settings import TrainSettings

Terms = dict[str, Tensor]
ARMS = ("left_arm", "right_arm")
STEEP = 0.5  # cosine of 60 degrees: steeper normals count as above or below an arm
NEAREST, STRIP = 50, 0.01  # of the upper side's vertices, at most so many within so many metres along X


@dataclasses.dataclass(frozen=True)
class PartWeights:
    """One level's weights, [N, 1] each where not said otherwise.

    Attributes:
        offset, laplacian_offset, laplacian_scale, laplacian_color, scale_size: of the terms so named.
        hands: [N] bool.
        undersides: the arms' lower sides; None where it is not asked for or there is none.
    """

    offset: Tensor
    laplacian_offset: Tensor
    laplacian_scale: Tensor
    laplacian_color: Tensor
    scale_size: Tensor
    hands: Tensor
    undersides: Undersides | None


@dataclasses.dataclass(frozen=True)
class Undersides:
    """The lower sides of the arms, which frontal views never show, and the upper sides above them.

    Attributes:
        rows: [M] int64, vertices below.
        above: [M, N], the mean over the vertices above each.
    """

    rows: Tensor
    above: SparsePair


class Regularisers:
    """The weighted terms; weights are computed once for each surface, until another takes its place."""

    def __init__(self, settings: TrainSettings):
        self.settings = settings
        self._last: tuple[Surface, PartWeights] | None = None

    def static(self, decoded: Decoded) -> Terms:
        """The terms that do not depend on the pose."""
        settings, weights, offset = self.settings, self._of(decoded.surface), decoded.offset
        terms = {
            "laplacian_offset": losses.laplacian(
                offset, decoded.surface.neighbours, weights.laplacian_offset
            ),
            "offset": losses.l2(offset, weights.offset),
        }
        if settings.hand_normal and bool(weights.hands.any()):
            normals = decoded.surface.canonical.frames[weights.hands, :, 2]
            outward = losses.outward_offset(offset[weights.hands], normals)
            terms["hand_normal"] = settings.hand_normal * outward
        return terms

    def posed(self, decoded: Decoded, posed: Posed) -> Terms:
        """The terms of one posed frame."""
        settings, weights = self.settings, self._of(decoded.surface)
        neighbours, colors = decoded.surface.neighbours, posed.gaussians.colors
        same = 1.0 if posed.rows is None else unmixed(posed.rows, neighbours, len(colors))
        terms = {
            "laplacian_scale": losses.laplacian(posed.log_scale, neighbours, same * weights.laplacian_scale),
            "laplacian_color": losses.laplacian(colors, neighbours, same * weights.laplacian_color),
            **self._scale_terms(posed, weights),
            **self._color_terms(colors, weights),
        }
        if posed.pose_offset is not None:
            moved = decoded.offset + posed.pose_offset
            weight = same * weights.laplacian_offset
            terms["laplacian_pose_offset"] = losses.laplacian(moved, neighbours, weight)
            terms["pose_offset"] = settings.pose_offset * losses.l2(posed.pose_offset)
        if posed.color_residual is not None:
            terms["residual_size"] = settings.residual_size * losses.l2(posed.color_residual)
        return terms

    def _scale_terms(self, posed: Posed, weights: PartWeights) -> Terms:
        settings, terms = self.settings, {}
        if settings.scale_size or settings.scale_size_hands:
            terms["scale_size"] = losses.l2(posed.gaussians.scales, weights.scale_size)
        if settings.scale_growth:
            terms["scale_growth"] = settings.scale_growth * losses.scale_growth(posed.log_scale)
        return terms

    def _color_terms(self, colors: Tensor, weights: PartWeights) -> Terms:
        settings, terms = self.settings, {}
        if settings.hand_color and bool(weights.hands.any()):
            terms["hand_color"] = settings.hand_color * losses.color_variance(colors[weights.hands])
        if weights.undersides is not None:
            below, above = colors[weights.undersides.rows], weights.undersides.above @ colors.detach()
            terms["arm_color"] = settings.arm_color * losses.l2(below - above)
        return terms

    def _of(self, surface: Surface) -> PartWeights:
        if self._last is None or self._last[0] is not surface:
            self._last = surface, part_weights(surface.canonical, self.settings)
        return self._last[1]


def unmixed(rows: Tensor, neighbours: SparsePair, count: int) -> Tensor:
    """The weight of smoothness terms: 1 where a vertex and all its neighbours are of one kind, else 0.

    The pose heads are asked for some vertices only. At the border of these, what is posed lies beside what
    is not, and a difference between the two says nothing of how smooth either is.

    Args:
        rows: [M] int64, the vertices asked for.
        neighbours: [N, N], the mean over each vertex's neighbours.
        count: N.

    Returns:
        [N, 1] float32.
    """
    inside = torch.zeros(count, 1, device=rows.device).index_fill_(0, rows, 1.0)
    return ((neighbours @ inside - inside).abs() < 1e-3).float()


def part_weights(canonical: Canonical, settings: TrainSettings) -> PartWeights:
    """Each term's weight at each vertex."""
    hands, face = canonical.is_part(*HANDS), canonical.is_part("face")

    def weight(rest: float, of_hands: float | None = None, of_face: float | None = None) -> Tensor:
        values = torch.full((len(canonical), 1), rest, device=hands.device)
        values[hands] = rest if of_hands is None else of_hands
        values[face] = rest if of_face is None else of_face
        return values

    return PartWeights(
        offset=weight(settings.offset, settings.offset_hands, settings.offset_face),
        laplacian_offset=weight(settings.laplacian_offset, None, settings.laplacian_offset_face),
        laplacian_scale=weight(settings.laplacian_scale, None, settings.laplacian_scale_face),
        laplacian_color=weight(settings.laplacian_color, settings.laplacian_color_hands),
        scale_size=weight(settings.scale_size, settings.scale_size_hands),
        hands=hands,
        undersides=undersides(canonical) if settings.arm_color else None,
    )


def undersides(canonical: Canonical) -> Undersides | None:
    """Pairs each arm's lower side with the upper side at the same place along the arm.

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
