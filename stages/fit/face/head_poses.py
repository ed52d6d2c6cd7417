"""One face in every frame: where the head is, how far the mouth is open, and the expression.

Gauss-Newton on the face's points (478 of a mesh, or 68 without depth) as they are seen through the frame's
own pinhole, all frames of a chunk at once. Unknown in a frame are the head's rotation R and place t in the
camera's axes, the jaw's angle a about its hinge (X), psi, and the origin of the estimator's depths:

    y_i = B_i(a) (n_i + E_i psi - j) + j,   B_i(a) = 1 + w_i (R_x(a) - 1)
    pixel_i = project(R y_i + t),           depth_i = gain * focal * (R y_i + t)_z / distance + origin

The jaw is a joint of the body and no expression, so it has an unknown of its own.
"""

from __future__ import annotations

import dataclasses
import math

import roma
import torch
from torch import Tensor

from stages.fit.face.target import FaceModel

CHUNK = 64  # frames whose Jacobians are held at once
DEPTH_NOISE = 3.0
"""Noise of the estimator's z over that of its x and y.

It is inferred from the face's look rather than seen, and errs by a tenth to a fifth of the face's depth.
"""

TOGETHER = 0.25
"""Weight of a landmark, since neighbouring ones err together: a quarter of a point."""

_EXPRESSION = 0.3  # standard deviation of a coefficient of psi; 3 is about all that a face can do
_EXPRESSION_LIMIT = 3.0
_JAW, _JAW_LIMIT = 0.15, 0.6  # radians
_OUTLIER = 4.0  # squared residual over squared noise from which a point loses its say


@dataclasses.dataclass(frozen=True)
class FaceObservations:
    """A face's F points as they were seen in T frames.

    Attributes:
        pixels: [T, F, 2], relative to the principal point.
        depth: [T, F], in pixels, relative, larger farther away; anything where no depth is known.
        mask: [T, F], 1 where a point is to be trusted.
        focal: [T, 2], pixels.
    """

    pixels: Tensor
    depth: Tensor
    mask: Tensor
    focal: Tensor

    def frames(self, rows: Tensor | slice) -> FaceObservations:
        """Some of the frames."""
        return FaceObservations(self.pixels[rows], self.depth[rows], self.mask[rows], self.focal[rows])


@dataclasses.dataclass(frozen=True)
class HeadPoses:
    """The unknowns of T frames.

    Attributes:
        rotation: R, [T, 3, 3], from the body's axes to the camera's.
        place: t, [T, 3], metres, of the head joint.
        jaw: a, [T], radians.
        expression: psi, [T, E].
        origin: [T], pixels, the estimator's depth of the head joint.
    """

    rotation: Tensor
    place: Tensor
    jaw: Tensor
    expression: Tensor
    origin: Tensor


@dataclasses.dataclass(frozen=True)
class ObservationQuality:
    """The quality of the observations.

    Attributes:
        noise: [T], pixels, standard deviation of x and y.
        gain: the estimator's depths over true ones.
        depth_noise: noise of the depths over that of x and y; infinite where none are known.
        together: weight of a point, less than 1 where neighbouring ones err together.
    """

    noise: Tensor
    gain: float = 1.0
    depth_noise: float = DEPTH_NOISE
    together: float = TOGETHER

    @property
    def has_depth(self) -> bool:
        """True where the estimator tells depths."""
        return math.isfinite(self.depth_noise)

    def frames(self, rows: Tensor | slice) -> ObservationQuality:
        """The quality of some of the frames."""
        return dataclasses.replace(self, noise=self.noise[rows])


@dataclasses.dataclass(frozen=True)
class Linearisation:
    """The model about the present unknowns.

    Attributes:
        residual: [T, F, 3], seen minus predicted x, y, depth, in standard deviations.
        weight: [T, F], 0 for masked points, small for outliers.
        camera: [T, F, 3, 3], derivative of the prediction by a shift in the camera's axes.
        blend: [T, F, 3, 3], R B_i: what carries a rest offset to the camera's axes.
        posed: [T, F, 3], y in the head's frame.
    """

    residual: Tensor
    weight: Tensor
    camera: Tensor
    blend: Tensor
    posed: Tensor


