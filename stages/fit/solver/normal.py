"""The Gauss-Newton approximation of the objective's second derivatives.

Only this approximation is made here: the gradient is the objective's own, so what is left out, or weighed
a little differently from the objective, costs steps and not accuracy. Left out are how accelerations
depend on what frames share, and how differently the bones of a landmark carry it from one frame to the
next. Everything is of the sum over the frames, not of their mean.
"""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor

from pipeline.body.joints import BODY_POSE, JAW
from stages.fit.objective import CHEST_DISTANCE, EXPRESSION, Objective
from stages.fit.observations import Directions
from stages.fit.parameters import EYES, HANDS, Parameters
from stages.fit.solver.slopes import Group, Layout, Posed, Slopes, group_of, joint_slopes, pose

_ACCELERATION, _CHANGE = 400.0, 0.1  # second derivatives of the terms of ``Objective._smooth``
_IN_FRONT = 40.0
_MARGIN = 0.2  # radians within a limit where its hinge counts: else steps leap over it to and fro


@dataclasses.dataclass(frozen=True)
class FaceRows:
    """What the step of the face controls needs to know of the face's reprojection.

    Attributes:
        rows: [N], the landmarks.
        slopes: [T, 2N, F + S]; frame, shared: its columns.
        rest: [T, N, 2, 3], how a landmark's rest position moves its weighted pixel.
    """

    rows: Tensor
    slopes: Tensor
    frame: Tensor
    shared: Tensor
    rest: Tensor


@dataclasses.dataclass(frozen=True)
class Normal:
    """Second derivatives over a span of T frames.

    Attributes:
        bands: [3, T, n, n], of a frame's unknowns with its own, the next's and the one after's.
        mixed: [T, n, S], with the shared unknowns.
        shared: [S, S], without priors.
        face: the face's rows, None if no face is seen.
    """

    bands: Tensor
    mixed: Tensor
    shared: Tensor
    face: FaceRows | None


@dataclasses.dataclass(frozen=True)
class Coupling:
    """Weights in time of the whole clip.

    Attributes:
        acceleration: [3, T], of the product of accelerations in frames t and t, t+1, t+2.
        velocity: [T], of a frame's own velocities; ahead: [T], of those with the next frame.
    """

    acceleration: Tensor
    velocity: Tensor
    ahead: Tensor


def coupling_of(times: Tensor) -> Coupling:
    """The weights that ``terms.acceleration`` and ``terms.velocity`` give: [T], in frames."""
    count, gap = len(times), times.diff()
    acceleration, velocity, ahead = torch.zeros(3, count), torch.zeros(count), torch.zeros(count)
    if count > 1:
        ahead[:-1] = 1 / gap
        velocity[:-1] += 1 / gap
        velocity[1:] += 1 / gap
    if count > 2:
        before, after = 1 / gap[:-1], 1 / gap[1:]
        shares = torch.stack([before, -before - after, after]) * 2 / (gap[1:] + gap[:-1])
        for first in range(3):
            for second in range(first, 3):
                rows = slice(first, first + count - 2)
                acceleration[second - first, rows] += shares[first] * shares[second]
    return Coupling(acceleration, velocity, ahead)


def groups_of(objective: Objective) -> list[Group]:
    """The seen landmarks, the face apart: it has many points that few joints move."""
    seen, face = objective.observations.mask.any(0), objective.observations.of("face")
    chosen = [(torch.nonzero(seen & part)[:, 0], bool(part is face)) for part in (face, ~face)]
    return [group_of(objective.model, rows, is_face) for rows, is_face in chosen if len(rows)]


def normal_equations(
    objective: Objective,
    groups: list[Group],
    coupling: Coupling,
    parameters: Parameters,
    layout: Layout,
    robust: bool,
    span: slice,
) -> Normal:
    """The second derivatives of a span of frames, those outside held.

    Args:
        objective: of the whole clip.
        groups: its landmarks.
        coupling: its weights in time.
        parameters: of the span.
        layout: what is solved for.
        robust: as the objective's.
        span: the frames.
    """
    model = objective.model
    posed = pose(model, parameters)
    count = len(posed.joints)
    new = posed.joints.new_zeros
    normal = Normal(
        new(3, count, layout.frame, layout.frame), new(count, layout.frame, layout.shared),
        new(layout.shared, layout.shared), None,
    )  # fmt: skip
    face = None
    for group in groups:
        slopes = Slopes(model, posed, group, layout)
        along, others = _directions(objective, group, slopes, parameters.transl, robust, span)
        rows = [slopes.rows(along)]
        if group.face:
            face = FaceRows(group.rows, rows[0], slopes.frame, slopes.shared, along @ slopes.blended)
        rows += [slopes.rows(direction, pick) for pick, direction in others]
        _add(normal, torch.cat(rows, dim=1), slopes.frame, slopes.shared)
    _add_priors(objective, parameters, layout, normal.bands)
    _add_smoothness(objective, coupling, posed, parameters, layout, span, normal.bands)
    return dataclasses.replace(normal, face=face)


