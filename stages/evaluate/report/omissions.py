"""The list of what was left out, and why: nothing is skipped silently."""

from __future__ import annotations

import dataclasses

import pandas as pd

from pipeline.clip.plan import Plan
from pipeline.clip.records import Footage, Split
from pipeline.config.evaluation_protocol import PLAN
from pipeline.metrics.lpips import NETWORKS
from stages.evaluate.scores import HELD_OUT, TRAINING
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.test_pose_refinement import EFFECT, RefinedTestPoses
from stages.evaluate.upstream import GateRecord

_LPIPS_COST = {"vgg": "; on a CPU it takes twenty times as long as alex"}


@dataclasses.dataclass(frozen=True)
class Omission:
    """Something that was not done.

    Attributes:
        what: in a few words.
        why: the reason, with the number that decided it.
    """

    what: str
    why: str


def omissions(
    footage: Footage,
    split: Split,
    settings: EvaluateSettings,
    table: pd.DataFrame,
    gate: GateRecord,
    plan: Plan,
    refined: RefinedTestPoses,
    representation: str | None,
) -> list[Omission]:
    """The parts that ingest, train and evaluate left out of this avatar and of its numbers."""
    return [
        *_of_the_clip(footage),
        *_of_the_avatar(gate, representation),
        *_of_the_numbers(split, settings, table),
        *_of_the_poses(split, settings, plan, refined),
    ]


def _of_the_clip(footage: Footage) -> list[Omission]:
    dropped = [(reason, count) for reason, count in sorted(footage.dropped.items()) if count]
    found = [Omission(_count(count, "frame"), reason) for reason, count in dropped]
    if footage.people > 1:
        why = f"{footage.people} people were noticed; one was followed, ingest.person chooses another"
        found.append(Omission("Other people", why))
    if footage.scale < 1:
        why = f"frames were stored at {footage.scale:.2f} of their size (ingest.long_side)"
        found.append(Omission("Finer detail", why))
    return found


def _of_the_avatar(gate: GateRecord, representation: str | None) -> list[Omission]:
    found = []
    if representation == "bases":
        why = "linear bases follow pose and face in place of heads (train.representation=bases)"
        found.append(Omission("Triplane, pose heads and residual colours", why))
    if gate.kept >= gate.vertices:
        return found
    share = 100 * (1 - gate.kept / gate.vertices)
    why = (
        f"{gate.vertices - gate.kept} of {gate.vertices} body vertices ({share:.0f}%) were in too few "
        "training frames, so no Gaussians stand there; in the turn one looks through those places"
    )
    return [*found, Omission("What the clip never showed", why)]


def _of_the_numbers(split: Split, settings: EvaluateSettings, table: pd.DataFrame) -> list[Omission]:
    found = []
    learnt_from = len(split.train)
    if not split.test:
        why = "every frame was trained on; the numbers say what was memorised"
        found.append(Omission("Held-out numbers", why))
    trained = int(((table["split"] == TRAINING) & (table["metric"] == "psnr")).sum())
    if trained < learnt_from:
        why = f"{trained} of {learnt_from} are scored, evenly spaced (evaluate.training_frames)"
        found.append(Omission("Scores of the other training frames", why))
    if split.test and 0 < settings.baseline_frames < learnt_from:
        why = f"they draw on {settings.baseline_frames} of {learnt_from} (evaluate.baseline_frames)"
        found.append(Omission("Training frames in the baselines", why))
    for network in sorted(set(NETWORKS) - set(settings.lpips_networks)):
        why = f"not asked for (evaluate.lpips_networks){_LPIPS_COST.get(network, '')}"
        found.append(Omission(f"LPIPS with {network}", why))
    if split.test:
        found += _of_the_extras(settings)
    inside = table[(table["split"] == HELD_OUT) & (table["metric"] == "psnr_interior")]
    bare = inside.loc[inside["value"].isna(), "frame"].nunique()
    if bare:
        found.append(Omission("Interior of " + _count(bare, "frame"), "the eroded mask is empty there"))
    return found


def _of_the_extras(settings: EvaluateSettings) -> list[Omission]:
    missing = {
        "The ceiling by masks": settings.second_mask == "off" and "evaluate.second_mask=off",
        "The textured mesh": settings.mesh_frames == 0 and "evaluate.mesh_frames=0",
        "Whose face it is": not settings.identity
        and "evaluate.identity=true asks for it; it fetches dlib and its weights (100 MB)",
        "A motion never filmed": settings.motion_frames == 0 and "evaluate.motion_frames=0",
    }
    return [Omission(what, why) for what, why in missing.items() if why]


def _of_the_poses(
    split: Split, settings: EvaluateSettings, plan: Plan, refined: RefinedTestPoses
) -> list[Omission]:
    if refined.stopped:
        frames = ", ".join(map(str, refined.stopped))
        why = f"the loss of {frames} was not finite: shown in the pose of the fit, under both names"
        return [Omission("Refinement of " + _count(len(refined.stopped), "test pose"), why)]
    if refined.poses:
        left = len(split.test) - len(refined.poses)
        why = f"its cost is bounded by evaluate.refine_share={settings.refine_share:g}"
        return [Omission(f"Refinement of {_count(left, 'held-out pose')}", why)] if left else []
    if not split.test:
        return []
    asked = settings.choices.refine_test_poses
    named = (
        "refine_test_poses=off" if settings.refine_test_poses == asked else f"protocol={settings.protocol}"
    )
    bounded = (
        f"{plan[EFFECT].why}; evaluate.refine_share={settings.refine_share:g} of training's work allows none"
    )
    reason = f"evaluate.{named}" if asked != PLAN else plan[EFFECT].why if plan[EFFECT].forced else bounded
    why = (
        "held-out frames are shown in the pose that the fit found from their keypoints, not their pixels: "
        + reason
    )
    return [Omission("Test-time pose refinement", why)]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")