def start(model: FaceModel, observed: FaceObservations) -> HeadPoses:
    """Heads by Procrustes' fit of the points that neither the jaw nor an expression moves."""
    weights = observed.mask * rigidity(model)
    seen = torch.cat([observed.pixels, observed.depth[..., None]], dim=-1)
    nothing = weights.sum(1) < 1e-6
    weights = torch.where(nothing[:, None], torch.ones_like(weights), weights)
    mean = model.mean.expand(len(seen), -1, -1)
    rotation, shift, scale = roma.rigid_points_registration(mean, seen, weights, compute_scaling=True)
    distance = observed.focal.mean(1) / scale.clamp_min(1e-3)
    centre = (mean * weights[..., None]).sum(1) / weights.sum(1, keepdim=True)
    middle = (seen * weights[..., None]).sum(1) / weights.sum(1, keepdim=True)
    ahead = torch.cat([middle[:, :2] / observed.focal * distance[:, None], distance[:, None]], dim=1)
    place = ahead - (rotation @ centre[..., None])[..., 0]
    zeros = seen.new_zeros(len(seen), model.expression.shape[2])
    return HeadPoses(rotation, place, zeros[:, :1].sum(1), zeros, shift[:, 2])


def start_without_depth(model: FaceModel, observed: FaceObservations) -> HeadPoses:
    """Heads by the scaled orthographic camera that fits best the points of the skull.

    The affine map from the mean face to the pixels is found by least squares; the rotation is the nearest to
    its two rows, the third follows from them. In a frame that shows nothing the head faces the camera.
    """
    weights = observed.mask * rigidity(model)
    total = weights.sum(1, keepdim=True).clamp_min(1e-9)
    centre = (weights / total) @ model.mean  # [T, 3]
    middle = (observed.pixels * (weights / total)[..., None]).sum(1)
    places = (model.mean - centre[:, None]) * weights.sqrt()[..., None]
    pixels = (observed.pixels - middle[:, None]) * weights.sqrt()[..., None]
    spread = places.mT @ places
    spread = spread + 1e-6 * torch.eye(3, dtype=spread.dtype)  # metres squared: a millimetre
    affine = torch.linalg.solve(spread, places.mT @ pixels).mT  # [T, 2, 3]
    upright = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    affine = torch.where((affine.norm(dim=(1, 2)) > 1e-3)[:, None, None], affine, upright)
    left, sizes, right = torch.linalg.svd(affine, full_matrices=False)
    rows = left @ right
    rotation = torch.cat([rows, torch.linalg.cross(rows[:, 0], rows[:, 1])[:, None]], dim=1)
    distance = observed.focal.mean(1) / sizes.mean(1).clamp_min(1e-3)
    ahead = torch.cat([middle / observed.focal * distance[:, None], distance[:, None]], dim=1)
    place = ahead - (rotation @ centre[..., None])[..., 0]
    zeros = place.new_zeros(len(place), model.expression.shape[2])
    return HeadPoses(rotation, place, zeros[:, :1].sum(1), zeros, place.new_zeros(len(place)))


def rigidity(model: FaceModel) -> Tensor:
    """The rigidity of each point in the skull: [F], 1 for the bridge of the nose, near 0 for the lips."""
    moves = model.expression.square().sum((1, 2)).sqrt() / 0.004
    return (1 - model.jaw_weight).clamp_min(0) ** 4 / (1 + moves.square())


def solve(
    model: FaceModel,
    neutral: Tensor,
    observed: FaceObservations,
    heads: HeadPoses,
    quality: ObservationQuality,
    steps: int,
) -> HeadPoses:
    """Gauss-Newton steps on every frame.

    Args:
        neutral: n, [F, 3], metres.
        observed: what was seen in T frames.
        quality: of the observations.
        steps: how many.
    """
    done = []
    for begin in range(0, len(observed.mask), CHUNK):
        rows = slice(begin, begin + CHUNK)
        part = HeadPoses(*(getattr(heads, f.name)[rows] for f in dataclasses.fields(HeadPoses)))
        seen, known = observed.frames(rows), quality.frames(rows)
        for _ in range(steps):
            part = _step(model, linearise(model, neutral, seen, part, known), part, known)
        done.append(part)
    return HeadPoses(*(torch.cat([getattr(p, f.name) for p in done]) for f in dataclasses.fields(HeadPoses)))


