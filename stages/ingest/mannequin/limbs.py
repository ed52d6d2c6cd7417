"""Which limb a joint or a vertex belongs to: a limb does not hide its own joints from a detector."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from pipeline.body import PARTS, BodyModel, part_labels
from pipeline.body.joints import BODY_POSE
from pipeline.body.parts import joint_parts

_LIMBS = {"left_arm": 1, "left_hand": 1, "right_arm": 2, "right_hand": 2, "left_leg": 3, "right_leg": 4}
_OF_PART = np.array([_LIMBS.get(part, 0) for part in PARTS], np.int8)


def limbs_of_vertices(body: BodyModel) -> np.ndarray:
    """The limb of each vertex: [V] int8; 0 on trunk and head, 1 to 4 on arms and legs."""
    return _OF_PART[part_labels(body).numpy()]


def limbs_of_joints(joint: Tensor) -> np.ndarray:
    """The limb of points [K] that are joints; -1 for fingers, points of the surface (-1), trunk and head."""
    limbs = _OF_PART[joint_parts().numpy()]
    limbs[limbs == 0] = -1
    limbs[BODY_POSE.stop :] = -1  # fingers do hide one another
    return np.where(joint.numpy() >= 0, limbs[joint.clamp_min(0).numpy()], -1)
