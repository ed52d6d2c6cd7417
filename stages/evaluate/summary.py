"""The content of ``summary.json``: the statistics of the scores, and every choice that they depend on."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import pandas as pd

from pipeline.config.evaluation_protocol import PHOTOGRAPH, PROTOCOLS, TRUTH, Protocol, ProtocolName
from pipeline.metrics import EROSION
from pipeline.run.stage import Context
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.frame_metrics import Scorer
from stages.evaluate.second_mask import SecondMask
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.statistics import summary_of_scores
from stages.evaluate.test_pose_refinement import RefinedTestPoses
from stages.evaluate.upstream import GateRecord


def summarise(
    context: Context,
    clip: EvaluatedClip,
    table: pd.DataFrame,
    scorer: Scorer,
    nearest: Mapping[int, int],
    refined: RefinedTestPoses,
    gate: GateRecord,
    second: SecondMask,
) -> dict[str, Any]:
    """Means with their intervals, as :func:`summary_of_scores` has them, and what they depend on.

    Args:
        context: names the subject and the settings.
        clip: the clip.
        table: the scores.
        scorer: by which they were made.
        nearest: held-out frame -> its nearest training frame.
        refined: the refined test poses.
        gate: the part of the body that is modelled.
        second: the second masks.
    """
    settings: EvaluateSettings = context.settings
    choices = settings.choices
    return {
        "subject": context.subject,
        "frames": {"train": len(clip.split.train), "test": len(clip.split.test)},
        "frames_of_other_cameras": len(clip.other_cameras),
        "frames_with_second_mask": len(second.masks),
        **summary_of_scores(table, scorer.metrics, settings),
        "nearest": {str(frame): training for frame, training in sorted(nearest.items())},
        "background": scorer.background,
        "choices": {
            "protocol": settings.protocol,
            **dataclasses.asdict(choices),
            "lpips_networks": list(settings.lpips_networks),
            "second_mask": second.source,
            "gate": f"{gate.kept} of {gate.vertices} body vertices",
        },
        "refined": {
            "frames": len(refined.poses),
            "stopped": list(refined.stopped),
            "steps": refined.steps,
        },
        "protocol": protocol_sentences(choices, refined, settings.protocol),
    }


def protocol_sentences(choices: Protocol, refined: RefinedTestPoses, name: ProtocolName | None = None) -> str:
    """The choices behind the numbers in sentences, for the report and for ``summary.json``.

    Args:
        choices: what was chosen.
        refined: the refined test poses.
        name: of the protocol, if it has one.
    """
    return " ".join(
        part for part in (_named(name, choices), *_composited(choices), _refined(refined)) if part
    )


def _named(name: ProtocolName | None, choices: Protocol) -> str:
    if not name:
        return ""
    changed = "" if PROTOCOLS[name] == choices else ", some of its choices changed"
    return f"Protocol {name}{changed}."


def _composited(choices: Protocol) -> list[str]:
    cut = (
        "No more is left of any picture than the truth's mask holds: what the avatar draws beyond it counts "
        "for nothing."
        if choices.render_mask == TRUTH
        else "The truth is cut out by its mask, the avatar by its own alpha."
    )
    photograph = choices.edge_colors == PHOTOGRAPH
    colors = (
        "the photograph's, background and all" if photograph else "the person's own, as ingest found them"
    )
    return [
        f"The person is composited on {choices.background}, in every picture alike, and compared over the "
        "whole image at the stored size; each number is a mean over frames.",
        cut,
        f"Where the truth's mask is soft its colours are {colors}.",
        "PSNR is in dB; person is the mask (alpha above 0.5), inside the mask eroded by "
        f"{EROSION} px, both on black whatever the rest is on.",
    ]


def _refined(refined: RefinedTestPoses) -> str:
    if not refined.poses:
        return ""
    return (
        "Test poses refined: rotation, expression and translation of each held-out frame were fitted "
        f"to that frame itself ({refined.steps} steps), all else fixed; the row without it is at the pose "
        "of the fit."
    )
