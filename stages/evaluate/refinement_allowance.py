"""The frames and steps that refining held-out poses may take, before it begins.

Both numbers, at the fit's poses and at refined ones, stand in every report. Where nobody asks for the
refinement it may take a share of training's own work, counted in steps times pixels: equal runs then do equal
work, which a share of the seconds would not give.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from pipeline.clip.boxes import MARGIN
from pipeline.clip.curves import CurvePoints
from pipeline.clip.frames import spread_end_to_end
from pipeline.clip.plan import Plan
from pipeline.config.evaluation_protocol import ON, PLAN
from pipeline.errors import UserError
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.test_pose_refinement import EFFECT

LEAST_STEPS = 12
"""Steps a frame, under which fewer frames are refined instead: a pose has moved by a centimetre by then."""


@dataclasses.dataclass(frozen=True)
class Allowance:
    """What the refinement may cost.

    Attributes:
        frames: those that are refined.
        steps: a frame.
        why: a sentence for the log, with the cost; empty where nothing is refined.
    """

    frames: tuple[int, ...]
    steps: int
    why: str


def is_asked_for(settings: EvaluateSettings, plan: Plan) -> bool | None:
    """True and False where the protocol or a setting says so, evaluate's or the plan's; None otherwise."""
    asked = settings.choices.refine_test_poses
    if asked != PLAN:
        return asked == ON
    return plan.on(EFFECT) if plan[EFFECT].forced else None


def allowance(
    clip: EvaluatedClip, settings: EvaluateSettings, asked: bool | None, training_steps: int
) -> Allowance:
    """The frames and steps of the refinement.

    All of both where it is asked for. Otherwise a share of training's work: first each frame gets fewer
    steps, then there are fewer frames.

    Args:
        clip: the clip.
        settings: how many steps at most, and the share.
        asked: of ``is_asked_for``.
        training_steps: how many steps training took.
    """
    frames, steps = clip.split.test, settings.refine_steps
    if asked is False or not frames:
        return Allowance((), 0, "")
    try:
        box = clip.person_box(MARGIN)
    except UserError:  # no mask of a training frame shows anybody: there is nothing to lay a pose on
        return Allowance((), 0, "")
    work = max(training_steps * box.width * box.height, 1)
    pixels = float(np.mean([clip.cameras[frame].width * clip.cameras[frame].height for frame in frames]))
    count, bound = len(frames), ""
    if asked is None:
        affordable = settings.refine_share * work / pixels
        steps = min(steps, max(int(affordable / len(frames)), min(LEAST_STEPS, steps)))
        count, bound = (
            min(len(frames), int(affordable / steps)),
            f" (evaluate.refine_share={settings.refine_share:g})",
        )
    if not count:
        return Allowance((), 0, "")
    chosen = tuple(spread_end_to_end(frames, count))
    why = (
        f"refines {len(chosen)} of {len(frames)} held-out poses on their pictures, {steps} steps each: about "
        f"{len(chosen) * steps * pixels / work:.0%} of training's work{bound}"
    )
    return Allowance(chosen, steps, why)


def steps_of(curve: Mapping[str, CurvePoints]) -> int:
    """The number of steps of training, from its curve."""
    return max((iteration for points in curve.values() for iteration, _ in points), default=0)
