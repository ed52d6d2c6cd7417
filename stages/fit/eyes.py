"""Lids and gaze, from the eyes' own points, once the body is fitted.

Among 553 points and hundreds of steps of Adam that spread in time, a blink of four frames is lost. So what
the lids' points and the irises say is solved for on its own, frame by frame, with the head where the fit
has it:

- **lids**: the gap between the lids in the picture, over the gap that the model at rest shows in the same
  frame. Two levels of the clip take out what detector and model mean differently by a lid: the level of open
  eyes, which most frames have, and that of shut ones, where a detector still reads a thin gap.
- **gaze**: the place of each iris in its socket. A shut eye says nothing; its gaze is taken
  from the frames around.

Both eyes blink and look together, unless their points say clearly that they do not. Small changes are
averaged over three frames, large ones are left as they are: a blink or a jump of the gaze is no noise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body.eyes import CORNERS, IRISES, LOWER_LIDS, SOCKETS, UPPER_LIDS
from stages.fit import terms
from stages.fit.camera_batch import CameraBatch
from stages.fit.observations import Observations
from stages.fit.parameters import EYES, LandmarkModel, Parameters

_MESH = 478  # points of the face mesh, which alone has irises
_OPEN_QUANTILE = 0.6  # of the gaps of a clip: its level of open eyes
_SHUT_GAP, _SHUT_QUANTILE = 0.09, 0.02  # of the eye's width, that a detector reads of a shut eye at most
_GAIN = (0.6, 1.8)  # of open eyes' gaps over those of the model at rest
_MOST = 1.15  # of shutting: lids that press on each other
_LID_NOISE, _LIDS_DIFFER = 0.08, 0.1  # shares of the opening
_WINK = 0.3  # share of the opening by which lids differ where they no longer hold each other
_LEAST_WIDTH = 3.0  # pixels of an eye that says anything
_SIDEWAYS = (0.15, 0.45)  # cosine between an eye's outward direction and the view: sees nothing, sees well
_LOOKS = (0.3, 1.0)  # share of the opening from which an iris is seen at all, and well
_GAZE_NOISE = 0.06  # of the eye's width
_GAZE, _GAZE_LIMIT = 0.35, 0.7  # radians
_EYES_DIFFER = (0.03, 0.06)  # radians, up and aside
_STEPS = 4  # of Gauss-Newton
_SMALL = {"lids": (0.15, 0.3), "gaze": (0.06, 0.14)}  # changes that are averaged, and that are left alone
_STEP = 0.05  # radians, of the numerical derivative


@dataclasses.dataclass(frozen=True)
class FittedEyes:
    """Lids and gaze of T frames.

    Attributes:
        lids: [T, E], psi of the lids alone; the rest of psi is zero.
        lid_columns: [E] bool, the columns of psi that are the lids'; none where the lids were not fitted.
        gaze: [T, 2, 3], rotation vectors of the eyes, or None where the gaze was not fitted.
    """

    lids: Tensor
    lid_columns: Tensor
    gaze: Tensor | None

    def applied(self, expression: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """Expression [T, E] and rotation vectors [T, 55, 3] with these eyes in place of theirs."""
        expression = torch.where(self.lid_columns, self.lids.to(expression), expression)
        if self.gaze is not None:
            rotation = rotation.clone()
            rotation[:, EYES] = self.gaze.to(rotation)
        return expression, rotation


@dataclasses.dataclass(frozen=True)
class _Eyes:
    """Where the eyes' points are in the picture, T frames, left eye first.

    Attributes:
        gap: [T, 2, 2], pixels, from the lower lid to the upper.
        width: [T, 2, 2], pixels, from corner to corner.
        iris: [T, 2, 2], pixels, of its middle.
        socket: [T, 2, 17, 2], pixels, of the points around it that stay.
    """

    gap: Tensor
    width: Tensor
    iris: Tensor
    socket: Tensor


def fit_eyes(
    model: LandmarkModel,
    observations: Observations,
    views: CameraBatch,
    fitted: Parameters,
    matrices: Tensor,  # [T, 55, 3, 3]
    shut: Tensor,  # [2, E]
    weights: tuple[float, float],
) -> FittedEyes | None:
    """The eyes of a fitted clip.

    Args:
        model, observations, views: as the registration used them.
        fitted, matrices: what it found.
        shut: psi that shuts the left and the right eye of the body; zero where it has none.
        weights: of what was seen against the priors, for lids and gaze; 0 leaves either as it is.

    Returns:
        None where the points hold no face mesh, or no eye was seen.
    """
    face = torch.nonzero(observations.of("face"))[:, 0]
    if len(face) != _MESH or max(weights) == 0:
        return None
    columns = (shut != 0).any(0) & (weights[0] > 0)
    at_rest = dataclasses.replace(fitted, expression=torch.where(columns, torch.zeros(()), fitted.expression))

    def predicted(parameters: Parameters, rotation: Tensor) -> Tensor:
        points, _ = model.posed(parameters, rotation)
        return views.to_pixels(views.to_camera(points))[:, face]

    seen = _eyes(observations.pixels[:, face])
    rest = predicted(at_rest, matrices)
    trust = observations.mask[:, face[list(_needed())]].all(1)[:, None] * _facing(
        model, fitted, matrices, views
    )
    trust = trust * (_eyes(rest).width.norm(dim=-1) >= _LEAST_WIDTH)
    if not bool((trust > 0).any()):
        return None
    closed = _closure(seen, _eyes(rest), trust)
    lids = fitted.expression * 0
    if bool(columns.any()):
        lids = _lids(closed, trust, weights[0]) @ shut
    gaze = None
    if weights[1] > 0:
        looking = dataclasses.replace(at_rest, expression=torch.where(columns, lids, fitted.expression))
        sight = trust * _ramp(1 - closed, *_LOOKS)
        gaze = _gaze(lambda eyes: _eyes(predicted(looking, eyes)), seen, matrices, sight, weights[1])
    return FittedEyes(lids, columns, gaze)


def _needed() -> list[int]:
    """The points of the face mesh that an eye is read from."""
    return [*np.ravel(UPPER_LIDS), *np.ravel(LOWER_LIDS), *np.ravel(CORNERS)]


def _eyes(pixels: Tensor) -> _Eyes:
    """The eyes among the face mesh's points [T, 478, 2]."""
    upper, lower = (pixels[:, torch.tensor(lids)].mean(2) for lids in (UPPER_LIDS, LOWER_LIDS))
    corners = pixels[:, torch.tensor(CORNERS)]  # [T, 2, 2, 2]
    iris, socket = pixels[:, torch.tensor(IRISES)].mean(2), pixels[:, torch.tensor(SOCKETS)]
    return _Eyes(upper - lower, corners[:, :, 1] - corners[:, :, 0], iris, socket)


