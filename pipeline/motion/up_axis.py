"""The axis of a motion's world that points up, and the turn that makes it Y.

Skeletons and worlds are made with Y up or Z up, now and then upside down, and no format says which. A capture
has two witnesses: its skeleton, whose trunk points up where all angles are zero, and its motion, in which the
body stands most of the time. Where they disagree, the ground decides: people stand, or lie, on height zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

import roma
import torch
from torch import Tensor

from pipeline.config.choices import UpAxis

_QUARTER = torch.pi / 2
_TURNS: Mapping[UpAxis, tuple[float, float, float]] = {  # rotation vectors that make the axis Y
    "x": (0, 0, _QUARTER), "y": (0, 0, 0), "z": (-_QUARTER, 0, 0),
    "-x": (0, 0, -_QUARTER), "-y": (2 * _QUARTER, 0, 0), "-z": (_QUARTER, 0, 0),
}  # fmt: skip
AXES: Mapping[UpAxis, Tensor] = {
    axis: (-1.0 if axis[0] == "-" else 1.0) * torch.eye(3, dtype=torch.float64)["xyz".index(axis[-1])]
    for axis in get_args(UpAxis)
}

_STANDS = 0.7  # mean cosine between the body and an axis from which on it is said to stand along it
_ON_GROUND = 0.25  # distance from height zero, of a leg's length


def turn_to_y(up: UpAxis) -> Tensor:
    """The rotation [3, 3] float64 after which an axis is Y; of Z, (x, y, z) becomes (x, z, -y)."""
    return roma.rotvec_to_rotmat(torch.tensor(_TURNS[up], dtype=torch.float64))


def nearest_axis(direction: Tensor, among: tuple[UpAxis, ...] = tuple(AXES)) -> tuple[UpAxis, float]:
    """The axis that points most as a direction [3] does, and their dot product."""
    dots = {axis: float(direction @ AXES[axis].to(direction)) for axis in among}
    best = max(dots, key=lambda axis: dots[axis])
    return best, dots[best]


def find_up(upward: Tensor, places: Tensor, leg: float, skeleton: UpAxis | None) -> tuple[UpAxis, str]:
    """The axis that is up in a capture, and what says so, for people.

    Args:
        upward: [T, 3] from the feet to the top of the trunk, in any length.
        places: [T, N, 3] of all joints.
        leg: a leg's length, in the same unit.
        skeleton: the axis along which the skeleton stands where all angles are zero; None where it does not.
    """
    mean = torch.nn.functional.normalize(upward, dim=-1).mean(0)
    moving, share = nearest_axis(mean)
    if skeleton is None:
        return moving, "its motion" if share >= _STANDS else "its motion, which leaves doubt"
    if skeleton == moving:
        return moving, "its skeleton and its motion"
    if share < _STANDS:
        return skeleton, "its skeleton"
    lies = not _on_ground(places, moving, leg) and _on_ground(places, skeleton, leg)
    return (skeleton, "its skeleton; the body lies") if lies else (moving, "its motion, against its skeleton")


def _on_ground(places: Tensor, axis: UpAxis, leg: float) -> bool:
    """True if the lowest joints along an axis are at height zero most of the time."""
    lowest = (places @ AXES[axis].to(places)).amin(-1)
    return bool(lowest.median().abs() < _ON_GROUND * leg)
