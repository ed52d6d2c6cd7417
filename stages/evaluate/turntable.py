"""A full turn of the canonical avatar in a relaxed pose."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from pipeline.body.joints import JOINT_NAMES
from pipeline.camera import Camera
from pipeline.splat import Gaussians, render
from stages.evaluate.rendering import on_grey

_FIELD = math.radians(25)  # of view, along the image's height; a long lens, as portraits are taken
_FILL = 0.9  # share of the image that the body may take
_OPAQUE = 0.05  # Gaussians below are not part of what is seen
_NEAREST = 0.3  # metres between camera and axis
_REACH = 2.0  # standard deviations of a Gaussian that are seen
_OUTLIERS = 0.005  # share of the Gaussians that do not set the extent


@dataclasses.dataclass(frozen=True)
class Extent:
    """What a turn about the vertical has to show.

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
    """
    rotation = torch.zeros(len(JOINT_NAMES), 3)
    rotation[JOINT_NAMES.index("left_shoulder"), 2] = -arm_angle
    rotation[JOINT_NAMES.index("right_shoulder"), 2] = arm_angle
    return rotation


@torch.no_grad()
def visible_extent(gaussians: Gaussians) -> Extent:
    """The extent of what is seen.

    Gated Gaussians are either absent or transparent; both count for nothing.
    """
    means, sizes = gaussians.means.double(), gaussians.scales.double()
    seen = (gaussians.opacities > _OPAQUE) & means.isfinite().all(1) & sizes.isfinite().all(1)
    if not bool(seen.any()):
        return Extent(torch.zeros(3), np.ones(1), np.ones(1))
    places, reach = means[seen].numpy(), _REACH * sizes[seen].amax(1).numpy()
    low = np.quantile(places - reach[:, None], _OUTLIERS, axis=0)
    high = np.quantile(places + reach[:, None], 1 - _OUTLIERS, axis=0)
    centre = (low + high) / 2
    radius = np.hypot(places[:, 0] - centre[0], places[:, 2] - centre[2]) + reach
    return Extent(torch.from_numpy(centre).float(), radius, np.abs(places[:, 1] - centre[1]) + reach)


def orbit(extent: Extent, width: int, height: int, count: int) -> list[Camera]:
    """Cameras on a level circle around a body, the first before its face (+Z), then to its left.

    They stand as near as they can without cutting anything off at any angle, stray Gaussians apart.

    Args:
        extent: what is filmed.
        width: pixels.
        height: pixels.
        count: of cameras.
    """
    focal = height / 2 / math.tan(_FIELD / 2)
    across, up = (focal / (_FILL * side / 2) for side in (width, height))
    # A point on the radius r at height y is in view from the distance d at every angle a if
    # y up <= d - r cos(a) and r sin(a) across <= d - r cos(a).
    needed = np.maximum(extent.height * up + extent.radius, extent.radius * math.hypot(across, 1))
    # The camera must not stand inside a body of no size.
    distance = max(float(np.quantile(needed, 1 - _OUTLIERS)), _NEAREST)
    size, turns = (width, height), [turn / count for turn in range(count)]
    return [_orbit_camera(extent.centre, distance, focal, size, turn) for turn in turns]


@torch.no_grad()
def turn_pictures(gaussians: Gaussians, cameras: list[Camera]) -> Iterator[np.ndarray]:
    """What each camera sees on grey, [H, W, 3] uint8 RGB."""
    for camera in cameras:
        yield on_grey(render(gaussians, camera))


def _orbit_camera(
    centre: Tensor, distance: float, focal: float, size: tuple[int, int], turn: float
) -> Camera:
    """The camera at ``turn`` (0 to 1) of the circle, looking level at the centre."""
    width, height = size
    sine, cosine = math.sin(2 * math.pi * turn), math.cos(2 * math.pi * turn)
    # Rows: the camera's right, down and forward in the world.
    rotation = torch.tensor([[cosine, 0.0, -sine], [0.0, -1.0, 0.0], [-sine, 0.0, -cosine]])
    place = centre + distance * torch.tensor([sine, 0.0, cosine])
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(width, height, intrinsics, rotation, -rotation @ place)
