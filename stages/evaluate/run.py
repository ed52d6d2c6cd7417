"""The evaluate stage: reads what the other stages published, judges the avatar, writes the report."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline import artifact
from pipeline.avatar import load_avatar
from pipeline.body import load_body
from pipeline.curves import read_curve
from pipeline.frames import write_png, write_video
from pipeline.job import shown
from pipeline.metrics import Lpips
from pipeline.plan import Plan, read_plan
from pipeline.records import write_json
from pipeline.settings import as_dict
from pipeline.splat import Gaussians, render, write_ply
from pipeline.stage import Context
from stages.evaluate.assessment import Assessment, assess, scored_frames
from stages.evaluate.curve import draw_curve, draw_fit, draw_scores
from stages.evaluate.evidence import Evidence, read_evidence
from stages.evaluate.omissions import omissions
from stages.evaluate.pictures import beside, comparison_sheet, person_box, resized
from stages.evaluate.plan_table import plan_rows
from stages.evaluate.records import StageRecord, fit_seconds, plan_savings, read_gate, stage_records
from stages.evaluate.refinement import NONE, Refinement, called_for, refine, write_refined
from stages.evaluate.rendering import Animate, animator, follower, on_grey, render_frame
from stages.evaluate.report import Material, write_report
from stages.evaluate.scoring import Scorer, table, write_scores
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.summary import protocol, show_summary
from stages.evaluate.turntable import orbit, relaxed_pose, turn_pictures, visible_extent

_COVER_HEIGHT = 400  # pixels


def run(context: Context) -> None:
    """Evaluates the trained avatar of one subject.

    Publishes ``metrics.parquet``, ``summary.json``, ``report.html``, ``comparison.png``, ``cover.png``,
    ``turntable.mp4`` and ``avatar.ply``, and ``test_poses.parquet`` where the test poses were refined.

    Raises:
        UserError: a file of an upstream stage or an asset is missing or damaged.
    """
    avatar = load_avatar(context.inputs["train"] / "avatar.safetensors", load_body(context.body_file))
    networks = {name: Lpips(context.assets["lpips"], name) for name in context.settings.lpips_networks}
    scorer = Scorer(networks, context.settings.background)
    evaluate(context, read_evidence(context.inputs), animator(avatar), follower(avatar), scorer)


def evaluate(context: Context, evidence: Evidence, animate: Animate, follow: Animate, scorer: Scorer) -> None:
    """Evaluates whatever turns a pose into Gaussians; everything is written to ``context.output``.

    Args:
        context: of the run.
        evidence: the clip.
        animate: a pose -> Gaussians.
        follow: the same with gradients that reach the pose; asked only where test poses are refined.
        scorer: the metrics.
    """
    settings: EvaluateSettings = context.settings
    start = time.monotonic()
    plan = read_plan(context.inputs["plan"] / "plan.json")
    refinement = refine_test_poses(context, evidence, plan, follow, scorer.background)
    scoring = time.monotonic()
    with context.progress(len(scored_frames(evidence, settings)), "scoring") as progress:
        assessment = assess(evidence, animate, scorer, settings, refinement.poses, progress.advance)
    context.timing("scoring_seconds", time.monotonic() - scoring)
    write_scores(context.output / "metrics.parquet", assessment.scores)
    relaxed = relaxed_gaussians(evidence, animate, settings)
    write_ply(context.output / "avatar.ply", relaxed)
    write_turntable(context, relaxed)
    cover = cover_pictures(evidence, animate, assessment, relaxed)
    write_png(context.output / "cover.png", beside(cover))
    sheet = comparison_sheet(assessment.comparisons, settings.error_gain)
    write_png(context.output / "comparison.png", sheet)
    summary = summarise(context, evidence, assessment, scorer, refinement, len(relaxed))
    write_json(context.output / "summary.json", summary)
    own = StageRecord("evaluate", as_dict(settings), time.monotonic() - start)
    material = gather(context, evidence, assessment, (plan, refinement), summary, cover, own)
    write_report(context.output / "report.html", material)
    show_summary(summary, shown(report_place(context.output)))


def refine_test_poses(
    context: Context, evidence: Evidence, plan: Plan, follow: Animate, background: str
) -> Refinement:
    """Refines the held-out frames' poses where that is called for, and publishes them."""
    settings: EvaluateSettings = context.settings
    frames = evidence.split.test
    if not frames or not called_for(settings, plan):
        return NONE
    start = time.monotonic()
    with context.progress(len(frames), "refining test poses") as progress:
        refinement = refine(evidence, follow, background, settings.refine_steps, progress.advance)
    context.timing("refinement_seconds", time.monotonic() - start)
    write_refined(context.output / "test_poses.parquet", refinement)
    context.log(refinement_cost(context, refinement))
    return refinement


def refinement_cost(context: Context, refinement: Refinement) -> str:
    """What refining the test poses took, in a sentence; nothing where they were not refined."""
    if not refinement.poses:
        return ""
    seconds = context.timings["refinement_seconds"]
    each = f"{len(refinement.poses)} frames, {refinement.steps} steps each"
    stopped = ", ".join(map(str, refinement.stopped))
    left = f" The loss of {stopped} was not finite: the pose of the fit was kept there." if stopped else ""
    return f"Refining the test poses took {seconds:.1f} s: {each}.{left}"


