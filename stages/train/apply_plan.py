"""The settings of a run with the plan applied: what the plan calls needless is not built."""

from __future__ import annotations

import dataclasses

from pipeline.clip.plan import Plan
from stages.train.settings import TrainSettings

RESIDUALS = ("face", "left_hand", "right_hand")
MOST_LEVELS = 2  # of subdivision, that train.subdivisions can ask for


def apply_plan(settings: TrainSettings, plan: Plan) -> TrainSettings:
    """The settings with what the plan calls needless switched off; the plan switches nothing on.

    Args:
        settings: as set.
        plan: of the subject.
    """
    needless = {part for part in RESIDUALS if not plan.on(f"{part}_residual")}
    parts = tuple(part for part in settings.residual_parts if part not in needless)
    return dataclasses.replace(
        settings,
        residual_parts=parts,
        residual_from=settings.residual_from if parts else 1.0,
        subdivisions=min(settings.subdivisions, subdivision_levels(plan)),
        pose_heads_from=settings.pose_heads_from if plan.on("pose_heads") else 1.0,
        refine_poses=settings.refine_poses and plan.on("pose_refinement"),
        face=settings.face if plan.on("face_loss") else 0.0,
        gate=settings.gate and plan.on("visibility_gate"),
    )


def subdivision_levels(plan: Plan) -> int:
    """The most levels of subdivision that the plan allows: all where a setting switched it on."""
    decision = plan["subdivision"]
    if not decision.on:
        return 0
    return MOST_LEVELS if decision.forced or not decision.values else int(decision.values[0])
