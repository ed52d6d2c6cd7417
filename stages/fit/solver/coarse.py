"""Easier versions of an objective: fewer frames, and errors that count in proportion to their square."""

from __future__ import annotations

import copy
import dataclasses

from torch import Tensor

from stages.fit.objective import Objective
from stages.fit.observations import Directions
from stages.fit.parameters import PER_FRAME
from stages.fit.views import Views


def softened(objective: Objective, sigma: float) -> Objective:
    """The same objective with sigma pixels as the unit of reprojection error.

    The keypoints' loss sqrt(e^2 + 1) - 1 is a parabola up to about a unit and a cone beyond, where a
    second-order method has no curvature to go by. A wide unit at first makes it find the way; it is
    narrowed to a pixel as the fit improves (graduated non-convexity).
    """
    soft = copy.copy(objective)
    soft.scale = objective.scale / sigma
    soft.weight = objective.weight * sigma
    soft.saturation = objective.saturation / sigma
    return soft


def thinned(objective: Objective, rows: Tensor) -> Objective:
    """The objective of some frames of its clip: [K] indices, increasing."""

    def cut(directions: Directions) -> Directions:
        return dataclasses.replace(directions, unit=directions.unit[rows], weight=directions.weight[rows])

    thin, seen = copy.copy(objective), objective.observations
    thin.observations = dataclasses.replace(
        seen, frames=seen.frames[rows], pixels=seen.pixels[rows], mask=seen.mask[rows],
        limbs=cut(seen.limbs), hand_bones=cut(seen.hand_bones),
    )  # fmt: skip
    thin.bones = [(cut(bones), start, end) for bones, start, end in objective.bones]
    views = objective.views
    thin.views = Views(*(getattr(views, field.name)[rows] for field in dataclasses.fields(views)))
    initial = {name: getattr(objective.initial, name)[rows] for name in PER_FRAME}
    thin.initial = dataclasses.replace(objective.initial, **initial)
    thin.start, thin.times = objective.start[rows], objective.times[rows]
    thin.weight, thin.scale = objective.weight[rows], objective.scale[rows]
    return thin
