"""What can be set about the plan: each decision can be taken out of its hands.

``auto`` decides by the number measured. Structure from motion is decided by ``ingest.cameras`` and face
registration by ``fit.face``; the plan gathers what came of them.
"""

from __future__ import annotations

import dataclasses

CHOICES = ("auto", "on", "off")


@dataclasses.dataclass(frozen=True)
class PlanSettings:
    """Settings of the plan stage: ``auto``, ``on`` or ``off`` each."""

    face_residual: str = "auto"  # residual colours of the face
    left_hand_residual: str = "auto"  # of the left hand
    right_hand_residual: str = "auto"  # of the right hand
    face_loss: str = "auto"  # the registered face in its texture against the frames; train.face weighs it
    # Finer Gaussians, up to train.subdivisions: auto, as fine as the pixels; on, whatever the pixels
    subdivision: str = "auto"
    pose_heads: str = "auto"  # shape and colour that follow the pose
    visibility_gate: str = "auto"  # no Gaussians for what is seen too seldom
    auxiliary_views: str = "auto"  # generated views of the sides that no frame shows
    pose_refinement: str = "auto"  # the training frames' poses, learnt jointly
    test_time_refinement: str = "auto"  # the held-out frames' poses, fitted to their pixels before scoring

    # Whether a part of the body is ever seen
    seen_torso: str = "auto"
    seen_head: str = "auto"
    seen_face: str = "auto"
    seen_left_arm: str = "auto"
    seen_right_arm: str = "auto"
    seen_left_hand: str = "auto"
    seen_right_hand: str = "auto"
    seen_left_leg: str = "auto"
    seen_right_leg: str = "auto"

    def __post_init__(self) -> None:
        """Refuse other words."""
        for field in dataclasses.fields(self):
            if (value := getattr(self, field.name)) not in CHOICES:
                raise ValueError(f"plan.{field.name} must be one of {', '.join(CHOICES)}, not {value}")
