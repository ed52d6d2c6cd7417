"""Settings of the plan: each decision can be overridden.

``auto`` decides by the number measured. Structure from motion is decided by ``ingest.cameras`` and face
registration by ``fit.face``; the plan gathers what came of them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS, setting

Choice = Literal["auto", "on", "off"]
Pixels = Annotated[float, Field(ge=0.5, le=1000)]


@dataclass(frozen=True, config=SETTINGS)
class PlanSettings:
    """Settings of the plan stage."""

    face_residual: Choice = setting("auto", "residual colours of the face")
    left_hand_residual: Choice = setting("auto", "of the left hand")
    right_hand_residual: Choice = setting("auto", "of the right hand")
    face_loss: Choice = setting(
        "auto", "the registered face in its texture against the frames; train.face weighs it"
    )
    subdivision: Choice = setting(
        "auto",
        "finer Gaussians, up to train.subdivisions; auto: as fine as the pixels",
    )
    gaussians: Choice = setting(
        "auto", "the bases' Gaussians as dense as the pixels; off: train.subdivisions on the body's vertices"
    )
    edge_pixels: Pixels = setting(
        3.0, "longest edge between neighbouring Gaussians in a training frame; longer ones are split"
    )
    pose_heads: Choice = setting("auto", "shape and colour that follow the pose")
    visibility_gate: Choice = setting("auto", "no Gaussians for what is seen too seldom")
    auxiliary_views: Choice = setting("auto", "generated views of the sides that no frame shows")
    pose_refinement: Choice = setting("auto", "the training frames' poses, learnt jointly")
    test_time_refinement: Choice = setting(
        "auto", "the held-out frames' poses, fitted to their pixels before scoring, however long it takes"
    )
    seen_torso: Choice = setting("auto", "whether the torso is ever seen")
    seen_head: Choice = setting("auto", "whether the head is ever seen")
    seen_face: Choice = setting("auto", "whether the face is ever seen")
    seen_left_arm: Choice = setting("auto", "whether the left arm is ever seen")
    seen_right_arm: Choice = setting("auto", "whether the right arm is ever seen")
    seen_left_hand: Choice = setting("auto", "whether the left hand is ever seen")
    seen_right_hand: Choice = setting("auto", "whether the right hand is ever seen")
    seen_left_leg: Choice = setting("auto", "whether the left leg is ever seen")
    seen_right_leg: Choice = setting("auto", "whether the right leg is ever seen")
