"""How long a body's legs are, which is what a walk scales with."""

from __future__ import annotations

import dataclasses

from torch import Tensor

from pipeline.body import BodyModel, Identity, joint_index, mean_identity, rest_joints

_CHAIN = ("left_hip", "left_knee", "left_ankle")


def leg_length(joints: Tensor) -> float:
    """From the left hip by the knee to the ankle, metres; joints [55, 3] at rest."""
    hip, knee, ankle = (joints[joint_index(name)] for name in _CHAIN)
    return float((hip - knee).norm() + (knee - ankle).norm())


def leg_of(body: BodyModel, betas: Tensor | None = None, identity: Identity | None = None) -> float:
    """The leg of an identity, or of a shape, or of the mean body, metres."""
    if identity is None:
        identity = mean_identity(body)
        if betas is not None:
            known = body.shape_directions.shape[2]
            identity = dataclasses.replace(identity, betas=betas[:known])
    return leg_length(rest_joints(body, identity))