def gather(
    context: Context,
    evidence: Evidence,
    assessment: Assessment,
    decided: tuple[Plan, Refinement],
    summary: dict[str, Any],
    cover: list[np.ndarray],
    own: StageRecord,
) -> Material:
    """What the report shows, from this stage and from the upstream stages' folders."""
    fit, train, settings = context.inputs["fit"], context.inputs["train"], context.settings
    gate = read_gate(train)
    plan, refinement = decided
    return Material(
        summary=summary,
        clip=describe_clip(evidence),
        cover=cover,
        comparisons=assessment.comparisons,
        error_gain=settings.error_gain,
        turntable=context.output / "turntable.mp4",
        overlay=(fit / "overlay.mp4", fit / "overlay.png"),
        curve=draw_curve(read_curve(train / "curve.parquet", "run the train stage again")),
        fit_curve=draw_fit(read_curve(fit / "curve.parquet", "run the fit stage again"), fit_seconds(fit)),
        plan=plan_rows(plan, plan_savings(train)),
        scores=draw_scores(gate.scores, gate.tau),
        gate=gate.why,
        refinement=refinement_cost(context, refinement),
        score_picture=train / "visibility.png",
        omissions=omissions(evidence, settings, assessment.scores, gate, plan, refinement),
        stages=[*stage_records(context.inputs), own],
    )


@torch.no_grad()
def relaxed_gaussians(evidence: Evidence, animate: Animate, settings: EvaluateSettings) -> Gaussians:
    """The canonical avatar in the turn's pose, facing +Z at the origin, without expression."""
    expression = torch.zeros(evidence.fitted.expression.shape[1])
    return animate(relaxed_pose(settings.arm_angle), expression, torch.zeros(3), None)


def write_turntable(context: Context, gaussians: Gaussians) -> None:
    """Writes ``turntable.mp4``."""
    settings: EvaluateSettings = context.settings
    size = (settings.turntable_width, settings.turntable_height)
    cameras = orbit(visible_extent(gaussians), *size, settings.turntable_frames)
    start = time.monotonic()
    with context.progress(len(cameras), "turntable") as progress:

        def pictures() -> Iterator[np.ndarray]:
            for picture in turn_pictures(gaussians, cameras):
                yield picture
                progress.advance()

        write_video(context.output / "turntable.mp4", pictures(), settings.turntable_fps)
    context.timing("turntable_seconds", time.monotonic() - start)


def cover_pictures(
    evidence: Evidence, animate: Animate, assessment: Assessment, relaxed: Gaussians
) -> list[np.ndarray]:
    """The report's cover: as filmed, the avatar in that pose, the avatar turned to either side.

    Returns:
        Four pictures [H, W, 3] uint8 RGB of one height, the first and the last two of one width.
    """
    frame = assessment.comparisons[len(assessment.comparisons) // 2].frame
    left, top, right, bottom = person_box([evidence.mask(frame)])
    posed = on_grey(render_frame(animate, evidence, frame))
    turned = both_sides(relaxed)
    filmed = evidence.frame(frame)[top:bottom, left:right]
    return [resized(one, _COVER_HEIGHT) for one in (filmed, posed[top:bottom, left:right], *turned)]


@torch.no_grad()
def both_sides(gaussians: Gaussians) -> list[np.ndarray]:
    """The avatar from its right and from its left, 40 degrees off the front, cut to what is seen."""
    views = orbit(visible_extent(gaussians), 480, 640, 9)
    renderings = [render(gaussians, view) for view in (views[-1], views[1])]
    masks = [(rendering.alpha.clamp(0, 1) * 255).byte().numpy() for rendering in renderings]
    left, top, right, bottom = person_box(masks)
    return [on_grey(rendering)[top:bottom, left:right] for rendering in renderings]


def summarise(
    context: Context,
    evidence: Evidence,
    assessment: Assessment,
    scorer: Scorer,
    refinement: Refinement,
    gaussians: int,
) -> dict[str, Any]:
    """What ``summary.json`` holds."""
    return {
        "subject": context.subject,
        "frames": {"train": len(evidence.split.train), "test": len(evidence.split.test)},
        "gaussians": gaussians,
        "metrics": list(scorer.metrics),
        "means": table(assessment.scores, scorer.metrics),
        "nearest": {str(frame): nearest for frame, nearest in sorted(assessment.nearest.items())},
        "background": scorer.background,
        "refined": {
            "frames": len(refinement.poses),
            "stopped": list(refinement.stopped),
            "steps": refinement.steps,
        },
        "protocol": protocol(scorer.background, refinement),
    }


def describe_clip(evidence: Evidence) -> str:
    """One sentence on where the avatar comes from."""
    footage = evidence.footage
    frames = f"{len(evidence.split.train)} frames to learn from and {len(evidence.split.test)} held out"
    return f"Made from {footage.name} ({footage.width} × {footage.height}): {frames}."


def report_place(output: Path) -> Path:
    """Where the report lies once the stage's result is published."""
    if output.parent.name.startswith(artifact.SCRATCH):
        return output.parent.parent / artifact.LATEST / "report.html"
    return output / "report.html"
