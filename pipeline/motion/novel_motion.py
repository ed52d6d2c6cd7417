"""A motion that nobody filmed, to see an avatar move: the head turns, the arms go up, the trunk leans."""

from __future__ import annotations

import math
from collections.abc import Iterator

from torch import Tensor

from pipeline.body.joints import JOINT_NAMES
from pipeline.orbit_cameras import relaxed_pose

HEAD_TURN = 0.6  # radians to either side
ARM_RAISE = 1.9  # radians, from hanging to above the horizontal
LEAN = 0.15  # radians to either side


def motion_poses(count: int, arm_angle: float) -> Iterator[Tensor]:
    """The poses of the motion, [55, 3] rotation vectors each; it ends where it begins.

    The head turns, the arms go up and come down, the trunk leans.

    Args:
        count: frames.
        arm_angle: as of ``relaxed_pose``, where it begins.
    """
    head, neck, spine = (JOINT_NAMES.index(name) for name in ("head", "neck", "spine2"))
    left, right = (JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right"))
    for step in range(count):
        phase = 2 * math.pi * step / count
        rotation = relaxed_pose(arm_angle)
        rotation[head, 1] = rotation[neck, 1] = HEAD_TURN / 2 * math.sin(phase)
        rotation[spine, 2] = LEAN * math.sin(2 * phase)
        raised = ARM_RAISE * (1 - math.cos(phase)) / 2
        rotation[left, 2] += raised
        rotation[right, 2] -= raised
        yield rotation
