"""The clip's own neutral face, from all of its frames at once, near the mean face where they say little.

A person's face is the mean face plus an offset that is smooth over the skin: a Gaussian process whose
offsets are 4 mm large and agree over 25 mm. A clip of a few noisy frames thus stays near the mean, and
many frames, or a head that turns, show more.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from stages.fit.face.head_poses import (
    CHUNK,
    FaceObservations,
    HeadPoses,
    ObservationQuality,
    linearise,
    rigidity,
)
from stages.fit.face.target import FaceModel, aligned

_SIZE, _REACH = 0.004, 0.025  # metres
_MODES = 64  # of the process, by size; what they leave out is under a hundredth of its variance


@dataclasses.dataclass(frozen=True)
class Modes:
    """A smooth offset as a few coefficients.

    Attributes:
        shape: [F, K], one mode a column, orthonormal.
        variance: [K], of its coefficient, square metres.
    """

    shape: Tensor
    variance: Tensor


def smooth_modes(model: FaceModel) -> Modes:
    """The largest modes of the Gaussian process over the face's points."""
    away = torch.cdist(model.mean.double(), model.mean.double())
    variance, shape = torch.linalg.eigh(_SIZE**2 * torch.exp(-away.square() / (2 * _REACH**2)))
    count = min(_MODES, len(variance))
    return Modes(shape[:, -count:].float(), variance[-count:].clamp_min(1e-12).float())


def solve_neutral(
    model: FaceModel,
    modes: Modes,
    neutral: Tensor,
    observed: FaceObservations,
    heads: HeadPoses,
    quality: ObservationQuality,
) -> Tensor:
    """The most probable neutral face, given heads, jaws and expressions: [F, 3] -> [F, 3], metres.

    The result is turned, moved and scaled onto the mean face: a turn, shift or size of the neutral
    face is one of the heads as well.

    Args:
        model: the face; modes: its smooth offsets.
        observed, heads, quality: T frames, as in ``head_poses.solve``.
    """
    count = len(model.mean)
    normal, right = neutral.new_zeros(count, 3, 3), neutral.new_zeros(count, 3)
    for begin in range(0, len(observed.mask), CHUNK):
        rows = slice(begin, begin + CHUNK)
        part = HeadPoses(*(getattr(heads, f.name)[rows] for f in dataclasses.fields(HeadPoses)))
        linear = linearise(model, neutral, observed.frames(rows), part, quality.frames(rows))
        jacobian = linear.camera @ linear.blend
        weighted = jacobian.mT * (quality.together * linear.weight)[..., None, None]
        normal += (weighted @ jacobian).sum(0)
        right += (weighted @ linear.residual[..., None])[..., 0].sum(0)
    offset = neutral - model.mean
    right = right + (normal @ offset[..., None])[..., 0]
    size = modes.shape.shape[1]
    matrix = torch.einsum("fk,fab,fl->kalb", modes.shape, normal, modes.shape).double()
    matrix = matrix.reshape(3 * size, 3 * size)
    matrix += torch.diag((1 / modes.variance.double()).repeat_interleave(3))
    coefficients = torch.linalg.solve(matrix, (modes.shape.mT @ right).double().reshape(-1))
    smooth = model.mean + modes.shape @ coefficients.reshape(size, 3).float()
    return aligned(smooth, model.mean, rigidity(model))