def _add(normal: Normal, rows: Tensor, frame: Tensor, shared: Tensor) -> None:
    """Add the product of rows with themselves."""
    product, own = rows.mT @ rows, len(frame)
    normal.bands[0][:, frame[:, None], frame] += product[:, :own, :own]
    normal.mixed[:, frame[:, None], shared] += product[:, :own, own:]
    normal.shared[shared[:, None], shared] += product[:, own:, own:].sum(0)


def _directions(
    objective: Objective, group: Group, slopes: Slopes, transl: Tensor, robust: bool, span: slice
) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """The weighted directions that a group's terms look along.

    Returns:
        [T, N, 2, 3] of the reprojection, and pairs of differences [M, N] and their directions.
    """
    views = objective.views.rows(span)
    in_camera = views.to_camera(slopes.places + transl[:, None])
    pixels = views.to_pixels(in_camera)
    turn = views.rotation[:, None]
    along = _reprojection(objective, group, in_camera, pixels, robust, span) @ turn
    others: list[tuple[Tensor, Tensor]] = []
    if not group.face:
        place = {int(row): k for k, row in enumerate(group.rows)}
        for bones, _, _ in objective.bones:
            others += [(pick, d @ turn) for pick, d in _bones(bones, place, in_camera, span)]
        others += [
            (pick, d @ turn) for pick, d in _in_front(objective, group, place, in_camera, pixels, span)
        ]
    return along, others


def _reprojection(
    objective: Objective, group: Group, in_camera: Tensor, pixels: Tensor, robust: bool, span: slice
) -> Tensor:
    """The pinhole's derivative, weighted as iteratively reweighted least squares: [T, N, 2, 3].

    The weight is rho'(e) / e. The true curvature along the error is smaller, even negative, but the
    quadratic with this weight lies above the loss, so its steps do not overshoot.
    """
    seen, scale = objective.observations, objective.scale[span]
    error = (pixels - seen.pixels[span][:, group.rows]) * scale
    length = (error.square().sum(-1) + 1).sqrt()
    weight = objective.weight[span][:, group.rows] / 8 / length
    if robust:
        saturation = objective.saturation[group.rows]
        weight = weight * (saturation / (length - 1 + saturation)).square()
    depth = in_camera[..., 2:]
    ahead = depth > 1e-2
    zoom = objective.views.focal[span][:, None] * scale / depth.clamp_min(1e-2) * weight.sqrt()[..., None]
    zoom = zoom * ahead
    slant = -zoom * in_camera[..., :2] / depth.clamp_min(1e-2)
    return torch.cat([torch.diag_embed(zoom), slant[..., None]], dim=-1)


def _bones(
    bones: Directions, place: dict[int, int], in_camera: Tensor, span: slice
) -> list[tuple[Tensor, Tensor]]:
    """1 - cos of the angle to a direction: the two directions across each bone, over its length."""
    ends = [(place.get(int(a)), place.get(int(b))) for a, b in zip(bones.start, bones.end, strict=True)]
    keep = [k for k, (a, b) in enumerate(ends) if a is not None and b is not None]
    if not keep:
        return []
    start, end = (torch.tensor([ends[k][side] for k in keep]) for side in (0, 1))
    pick = torch.zeros(len(keep), in_camera.shape[1]).to(in_camera)
    pick[torch.arange(len(keep)), start] -= 1
    pick[torch.arange(len(keep)), end] += 1
    vector = in_camera[:, end] - in_camera[:, start]
    length = vector.norm(dim=-1, keepdim=True).clamp_min(1e-4)
    unit = vector / length
    axis = torch.zeros_like(unit).scatter(-1, unit.abs().argmin(-1, keepdim=True), 1.0)
    first = torch.nn.functional.normalize(torch.linalg.cross(unit, axis), dim=-1)
    across = torch.stack([first, torch.linalg.cross(unit, first)], dim=-2)
    weight = bones.weight[span][:, keep, None].sqrt() / length
    return [(pick, across * weight[..., None])]


