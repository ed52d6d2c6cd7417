"""FLAME fitted to the clip's 2D face points, from DECA's start and before the body (supplement A).

A landmark i of FLAME, at v_i + S_i beta + E_i psi at rest, follows the jaw as its skinning weight w_i says
and the head in every frame:

    y_i = B_i (v_i + S_i beta + E_i psi - j) + j,   B_i = 1 + w_i (R_jaw - 1)
    loss = mean_i |project(R y_i + t) - k_i|_1 / size
           + lambda (mean |psi - psi_0| + mean |jaw - jaw_0| + mean |beta - beta_0|)

The first term is L1 on projected landmarks over the trusted points k_i, in parts of the face's size in its
frame; the second the distance from DECA's start, ExAvatar's weight 0.1. Where DECA found no face the start is
the mean face with its mouth shut. beta is shared by the clip. R and t start at the pose of least reprojection
error of the start's points (SQPnP). A frame of which too few points are trusted keeps DECA's numbers.
"""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import BodyModel
from stages.fit.camera_batch import CameraBatch
from stages.fit.face.deca import FlameParameters
from stages.fit.face.flame_model import JOINTS, FlameModel
from stages.fit.face.from_flame import correspond
from stages.fit.face.target import FaceModel

STEPS = 300
_RATES = {"turn": 0.02, "shift": 0.005, "jaw": 0.02, "expression": 0.05, "shape": 0.05}
_LAST_RATE = 0.02  # of the first
_SEEN = 0.5  # of a face's points; fewer are no face
_LEAST_POINTS = 8
_NEAREST = 0.05  # metres before the camera
_LIMIT = 4.0  # of a coefficient


@dataclasses.dataclass(frozen=True)
class FlamePoints:
    """The clip's face points on FLAME: K places, metres in FLAME's axes.

    Attributes:
        template: v, [K, 3].
        shape: S, [K, 3, S]; expression: E, [K, 3, E].
        jaw_weight: w, [K], how much each follows the jaw, as the body's does.
        jaw_joint: j, [3].
        kept: [F] bool, those of the body's landmarks that have a place on FLAME.
    """

    template: Tensor
    shape: Tensor
    expression: Tensor
    jaw_weight: Tensor
    jaw_joint: Tensor
    kept: Tensor

    def posed(self, shape: Tensor, expression: Tensor, jaw: Tensor) -> Tensor:
        """The points y in the head's axes: [S], [T, E] and rotation vectors [T, 3] -> [T, K, 3]."""
        rest = self.template + self.shape[..., : len(shape)] @ shape
        basis = self.expression[..., : expression.shape[1]]
        rest = rest + torch.einsum("kce,te->tkc", basis, expression) - self.jaw_joint
        opened = rest @ roma.rotvec_to_rotmat(jaw).mT
        return rest + self.jaw_weight[:, None] * (opened - rest) + self.jaw_joint


@dataclasses.dataclass(frozen=True)
class FlameFit:
    """FLAME as it was fitted.

    Attributes:
        parameters: of T frames; valid where DECA's were, or where points were fitted.
        error: [T], mean distance of projected landmarks and points in pixels; NaN where none was fitted.
        start_error: [T], the same of the start, its head in the best place.
    """

    parameters: FlameParameters
    error: Tensor
    start_error: Tensor


def flame_points(model: FaceModel, body: BodyModel, flame: FlameModel) -> FlamePoints:
    """The places on FLAME of a body's face landmarks."""
    match = correspond(model, body, flame)
    return FlamePoints(
        match.of(flame.v_template), match.of(flame.shape_directions), match.of(flame.expression_directions),
        model.jaw_weight[match.kept], flame.joints[JOINTS.index("jaw")], match.kept,
    )  # fmt: skip


def unknown_parameters(count: int, shapes: int, expressions: int) -> FlameParameters:
    """The start of T frames where DECA says nothing: the mean face, valid in no frame."""
    nothing = torch.zeros(count, expressions)
    return FlameParameters(
        torch.zeros(shapes), nothing, torch.zeros(count, 3), torch.zeros(count, dtype=torch.bool)
    )


def fit_flame(
    points: FlamePoints,
    start: FlameParameters,
    pixels: Tensor,  # [T, F, 2]
    mask: Tensor,  # [T, F]
    views: CameraBatch,
    weight: float = 0.1,
    steps: int = STEPS,
) -> FlameFit:
    """Fit FLAME to 2D face points.

    Args:
        points: where the F landmarks lie.
        start: DECA's parameters, of T frames.
        pixels: k, the detected landmarks; those that are not finite are masked.
        mask: bool, which to trust.
        views: the frames' cameras.
        weight: lambda, of the distance from the start.
        steps: of Adam, over the whole clip.
    """
    pixels, mask = pixels[:, points.kept], mask[:, points.kept]
    mask = mask & torch.isfinite(pixels).all(-1)
    enough = mask.sum(1) >= max(_LEAST_POINTS, math.ceil(_SEEN * mask.shape[1]))
    rows = torch.nonzero(enough)[:, 0]
    nothing = torch.full((len(mask),), math.nan)
    if not len(rows):
        return FlameFit(start, nothing, nothing.clone())
    seen = _Seen(torch.where(mask[..., None], pixels, 0.0)[rows], mask[rows].float(), _rows(views, rows))
    known = start.valid[rows, None]
    first = FlameParameters(
        start.shape,
        torch.where(known, start.expression[rows], torch.zeros_like(start.expression[rows])),
        torch.where(known, start.jaw[rows], torch.zeros_like(start.jaw[rows])),
        start.valid[rows],
    )
    fitted, errors = _optimise(points, first, seen, weight, steps)
    expression, jaw, valid = start.expression.clone(), start.jaw.clone(), start.valid.clone()
    expression[rows], jaw[rows], valid[rows] = fitted.expression, fitted.jaw, True
    spread = [nothing.index_put((rows,), error) for error in errors]
    return FlameFit(FlameParameters(fitted.shape, expression, jaw, valid), spread[1], spread[0])


