"""What was left out, and why: nothing is skipped silently."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from pipeline.metrics.lpips import NETWORKS
from pipeline.plan import Plan
from pipeline.protocols import PLAN
from stages.evaluate.evidence import Evidence
from stages.evaluate.records import Gate
from stages.evaluate.refinement import EFFECT, Refinement
from stages.evaluate.scoring import HELD_OUT, TRAINING, Score
from stages.evaluate.settings import EvaluateSettings

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
    evidence: Evidence,
    settings: EvaluateSettings,
    scores: Sequence[Score],
    gate: Gate,
    plan: Plan,
    refinement: Refinement,
) -> list[Omission]:
    """What ingest, train and evaluate left out of this avatar and of its numbers."""
    return [
        *_of_the_clip(evidence),
        *_of_the_avatar(gate),
        *_of_the_numbers(evidence, settings, scores),
        *_of_the_poses(evidence, settings, plan, refinement),
    ]


def _of_the_clip(evidence: Evidence) -> list[Omission]:
    footage = evidence.footage
    dropped = [(reason, count) for reason, count in sorted(footage.dropped.items()) if count]
    found = [Omission(_count(count, "frame"), reason) for reason, count in dropped]
    if footage.people > 1:
        why = f"{footage.people} people were noticed; the largest and most central one was followed"
        found.append(Omission("Other people", why))
    if footage.scale < 1:
        why = f"frames were stored at {footage.scale:.2f} of their size (ingest.long_side)"
        found.append(Omission("Finer detail", why))
    return found


def _of_the_avatar(gate: Gate) -> list[Omission]:
    if gate.kept >= gate.vertices:
        return []
    share = 100 * (1 - gate.kept / gate.vertices)
    why = (
        f"{gate.vertices - gate.kept} of {gate.vertices} body vertices ({share:.0f}%) were in too few "
        "training frames, so no Gaussians stand there; in the turn one looks through those places"
    )
    return [Omission("What the clip never showed", why)]


def _of_the_numbers(
    evidence: Evidence, settings: EvaluateSettings, scores: Sequence[Score]
) -> list[Omission]:
    found = []
    learnt_from = len(evidence.split.train)
    if not evidence.split.test:
        why = "every frame was trained on; the numbers say what was memorised"
        found.append(Omission("Held-out numbers", why))
    trained = sum(one.split == TRAINING and one.metric == "psnr" for one in scores)
    if trained < learnt_from:
        why = f"{trained} of {learnt_from} are scored, evenly spaced (evaluate.training_frames)"
        found.append(Omission("Scores of the other training frames", why))
    if evidence.split.test and 0 < settings.baseline_frames < learnt_from:
        why = f"they draw on {settings.baseline_frames} of {learnt_from} (evaluate.baseline_frames)"
        found.append(Omission("Training frames in the baselines", why))
    for network in sorted(set(NETWORKS) - set(settings.lpips_networks)):
        why = f"not asked for (evaluate.lpips_networks){_LPIPS_COST.get(network, '')}"
        found.append(Omission(f"LPIPS with {network}", why))
    if evidence.split.test:
        found += _of_the_extras(settings)
    inside = [one for one in scores if (one.split, one.metric) == (HELD_OUT, "psnr_interior")]
    bare = len({one.frame for one in inside if math.isnan(one.value)})
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
    evidence: Evidence, settings: EvaluateSettings, plan: Plan, refinement: Refinement
) -> list[Omission]:
    if refinement.stopped:
        frames = ", ".join(map(str, refinement.stopped))
        why = f"the loss of {frames} was not finite: shown in the pose of the fit, under both names"
        return [Omission("Refinement of " + _count(len(refinement.stopped), "test pose"), why)]
    if refinement.poses or not evidence.split.test:
        return []
    asked = settings.choices.refine_test_poses
    named = (
        "refine_test_poses=off" if settings.refine_test_poses == asked else f"protocol={settings.protocol}"
    )
    reason = plan[EFFECT].why if asked == PLAN else f"evaluate.{named}"
    why = (
        "held-out frames are shown in the pose that the fit found from their keypoints, not their pixels: "
        + reason
    )
    return [Omission("Test-time pose refinement", why)]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")