def _facing(model: LandmarkModel, fitted: Parameters, matrices: Tensor, views: CameraBatch) -> Tensor:
    """How well each eye is turned to the camera, by the head: [T, 2] in [0, 1]."""
    points, joints = model.posed(fitted, matrices)
    del points
    head = _chain(model, matrices)[:, model.parents[EYES.start]]
    # An eye looks a little outwards of straight ahead over the nose: beyond that the nose hides it.
    outward = matrices.new_tensor([[0.35, 0.0, 0.94], [-0.35, 0.0, 0.94]])
    world = torch.einsum("tij,ej->tei", head, outward)
    camera = torch.einsum("tij,tej->tei", views.rotation, world)
    towards = -torch.nn.functional.normalize(views.to_camera(joints[:, EYES]), dim=-1)
    return _ramp((camera * towards).sum(-1), *_SIDEWAYS)


def _chain(model: LandmarkModel, matrices: Tensor) -> Tensor:
    """The joints' rotations in the world, [T, 55, 3, 3]."""
    world = [matrices[:, 0]]
    for joint in range(1, matrices.shape[1]):
        world.append(world[model.parents[joint]] @ matrices[:, joint])
    return torch.stack(world, dim=1)


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    """0 up to ``low``, 1 from ``high`` on, smooth between."""
    share = ((value - low) / (high - low)).clamp(0, 1)
    return share.square() * (3 - 2 * share)


def _closure(seen: _Eyes, rest: _Eyes, trust: Tensor) -> Tensor:
    """How far each eye is shut: [T, 2], 0 as the model at rest, 1 shut; 0 where nothing is seen."""
    size = rest.gap.norm(dim=-1).clamp_min(1e-3)
    gap = (seen.gap * rest.gap).sum(-1) / size
    width = rest.width.norm(dim=-1).clamp_min(1e-3)
    known = trust > 0.5 if bool((trust > 0.5).any()) else trust > 0
    level = float((gap / size)[known].quantile(_OPEN_QUANTILE).clamp(*_GAIN))
    read = float((gap / width)[known].quantile(_SHUT_QUANTILE).clamp(0, _SHUT_GAP))
    shut = read * width / size
    share = (gap / size - shut) / (level - shut).clamp_min(0.1)  # of the opening of this clip's open eyes
    return torch.where(trust > 0, 1 - level * share, torch.zeros_like(gap)).clamp(-0.8, _MOST)