def linearise(
    model: FaceModel,
    neutral: Tensor,
    observed: FaceObservations,
    heads: HeadPoses,
    quality: ObservationQuality,
) -> Linearisation:
    """Residuals and derivatives; arguments as in ``solve``."""
    turn = roma.rotvec_to_rotmat(_about_x(heads.jaw))  # [T, 3, 3]
    eye = torch.eye(3, dtype=turn.dtype)
    blend = eye + model.jaw_weight[:, None, None] * (turn - eye)[:, None]
    shaped = neutral + (heads.expression @ model.expression.flatten(0, 1).mT).unflatten(1, neutral.shape)
    posed = (blend @ (shaped - model.jaw_joint)[..., None])[..., 0] + model.jaw_joint
    seen = posed @ heads.rotation.mT + heads.place[:, None]
    near = seen[..., 2:].clamp_min(0.05)
    focal, distance = observed.focal[:, None], heads.place[:, None, 2:].clamp_min(0.05)
    pixels = seen[..., :2] / near * focal
    per_metre = quality.gain * focal[..., :1] / distance
    depth = per_metre * (seen[..., 2:] - heads.place[:, None, 2:]) + heads.origin[:, None, None]
    found = torch.cat([observed.pixels, observed.depth[..., None]], dim=-1)
    sigma = torch.stack([quality.noise, quality.noise, quality.depth_noise * quality.noise], dim=1)[:, None]
    residual = (found - torch.cat([pixels, depth], dim=-1)) / sigma
    weight = observed.mask / (1 + residual.square().mean(-1) / _OUTLIER).square()
    camera = seen.new_zeros(*seen.shape, 3)
    camera[..., 0, 0], camera[..., 1, 1] = (focal / near).unbind(-1)
    camera[..., :2, 2] = -pixels / near
    camera[..., 2, 2] = per_metre[..., 0]
    return Linearisation(residual, weight, camera / sigma[..., None], heads.rotation[:, None] @ blend, posed)


def _step(
    model: FaceModel, linear: Linearisation, heads: HeadPoses, quality: ObservationQuality
) -> HeadPoses:
    """One damped Gauss-Newton step; priors on the jaw and psi are part of the normal equations."""
    jacobian = _jacobian(model, linear, heads, quality)  # [T, F, 3, P]
    weighted = jacobian * (quality.together * linear.weight)[..., None, None]
    flat = weighted.flatten(1, 2).mT  # [T, P, 3F]
    normal = (flat @ jacobian.flatten(1, 2)).double()
    right = (flat @ linear.residual.flatten(1)[..., None])[..., 0].double()
    precision = normal.new_zeros(normal.shape[-1])
    precision[7], precision[8:] = _JAW**-2, _EXPRESSION**-2.0
    now = torch.cat([normal.new_zeros(len(right), 7), heads.jaw[:, None], heads.expression], dim=1)
    right = right - precision * now
    # A frame in which nothing is seen has no equations but the priors: the damping leaves its pose alone.
    damping = 1e-4 * normal.diagonal(dim1=1, dim2=2) + 1e-6
    normal = normal + torch.diag_embed(precision + damping)
    step = torch.linalg.solve(normal, right[..., None])[..., 0].float()
    turn = roma.rotvec_to_rotmat(step[:, :3].clamp(-0.5, 0.5))
    return HeadPoses(
        rotation=roma.special_procrustes(heads.rotation @ turn),
        place=heads.place + step[:, 3:6],
        origin=heads.origin + step[:, 6],
        jaw=(heads.jaw + step[:, 7]).clamp(0.0, _JAW_LIMIT),
        expression=(heads.expression + step[:, 8:]).clamp(-_EXPRESSION_LIMIT, _EXPRESSION_LIMIT),
    )


def _jacobian(
    model: FaceModel, linear: Linearisation, heads: HeadPoses, quality: ObservationQuality
) -> Tensor:
    """Derivatives by rotation, place, depth origin, jaw and psi: [T, F, 3, 8 + E]."""
    in_camera = linear.camera @ heads.rotation[:, None]  # by a shift in the head's axes
    axes = torch.eye(3, dtype=in_camera.dtype).expand(*linear.posed.shape, 3)
    turn = in_camera @ torch.linalg.cross(axes, linear.posed[..., None, :].expand_as(axes)).mT
    # Depths are measured from the head joint, whose own place along the view cancels.
    place = linear.camera.clone()
    place[..., 2, :] = 0
    origin = torch.zeros_like(linear.residual)
    origin[..., 2] = (1 / (quality.depth_noise * quality.noise))[:, None]
    swing = torch.linalg.cross(axes[..., 0, :], linear.posed - model.jaw_joint)
    jaw = in_camera @ (model.jaw_weight[:, None] * swing)[..., None]
    # A product a point over all frames: one a point and frame is many times slower.
    psi = torch.einsum("tfac,fce->tfae", linear.camera @ linear.blend, model.expression)
    return torch.cat([turn, place, origin[..., None], jaw, psi], dim=-1)


def _about_x(angle: Tensor) -> Tensor:
    return torch.stack([angle, torch.zeros_like(angle), torch.zeros_like(angle)], dim=-1)
