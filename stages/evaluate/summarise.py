"""What ``summary.json`` holds."""

from __future__ import annotations

import dataclasses
from typing import Any

from pipeline.stage import Context
from stages.evaluate.assessment import Assessment, Extras
from stages.evaluate.evidence import Evidence
from stages.evaluate.records import Gate
from stages.evaluate.refinement import Refinement
from stages.evaluate.scoring import (
    OTHER_CAMERA,
    VIEWS,
    Scorer,
    differences,
    further_metrics,
    intervals,
    table,
)
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.summary import protocol


def summarise(
    context: Context,
    evidence: Evidence,
    assessment: Assessment,
    scorer: Scorer,
    refinement: Refinement,
    gate: Gate,
    extras: Extras,
) -> dict[str, Any]:
    """Means with their intervals, and every choice that they depend on.

    ``means`` is split -> method -> metric -> mean over frames; ``intervals`` has the same keys and the two
    ends; ``differences`` is method -> metric -> mean, low and high of avatar minus method on held-out
    frames; ``cameras`` is camera -> split -> method -> metric -> mean, where held-out frames come from other
    cameras or there are a mannequin's.
    """
    settings: EvaluateSettings = context.settings
    scores, choices = assessment.scores, settings.choices
    further = further_metrics(scores, scorer.metrics)
    return {
        "subject": context.subject,
        "frames": {"train": len(evidence.split.train), "test": len(evidence.split.test)},
        "frames_of_other_cameras": len(evidence.other_cameras),
        "frames_with_second_mask": len(extras.second.masks),
        "metrics": list(scorer.metrics),
        "further_metrics": further,
        "means": table(scores, scorer.metrics),
        "intervals": intervals(scores, settings),
        "confidence": settings.confidence,
        "differences": differences(scores, [*scorer.metrics, *further], settings),
        "cameras": by_camera(assessment, scorer),
        "nearest": {str(frame): nearest for frame, nearest in sorted(assessment.nearest.items())},
        "background": scorer.background,
        "choices": {
            "protocol": settings.protocol,
            **dataclasses.asdict(choices),
            "lpips_networks": list(settings.lpips_networks),
            "second_mask": extras.second.source,
            "gate": f"{gate.kept} of {gate.vertices} body vertices",
        },
        "refined": {
            "frames": len(refinement.poses),
            "stopped": list(refinement.stopped),
            "steps": refinement.steps,
        },
        "protocol": protocol(choices, refinement, settings.protocol),
    }


def by_camera(assessment: Assessment, scorer: Scorer) -> dict[str, Any]:
    """The means of each camera that is not the training frames'; empty where there is none."""
    views = sorted({one.view for one in assessment.scores if one.split == VIEWS})
    others = any(one.view == OTHER_CAMERA for one in assessment.scores)
    chosen = [*views, *(["", OTHER_CAMERA] if others else [])]
    return {view or "training camera": table(assessment.scores, scorer.metrics, view) for view in chosen}