def _in_front(
    objective: Objective, group: Group, place: dict[int, int], in_camera: Tensor, pixels: Tensor, span: slice
) -> list[tuple[Tensor, Tensor]]:
    """Depth of the hands relative to the chest's, where the hinge of ``Objective._in_front`` is open."""
    seen = objective.observations
    left, right = (place.get(int(row)) for row in objective.shoulders)
    hands = torch.nonzero(seen.hands[group.rows])[:, 0]
    if left is None or right is None or len(hands) == 0:
        return []
    margin, at = 5 / objective.scale[span][..., 0], pixels[:, hands]
    over = (at[..., 0] > pixels[:, right, :1] - margin) & (at[..., 0] < pixels[:, left, :1] + margin)
    over &= at[..., 1] > (pixels[:, left, 1:] + pixels[:, right, 1:]) / 2
    over &= seen.mask[span][:, group.rows[hands]]
    depth = in_camera[..., 2]
    over &= depth[:, hands] > (depth[:, left] + depth[:, right])[:, None] / 2 - CHEST_DISTANCE
    if not over.any():
        return []
    pick = torch.zeros(len(hands), in_camera.shape[1]).to(in_camera)
    pick[torch.arange(len(hands)), hands] = 1
    pick[:, [left, right]] -= 0.5
    direction = in_camera.new_tensor([0.0, 0.0, _IN_FRONT**0.5])
    return [(pick, over[..., None, None] * direction)]


def _add_priors(objective: Objective, parameters: Parameters, layout: Layout, bands: Tensor) -> None:
    """The diagonal of ``Objective._init``, as if rotation vectors were what is solved for."""
    count = len(parameters.transl)
    curvature = parameters.transl.new_zeros(count, 55, 3)
    held = slice(BODY_POSE.stop - len(objective.stiffness), BODY_POSE.stop)
    curvature[:, held] += 8 * objective.stiffness[:, None]
    curvature[:, HANDS] += 0.9
    curvature[:, JAW, 1:] += 400
    curvature[:, EYES] += 10
    curvature[:, EYES, 2] += 400
    ranges, vectors = objective.ranges, roma.rotmat_to_rotvec(parameters.matrices)
    angle = ranges.of(vectors)
    outside = (angle < ranges.low + _MARGIN) | (angle > ranges.high - _MARGIN)
    curvature.flatten(1)[:, 3 * ranges.joint + ranges.axis] += 100 * outside.to(curvature)
    weight, turns = objective.settings.lambda_init, layout.turns
    diagonal = bands[0].diagonal(dim1=1, dim2=2)
    diagonal[:, :turns] += weight * curvature[:, layout.joints].flatten(1)
    diagonal[:, turns : turns + layout.expressions] += 2 * EXPRESSION * weight


def _add_smoothness(
    objective: Objective,
    coupling: Coupling,
    posed: Posed,
    parameters: Parameters,
    layout: Layout,
    span: slice,
    bands: Tensor,
) -> None:
    """Accelerations of joints and place, velocities of rotations and expression."""
    smoothness, count, turns = objective.settings.smoothness, len(posed.joints), layout.turns
    place = slice(layout.frame - 3, layout.frame)
    slopes = joint_slopes(objective.model, posed, layout)
    for reach in range(min(3, count)):
        weight = _ACCELERATION * smoothness * coupling.acceleration[reach, span][: count - reach]
        band = bands[reach, : count - reach]
        product = slopes[: count - reach].mT @ slopes[reach:]
        band[:, :turns, :turns] += weight[:, None, None] * product
        band.diagonal(dim1=1, dim2=2)[:, place] += weight[:, None]
    joints = torch.ones(55)
    joints[0], joints[BODY_POSE], joints[JAW], joints[EYES] = 10.0, 3.0, 2.0, 0.5
    weight = smoothness * joints[layout.joints]
    own, ahead = coupling.velocity[span], coupling.ahead[span][: count - 1]
    diagonal = bands[0].diagonal(dim1=1, dim2=2)
    diagonal[:, :turns] += 2 * own[:, None] * weight.repeat_interleave(3)
    expression = slice(turns, turns + layout.expressions)
    diagonal[:, expression] += _CHANGE * smoothness * own[:, None]
    if count > 1:
        next_ones = bands[1, : count - 1]
        next_ones.diagonal(dim1=1, dim2=2)[:, expression] -= _CHANGE * smoothness * ahead[:, None]
        _add_turns(parameters.matrices[:, layout.joints], ahead[:, None] * weight, next_ones)


def _add_turns(matrices: Tensor, weight: Tensor, bands: Tensor) -> None:
    """The mixed derivatives of |R' exp(b) - R exp(a)|^2 / 2: -(tr M - M^T) with M = R^T R'."""
    relative = matrices[:-1].mT @ matrices[1:]
    trace = relative.diagonal(dim1=-2, dim2=-1).sum(-1)
    mixed = relative.mT - trace[..., None, None] * torch.eye(3).to(relative)
    mixed = mixed * weight[..., None, None]
    start = 3 * torch.arange(mixed.shape[1])
    for row in range(3):
        for column in range(3):
            bands[:, start + row, start + column] += mixed[..., row, column]
