"""The face first from the estimator's own points: the default source, which needs no other model.

They are MediaPipe's 3D mesh, or the 68 face points of the 133, which have no depth.

Heads and expressions of single frames (``head_poses``) alternate with the clip's neutral face
(``neutral``), which is learnt from at most 96 frames spread over the clip, so that long clips cost no more;
then every frame is solved once against it. Trusts x and y more than z, and fits how much the
estimator exaggerates depth.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from stages.fit.camera_batch import CameraBatch
from stages.fit.face.head_poses import (
    FaceObservations,
    HeadPoses,
    ObservationQuality,
    linearise,
    solve,
    start,
    start_without_depth,
)
from stages.fit.face.neutral import Modes, smooth_modes, solve_neutral
from stages.fit.face.target import FaceModel, FaceTarget, make_target

_LEARNT_FROM = 96  # frames
_ROUNDS = 4  # of heads, then neutral
_RESTS_WITHIN = 25  # frames in which a face comes to rest more often than not
_SEEN = 0.5  # of the face's points, in a frame that counts
_FIRST_NOISE = 0.02  # of the face's size in pixels, before anything is known
_LEAST_NOISE = 0.3  # pixels
_MISFIT, _BLUR = 0.2, 1.0  # of the face's size, and pixels: a frame that fits no better shows something else
_GAIN = (0.6, 1.6)
_FLAT = {"depth_noise": math.inf, "together": 1.0}  # of points without depth, which stand far apart


def face_from_mesh(model: FaceModel, mesh: Tensor, mask: Tensor, views: CameraBatch) -> FaceTarget | None:
    """Fit a face to the estimator's face meshes, or to points that have no depth.

    Args:
        model: the body's face, F points.
        mesh: [T, F, 3], x, y, z of these points in pixels, z relative and larger farther away; or [T, F, 2].
        mask: [T, F] bool, which of them to trust.

    Returns:
        None where no frame shows enough of a face.
    """
    deep = mesh.shape[-1] == 3
    depth = mesh[..., 2] if deep else torch.zeros_like(mesh[..., 0])
    observed = FaceObservations(mesh[..., :2] - views.centre[:, None], depth, mask.float(), views.focal)
    valid = (observed.mask.mean(1) >= _SEEN) & torch.isfinite(mesh * observed.mask[..., None]).all((1, 2))
    if not valid.any():
        return None
    rows = torch.nonzero(valid)[:, 0]
    chosen = rows[torch.linspace(0, len(rows) - 1, min(len(rows), _LEARNT_FROM)).round().long()]
    neutral, quality = _learn(model, smooth_modes(model), observed.frames(chosen), deep)
    seen = observed.frames(rows)
    noise = quality.noise.median() / _sizes(observed.frames(chosen)).median() * _sizes(seen)
    quality = dataclasses.replace(quality, noise=noise)
    heads = solve(model, neutral, seen, _start(model, seen, deep), quality, steps=4)
    fits = _misfit(model, neutral, seen, heads, quality) < _MISFIT * _sizes(seen) + _BLUR
    if not fits.any():
        return None
    return _handed_on(model, neutral, heads, (rows, fits), views, "mesh" if deep else "points")


def _start(model: FaceModel, observed: FaceObservations, deep: bool) -> HeadPoses:
    return start(model, observed) if deep else start_without_depth(model, observed)


def _learn(
    model: FaceModel, modes: Modes, observed: FaceObservations, deep: bool
) -> tuple[Tensor, ObservationQuality]:
    """The neutral face, and the quality of the observations that it was learnt from."""
    neutral, heads = model.mean, _start(model, observed, deep)
    noise = _FIRST_NOISE * _sizes(observed)
    quality = ObservationQuality(noise) if deep else ObservationQuality(noise, **_FLAT)
    for _ in range(_ROUNDS):
        heads = solve(model, neutral, observed, heads, quality, steps=2)
        if len(observed.mask) >= _RESTS_WITHIN:
            neutral, heads = _at_rest(model, neutral, heads)
        quality = _quality(model, neutral, observed, heads, quality)
        neutral = solve_neutral(model, modes, neutral, observed, heads, quality)
    return neutral, quality


def _at_rest(model: FaceModel, neutral: Tensor, heads: HeadPoses) -> tuple[Tensor, HeadPoses]:
    """The same faces with what psi is at rest moved from psi to the neutral face.

    An expression held throughout and a face of that shape look alike; but a face comes back to rest, and
    there its coefficients lie densest.
    """
    usual = densest_half(heads.expression)
    neutral = neutral + model.expression @ usual
    return neutral, dataclasses.replace(heads, expression=heads.expression - usual)


def densest_half(values: Tensor) -> Tensor:
    """The mean of the shortest interval that holds half of the values of a column: [T, K] -> [K]."""
    ordered = values.sort(dim=0).values
    half = (len(values) + 1) // 2
    begin = (ordered[half - 1 :] - ordered[: len(values) - half + 1]).argmin(0)
    return ordered.gather(0, begin + torch.arange(half)[:, None]).mean(0)


def _quality(
    model: FaceModel,
    neutral: Tensor,
    observed: FaceObservations,
    heads: HeadPoses,
    quality: ObservationQuality,
) -> ObservationQuality:
    """Noise as the median says it, in proportion to the face's size, and the gain of depth."""
    linear = linearise(model, neutral, observed, heads, quality)
    trusted = observed.mask > 0
    off = (linear.residual[..., :2] * quality.noise[:, None, None])[trusted].abs() / 0.6745
    sizes = _sizes(observed)
    relative = (off / sizes[:, None].expand_as(observed.mask)[trusted][:, None]).median()
    noise = (relative * sizes).clamp_min(_LEAST_NOISE)
    if not quality.has_depth:
        return dataclasses.replace(quality, noise=noise)
    posed = (linear.posed @ heads.rotation.mT)[..., 2]
    predicted = posed * (observed.focal[:, :1] / heads.place[:, 2:].clamp_min(0.05))
    weight = linear.weight / sizes[:, None].square()
    mean = [
        (v * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1e-9)
        for v in (predicted, observed.depth)
    ]
    predicted, found = predicted - mean[0], observed.depth - mean[1]
    gain = float((weight * predicted * found).sum() / (weight * predicted.square()).sum().clamp_min(1e-9))
    return dataclasses.replace(quality, noise=noise, gain=min(max(gain, _GAIN[0]), _GAIN[1]))


