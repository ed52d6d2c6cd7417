"""Cameras around a body that stands still, and the pose in which it does."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from pipeline.body.joints import JOINT_NAMES
from pipeline.clip.camera import Camera
from pipeline.splat import Gaussians

_FIELD = math.radians(25)  # of view, along the image's height; a long lens, as portraits are taken
_FILL = 0.9  # share of the image that the body may take
_OPAQUE = 0.05  # Gaussians below are not part of what is seen
_NEAREST = 0.3  # metres between camera and axis
_REACH = 2.0  # standard deviations of a Gaussian that are seen
_OUTLIERS = 0.005  # share of the Gaussians that do not set the extent


@dataclasses.dataclass(frozen=True)
class Extent:
    """The space that cameras on a circle have to show.

    Attributes:
        centre: [3], metres; the turn's axis runs through it.
        radius: [N], how far each Gaussian reaches from the axis, metres.
        height: [N], how far each reaches above or below the centre, metres.
    """

    centre: Tensor  # [3]
    radius: np.ndarray  # [N]
    height: np.ndarray  # [N]


def relaxed_pose(arm_angle: float) -> Tensor:
    """The A pose: the T pose with both arms ``arm_angle`` radians down at the shoulders, [55, 3].

    The subject's left is +X, so its left arm comes down by a turn about -Z and its right about +Z.

    >>> relaxed_pose(0.5)[JOINT_NAMES.index("left_shoulder")]
    tensor([ 0.0000,  0.0000, -0.5000])
    """
    rotation = torch.zeros(len(JOINT_NAMES), 3)
    rotation[JOINT_NAMES.index("left_shoulder"), 2] = -arm_angle
    rotation[JOINT_NAMES.index("right_shoulder"), 2] = arm_angle
    return rotation


def visible_extent(gaussians: Gaussians) -> Extent:
    """The extent of the visible Gaussians.

    Gated Gaussians are either absent or transparent; both count for nothing.
    """
    places, reach = _seen(gaussians)
    if not len(places):
        return Extent(torch.zeros(3), np.ones(1), np.ones(1))
    low, high = _box(places, reach)
    centre = (low + high) / 2
    radius = np.hypot(places[:, 0] - centre[0], places[:, 2] - centre[2]) + reach
    return Extent(torch.from_numpy(centre).float(), radius, np.abs(places[:, 1] - centre[1]) + reach)


def visible_box(gaussians: Gaussians) -> np.ndarray:
    """The lowest and the highest corner of the visible Gaussians, strays apart: [2, 3], metres.

    Both are zero where nothing is seen.
    """
    places, reach = _seen(gaussians)
    return np.stack(_box(places, reach)) if len(places) else np.zeros((2, 3))


@torch.no_grad()
def _seen(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Centres [M, 3] of the Gaussians that are seen, and how far they reach around these [M], metres."""
    means, sizes = gaussians.means.double(), gaussians.scales.double()
    seen = (gaussians.opacities > _OPAQUE) & means.isfinite().all(1) & sizes.isfinite().all(1)
    return means[seen].cpu().numpy(), _REACH * sizes[seen].amax(1).cpu().numpy()


def _box(places: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low = np.quantile(places - reach[:, None], _OUTLIERS, axis=0)
    high = np.quantile(places + reach[:, None], 1 - _OUTLIERS, axis=0)
    return low, high


def extent_of(boxes: np.ndarray) -> Extent:
    """The extent of several boxes together, [K, 2, 3]: of a body that moves about."""
    corners = corners_of(boxes)
    centre = (corners.min(0) + corners.max(0)) / 2
    away = corners - centre
    return Extent(torch.from_numpy(centre).float(), np.hypot(away[:, 0], away[:, 2]), np.abs(away[:, 1]))


def corners_of(boxes: np.ndarray) -> np.ndarray:
    """All corners of boxes [K, 2, 3] given by their lowest and highest: [8 K, 3]."""
    low, high = boxes[:, :1], boxes[:, 1:]
    choice = np.array([[k >> axis & 1 for axis in range(3)] for k in range(8)])
    return (low + (high - low) * choice).reshape(-1, 3)


def front_camera(boxes: np.ndarray, width: int, height: int) -> Camera:
    """A level camera before the face (+Z) that stands as near as it can without cutting anything off.

    Args:
        boxes: [K, 2, 3], the lowest and the highest corner of what is filmed, in each of K moments.
        width, height: pixels.
    """
    corners = corners_of(boxes)
    centre = (corners.min(0) + corners.max(0)) / 2
    away, focal = corners - centre, height / 2 / math.tan(_FIELD / 2)
    across, up = (focal / (_FILL * side / 2) for side in (width, height))
    # Beside the axis by x and nearer than the centre by z, a point is in view if x across <= d - z.
    needed = np.maximum(np.abs(away[:, 0]) * across, np.abs(away[:, 1]) * up) + away[:, 2]
    distance = max(float(needed.max()), _NEAREST)
    return _orbit_camera(torch.from_numpy(centre).float(), distance, focal, (width, height), 0.0)


def orbit(extent: Extent, width: int, height: int, count: int, turns: float = 1.0) -> list[Camera]:
    """Cameras on a level circle around a body, the first before its face (+Z), then to its left.

    They stand as near as they can without cutting anything off at any angle, stray Gaussians apart.

    Args:
        extent: what is filmed.
        width: pixels.
        height: pixels.
        count: of cameras.
        turns: how often they go round.
    """
    return [view(extent, width, height, turns * place / count) for place in range(count)]


def view(extent: Extent, width: int, height: int, turn: float = 0.0, pitch: float = 0.0) -> Camera:
    """A camera that looks at a body from as near as it can without cutting anything off at any turn.

    Args:
        extent: what is filmed.
        width: pixels.
        height: pixels.
        turn: where it stands on the circle, 0 to 1: before the face (+Z), then to the body's left.
        pitch: how far above the level it stands, radians, -pi / 2 to pi / 2.
    """
    focal = height / 2 / math.tan(_FIELD / 2)
    across, up = (focal / (_FILL * side / 2) for side in (width, height))
    sine, cosine = abs(math.sin(pitch)), abs(math.cos(pitch))
    tall, deep = (
        extent.height * cosine + extent.radius * sine,
        extent.radius * cosine + extent.height * sine,
    )
    # A point on the radius r at height y is in view from the distance d at every angle a if
    # y up <= d - r cos(a) and r sin(a) across <= d - r cos(a).
    needed = np.maximum(tall * up + deep, np.hypot(extent.radius * across, deep))
    # The camera must not stand inside a body of no size.
    distance = max(float(np.quantile(needed, 1 - _OUTLIERS)), _NEAREST)
    return _orbit_camera(extent.centre, distance, focal, (width, height), turn, pitch)


def _orbit_camera(
    centre: Tensor,
    distance: float,
    focal: float,
    size: tuple[int, int],
    turn: float,
    pitch: float = 0.0,
) -> Camera:
    """The camera at ``turn`` (0 to 1) of the circle and ``pitch`` above it, looking at the centre."""
    width, height = size
    sine, cosine = math.sin(2 * math.pi * turn), math.cos(2 * math.pi * turn)
    high, level = math.sin(pitch), math.cos(pitch)
    # Rows: the camera's right, down and forward in the world.
    rotation = torch.tensor(
        [
            [cosine, 0.0, -sine],
            [sine * high, -level, cosine * high],
            [-sine * level, -high, -cosine * level],
        ]
    )
    place = centre + distance * torch.tensor([sine * level, high, cosine * level])
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(width, height, intrinsics, rotation, -rotation @ place)
