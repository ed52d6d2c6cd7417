"""Joint limits: soft bounds on the components of their rotation vectors.

Axes are the schema's: in the T pose the arms lie along X with the palms down, so that an elbow bends
about Y, a finger bends about Z, and X is the twist of either. Left and right mirror each other in Y and
Z. The limits are those of a supple adult with some slack; they keep a single camera's ambiguities and
failed hand detections from folding a joint backwards.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch
from torch import Tensor

from pipeline.body.joints import FINGERS, joint_index

_FREE = 10.0  # radians: no limit


@dataclasses.dataclass(frozen=True)
class JointLimits:
    """Limits of K components of theta.

    Attributes:
        joint, axis: [K], which component.
        low, high: [K], radians.
    """

    joint: Tensor
    axis: Tensor
    low: Tensor
    high: Tensor

    def of(self, rotation: Tensor) -> Tensor:
        """The limited components: rotation vectors [T, 55, 3] -> [T, K]."""
        return rotation.flatten(1)[:, 3 * self.joint + self.axis]


def joint_limits() -> JointLimits:
    """The limits of knees, elbows, wrists, fingers and the jaw."""
    joints, axes, lows, highs = zip(*_limits(), strict=True)
    indices = torch.tensor([joint_index(name) for name in joints])
    return JointLimits(indices, torch.tensor(axes), torch.tensor(lows), torch.tensor(highs))


def _limits() -> Iterator[tuple[str, int, float, float]]:
    """Joint, axis, lowest and highest angle."""
    yield "jaw", 0, 0.0, 0.7
    for side in ("left", "right"):
        yield f"{side}_knee", 0, 0.0, _FREE
        yield _bending(side, "elbow", 1, 0.0, _FREE)
        for axis, most in ((0, 1.5), (1, 0.7), (2, 1.4)):
            yield f"{side}_wrist", axis, -most, most
        for finger in FINGERS:
            yield from _thumb(side) if finger == "thumb" else _finger(side, finger)


def _finger(side: str, finger: str) -> Iterator[tuple[str, int, float, float]]:
    for knuckle in (1, 2, 3):
        name = f"{finger}{knuckle}"
        sideways = 0.35 if knuckle == 1 else 0.1
        yield f"{side}_{name}", 0, -sideways, sideways
        yield f"{side}_{name}", 1, -sideways, sideways
        yield _bending(side, name, 2, -0.4 if knuckle == 1 else 0.0, 1.7 if knuckle < 3 else 1.3)


def _thumb(side: str) -> Iterator[tuple[str, int, float, float]]:
    for knuckle, most in ((1, 0.9), (2, 0.9), (3, 1.2)):
        for axis in range(3):
            yield f"{side}_thumb{knuckle}", axis, -most, most


def _bending(side: str, name: str, axis: int, low: float, high: float) -> tuple[str, int, float, float]:
    """Limits of an angle that is positive where the joint bends on the right, negative on the left."""
    return (f"{side}_{name}", axis, low, high) if side == "right" else (f"{side}_{name}", axis, -high, -low)