def _misfit(
    model: FaceModel,
    neutral: Tensor,
    observed: FaceObservations,
    heads: HeadPoses,
    quality: ObservationQuality,
) -> Tensor:
    """The median distance in pixels between seen and predicted points of each frame: [T]."""
    linear = linearise(model, neutral, observed, heads, quality)
    off = (linear.residual[..., :2] * quality.noise[:, None, None]).norm(dim=-1)
    off = torch.where(observed.mask > 0, off, torch.full_like(off, torch.nan))
    return off.nanmedian(dim=1).values


def _sizes(observed: FaceObservations) -> Tensor:
    """The size of each face in pixels, [T]: the spread of its points, depth included."""
    weight = observed.mask[..., None]
    places = torch.cat([observed.pixels, observed.depth[..., None]], dim=-1)
    total = weight.sum(1).clamp_min(1)
    middle = (places * weight).sum(1) / total
    return ((places - middle[:, None]).square() * weight).sum((1, 2)).div(total[:, 0]).sqrt().clamp_min(1.0)


def _handed_on(
    model: FaceModel,
    neutral: Tensor,
    heads: HeadPoses,
    chosen: tuple[Tensor, Tensor],
    views: CameraBatch,
    source: str,
) -> FaceTarget:
    """The frames that were solved, of which some fit, spread over all of the clip's."""
    rows, fits = chosen
    count, fitted = len(views.focal), rows[fits]
    valid = torch.zeros(count, dtype=torch.bool)
    valid[fitted] = True
    expression = neutral.new_zeros(count, model.expression.shape[2])
    expression[fitted] = heads.expression[fits]
    jaw = neutral.new_zeros(count, 3)
    jaw[fitted, 0] = heads.jaw[fits]
    orientation = torch.eye(3).repeat(count, 1, 1)
    orientation[fitted] = views.rotation[fitted].mT @ heads.rotation[fits]
    return make_target(model, neutral, expression, jaw, valid, source, orientation)