def _lids(closed: Tensor, trust: Tensor, weight: float) -> Tensor:
    """The closure of both eyes, [T, 2], of what each shows: a closed form of the two terms below.

    weight trust (c - seen)^2 / noise^2 for either eye + (c_left - c_right)^2 / differ^2, which a clear wink
    lets go of; frames in which nothing is seen take theirs from the frames around.
    """
    own = weight * trust / _LID_NOISE**2 + 1e-9
    apart = (closed[:, 0] - closed[:, 1]) * trust.amin(1)
    tie = 1 / (_LIDS_DIFFER * (1 + (apart / _WINK).square())).square()
    both = terms.tie_of_two(closed, own, tie)
    return _steady(_filled(both, trust.amax(1) > 0), *_SMALL["lids"])


def _gaze(
    project: Callable[[Tensor], _Eyes], seen: _Eyes, matrices: Tensor, trust: Tensor, weight: float
) -> Tensor:
    """Rotation vectors of the eyes that bring the irises where they were seen: [T, 2, 3]."""
    angles = matrices.new_zeros(len(matrices), 2, 2)  # up or down, and aside

    def turned(at: Tensor) -> _Eyes:
        eyes = matrices.clone()
        eyes[:, EYES] = roma.rotvec_to_rotmat(_vectors(at))
        return project(eyes)

    for _ in range(_STEPS):
        now = turned(angles)
        width = now.width.norm(dim=-1, keepdim=True).clamp_min(_LEAST_WIDTH)
        slopes = [(turned(angles + _STEP * axis).iris - now.iris) / _STEP / width for axis in torch.eye(2)]
        jacobian = torch.stack(slopes, dim=-1)  # [T, 2, 2, 2]
        # The socket takes out by how much the whole eye lies beside where the fit has it.
        off = (seen.iris - now.iris - (seen.socket - now.socket).mean(2)) / width
        angles = _gaze_step(angles, jacobian, off, weight * trust / _GAZE_NOISE**2)
    known = trust.amax(1) > 0.2
    filled = _filled(angles.flatten(1), known).unflatten(1, (2, 2)) if bool(known.any()) else angles * 0
    return _vectors(_steady(filled.flatten(1), *_SMALL["gaze"]).unflatten(1, (2, 2)))


def _vectors(angles: Tensor) -> Tensor:
    """Rotation vectors of eyes that are turned by angles about X and Y: [T, 2, 2] -> [T, 2, 3]."""
    return torch.cat([angles, torch.zeros_like(angles[..., :1])], dim=-1)


def _gaze_step(angles: Tensor, jacobian: Tensor, off: Tensor, weight: Tensor) -> Tensor:
    """One Gauss-Newton step of both eyes of T frames.

    Args:
        angles: [T, 2, 2]; jacobian: [T, 2, 2, 2], by eye, residual and angle.
        off: [T, 2, 2], seen minus predicted, of the eye's width.
        weight: [T, 2], of what either eye shows.
    """
    count = len(angles)
    normal, right = angles.new_zeros(count, 4, 4), angles.new_zeros(count, 4)
    for eye in range(2):
        part = slice(2 * eye, 2 * eye + 2)
        weighted = jacobian[:, eye].mT * weight[:, eye, None, None]
        normal[:, part, part] = weighted @ jacobian[:, eye]
        right[:, part] = (weighted @ off[:, eye, :, None])[..., 0]
    tie = torch.tensor(_EYES_DIFFER).square().reciprocal()
    together = torch.cat([torch.cat([torch.diag(tie), -torch.diag(tie)], 1)] * 2)
    together[2:] *= -1
    prior = together + torch.eye(4) / _GAZE**2
    now = angles.flatten(1)
    step = torch.linalg.solve(normal + prior, (right - now @ prior)[..., None])[..., 0]
    return (now + step).clamp(-_GAZE_LIMIT, _GAZE_LIMIT).unflatten(1, (2, 2))


def _filled(values: Tensor, known: Tensor) -> Tensor:
    """[T, K] with the rows that are not known interpolated between those that are; all, if none is."""
    rows = torch.nonzero(known)[:, 0].numpy()
    if len(rows) in (0, len(values)):
        return values
    every = np.arange(len(values))
    columns = [np.interp(every, rows, values[:, k].numpy()[rows]) for k in range(values.shape[1])]
    return torch.from_numpy(np.stack(columns, axis=1)).to(values)


def _steady(values: Tensor, small: float, large: float) -> Tensor:
    """[T, K] averaged over three frames where that changes little, as they are where it changes much."""
    if len(values) < 3:
        return values
    before, after = torch.cat([values[:1], values[:-1]]), torch.cat([values[1:], values[-1:]])
    mean = (before + 2 * values + after) / 4
    kept = _ramp((values - mean).abs().amax(1, keepdim=True) * 2, small, large)
    return mean + kept * (values - mean)