@dataclasses.dataclass(frozen=True)
class _Seen:
    """Points [T, K, 2] in pixels, their mask [T, K] of 0 and 1, and the cameras of their T frames."""

    pixels: Tensor
    mask: Tensor
    views: CameraBatch

    def sizes(self) -> Tensor:
        """The root mean square of the trusted points about their middle: [T], pixels, at least 1."""
        count = self.mask.sum(1, keepdim=True)
        middle = (self.pixels * self.mask[..., None]).sum(1) / count
        off = (self.pixels - middle[:, None]).square().sum(-1) * self.mask
        return (off.sum(1) / count[:, 0]).sqrt().clamp_min(1.0)


def landmark_loss(projected: Tensor, pixels: Tensor, mask: Tensor, sizes: Tensor) -> Tensor:
    """L1 between projected landmarks and detected points, in parts of the face's size: [T].

    Args:
        projected, pixels: [T, K, 2], pixels.
        mask: [T, K], 1 where a point is to be trusted.
        sizes: [T], pixels.
    """
    off = (projected - pixels).abs().sum(-1) * mask
    return off.sum(1) / mask.sum(1).clamp_min(1) / sizes


def _optimise(
    points: FlamePoints, start: FlameParameters, seen: _Seen, weight: float, steps: int
) -> tuple[FlameParameters, tuple[Tensor, Tensor]]:
    """The fitted parameters, and the landmarks' errors [T] in pixels before and after."""
    with torch.no_grad():
        rotation, place = _heads(points.posed(start.shape, start.expression, start.jaw), seen)
    unknown = {
        "turn": torch.zeros(len(place), 3),
        "shift": torch.zeros(len(place), 3),
        "jaw": start.jaw.clone(),
        "expression": start.expression.clone(),
        "shape": start.shape.clone(),
    }
    sizes, distance = seen.sizes(), place[:, 2:].clone()

    def project(of: dict[str, Tensor]) -> Tensor:
        turned = points.posed(of["shape"], of["expression"], of["jaw"])
        # A shift is a share of the distance: how far a face is does not say how finely it is seen.
        turn = roma.rotvec_to_rotmat(of["turn"]) @ rotation
        return seen.views.to_pixels(turned @ turn.mT + (place + distance * of["shift"])[:, None], _NEAREST)

    def error(of: dict[str, Tensor]) -> Tensor:
        off = (project(of) - seen.pixels).norm(dim=-1) * seen.mask
        return off.sum(1) / seen.mask.sum(1)

    with torch.no_grad():
        before = error(unknown)
    with torch.enable_grad():
        for value in unknown.values():
            value.requires_grad_()
        groups = [{"params": [value], "lr": _RATES[name]} for name, value in unknown.items()]
        adam = torch.optim.Adam(groups)
        factor = _LAST_RATE ** (1 / max(steps, 1))
        schedule = torch.optim.lr_scheduler.ExponentialLR(adam, factor)
        for _ in range(steps):
            adam.zero_grad()
            away = (
                (unknown["expression"] - start.expression).abs().mean()
                + (unknown["jaw"] - start.jaw).abs().mean()
                + (unknown["shape"] - start.shape).abs().mean()
            )
            loss = landmark_loss(project(unknown), seen.pixels, seen.mask, sizes).mean() + weight * away
            loss.backward()
            adam.step()
            schedule.step()
            with torch.no_grad():
                for name in ("expression", "shape"):
                    unknown[name].clamp_(-_LIMIT, _LIMIT)
    with torch.no_grad():
        found = {name: value.detach() for name, value in unknown.items()}
        after = error(found)
    fitted = FlameParameters(found["shape"], found["expression"], found["jaw"], start.valid)
    return fitted, (before, after)


def _heads(posed: Tensor, seen: _Seen) -> tuple[Tensor, Tensor]:
    """Rotations [T, 3, 3] and places [T, 3], metres, of heads whose points [T, K, 3] fall on the seen."""
    rotations, places = [], []
    for row in range(len(posed)):
        trusted = seen.mask[row] > 0
        focal, centre = seen.views.focal[row], seen.views.centre[row]
        matrix = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]], np.float64)
        there, shown = posed[row][trusted].double().numpy(), seen.pixels[row][trusted].double().numpy()
        rotation, place = _head(there, shown, matrix)
        rotations.append(rotation)
        places.append(place)
    return torch.from_numpy(np.stack(rotations)).float(), torch.from_numpy(np.stack(places)).float()


def _head(there: np.ndarray, shown: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One head; upright, before the camera and looking at it, where the points do not say how it is."""
    try:
        _, turn, shift = cv2.solvePnP(there, shown, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        turn, shift = cv2.solvePnPRefineLM(there, shown, matrix, None, turn, shift)
        if np.isfinite(turn).all() and np.isfinite(shift).all() and shift[2, 0] > _NEAREST:
            return cv2.Rodrigues(turn)[0], shift[:, 0]
    except cv2.error:
        pass
    upright = np.diag([1.0, -1.0, -1.0])
    spread = max(float(np.ptp(shown, axis=0).max()), 1.0)
    away = matrix[0, 0] * float(np.ptp(there, axis=0).max()) / spread
    ray = np.linalg.solve(matrix, np.append(shown.mean(0), 1.0))
    return upright, away * ray - upright @ there.mean(0)


def _rows(views: CameraBatch, rows: Tensor) -> CameraBatch:
    return CameraBatch(*(getattr(views, field.name)[rows] for field in dataclasses.fields(views)))
