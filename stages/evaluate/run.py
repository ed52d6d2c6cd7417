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
from pipeline.body import BodyModel, load_body, read_identity
from pipeline.boxes import Box, person_box
from pipeline.curves import read_curve
from pipeline.frames import write_png, write_video
from pipeline.job import peak_memory, shown
from pipeline.json_files import write_json
from pipeline.metrics import Lpips
from pipeline.metrics.identity import FaceReader
from pipeline.pictures import resized, side_by_side
from pipeline.plan import Plan, read_plan
from pipeline.settings import as_dict
from pipeline.splat import Gaussians, render, write_ply
from pipeline.spread import spread_end_to_end
from pipeline.stage import Context
from pipeline.turntable import orbit, relaxed_pose, visible_extent
from pipeline.versions import versions
from stages.evaluate import STAGE
from stages.evaluate.assessment import Assessment, Extras, assess, scored_frames
from stages.evaluate.curve import draw_curve, draw_fit, draw_scores
from stages.evaluate.evidence import Evidence, read_evidence
from stages.evaluate.mesh import TexturedMesh, textured_mesh
from stages.evaluate.motion import motion_pictures
from stages.evaluate.omissions import omissions
from stages.evaluate.pictures import GAP, comparison_sheet
from stages.evaluate.plan_table import plan_rows
from stages.evaluate.records import (
    Gate,
    StageRecord,
    fit_error,
    fit_seconds,
    read_gate,
    stage_records,
)
from stages.evaluate.refinement import NONE, Refinement, called_for, refine, write_refined
from stages.evaluate.rendering import Animate, animator, follower, on_grey, render_frame, turn_pictures
from stages.evaluate.report import Material, write_report
from stages.evaluate.scoring import Score, Scorer, write_scores
from stages.evaluate.second_mask import second_masks
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.summarise import summarise
from stages.evaluate.summary import show_summary
from stages.evaluate.verdict import Sides, verdict
from stages.evaluate.views import read_filmed, score_views, view_folders

_COVER_HEIGHT = 400  # pixels


def run(context: Context) -> None:
    """Evaluates the trained avatar of one subject.

    Publishes ``metrics.parquet``, ``summary.json``, ``report.html``, ``comparison.png``, ``cover.png``,
    ``turntable.mp4``, ``motion.mp4`` and ``avatar.ply``, and ``test_poses.parquet`` where the test poses were
    refined.

    Raises:
        UserError: a file of an upstream stage or an asset is missing or damaged.
    """
    settings: EvaluateSettings = context.settings
    start = time.monotonic()
    body = load_body(context.body_file)
    avatar = load_avatar(context.inputs["train"] / "avatar.safetensors", body)
    networks = {name: Lpips(context.assets["lpips"], name) for name in settings.lpips_networks}
    evidence, animate = read_evidence(context.inputs), animator(avatar)
    mesh = make_mesh(context, evidence, body)
    extras = Extras(
        mesh=mesh,
        second=second_masks(context, evidence),
        reader=FaceReader(context.assets["dlib"], context.assets["identity"]) if settings.identity else None,
    )
    scorer = Scorer(networks, settings.choices.background)
    views = score_other_cameras(context, evidence, animate, body, mesh)
    evaluate(context, evidence, animate, follower(avatar), scorer, extras, views, start)


def make_mesh(context: Context, evidence: Evidence, body: BodyModel) -> TexturedMesh | None:
    """The textured mesh, where it was asked for and there is anything to compare it in."""
    settings: EvaluateSettings = context.settings
    if not settings.mesh_frames or not (evidence.split.test or view_folders(evidence)):
        return None
    start = time.monotonic()
    identity = read_identity(context.inputs["fit"] / "identity.safetensors", body)
    frames = spread_end_to_end(evidence.split.train, settings.mesh_frames)
    with context.progress(len(frames), "textured mesh") as progress:
        mesh = textured_mesh(evidence, body, identity, frames, progress.advance)
    context.timing("mesh_seconds", time.monotonic() - start)
    return mesh


def score_other_cameras(
    context: Context, evidence: Evidence, animate: Animate, body: BodyModel, mesh: TexturedMesh | None
) -> list[Score]:
    """What a mannequin's other cameras say; nothing for any other subject."""
    if not view_folders(evidence):
        return []
    start = time.monotonic()
    filmed = read_filmed(evidence, body)
    scores = score_views(evidence, animate, mesh, filmed, context.settings.choices.background)
    context.timing("views_seconds", time.monotonic() - start)
    return scores


def evaluate(
    context: Context,
    evidence: Evidence,
    animate: Animate,
    follow: Animate,
    scorer: Scorer,
    extras: Extras | None = None,
    views: list[Score] | None = None,
    start: float | None = None,
) -> None:
    """Evaluates whatever turns a pose into Gaussians; everything is written to ``context.output``.

    Args:
        context: of the run.
        evidence: the clip.
        animate: a pose -> Gaussians.
        follow: the same with gradients that reach the pose; asked only where test poses are refined.
        scorer: the metrics.
        extras: what else is judged, or judges.
        views: scores in cameras that are not the clip's.
        start: when the stage began, by ``time.monotonic``; now if None.
    """
    settings: EvaluateSettings = context.settings
    extras, start = extras or Extras(), time.monotonic() if start is None else start
    plan, gate = read_plan(context.inputs["plan"] / "plan.json"), read_gate(context.inputs["train"])
    refinement = refine_test_poses(context, evidence, plan, follow, scorer.background)
    scoring = time.monotonic()
    with context.progress(len(scored_frames(evidence, settings)), "scoring") as progress:
        assessment = assess(
            evidence, animate, scorer, settings, refinement.poses, progress.advance, extras
        ).with_views(views or [])
    context.timing("scoring_seconds", time.monotonic() - scoring)
    write_scores(context.output / "metrics.parquet", assessment.scores)
    relaxed = relaxed_gaussians(evidence, animate, settings)
    write_ply(context.output / "avatar.ply", relaxed)
    write_turntable(context, relaxed)
    write_motion(context, evidence, animate)
    cover = cover_pictures(evidence, animate, assessment, relaxed)
    write_png(context.output / "cover.png", side_by_side(cover, GAP))
    sheet = comparison_sheet(assessment.comparisons, settings.error_gain)
    write_png(context.output / "comparison.png", sheet)
    summary = summarise(context, evidence, assessment, scorer, refinement, gate, extras)
    summary["gaussians"] = len(relaxed)
    summary["verdict"] = verdict(summary, sides(context, plan, gate))
    write_json(context.output / "summary.json", summary)
    own = own_record(settings, time.monotonic() - start)
    material = gather(context, evidence, assessment, (plan, refinement, gate), summary, cover, own)
    write_report(context.output / "report.html", material)
    show_summary(summary, shown(report_place(context.output)))


def own_record(settings: EvaluateSettings, seconds: float) -> StageRecord:
    """What the report says of the stage that writes it."""
    return StageRecord(STAGE.name, as_dict(settings), seconds, peak_memory(), STAGE.version, "this run")


def sides(context: Context, plan: Plan, gate: Gate) -> Sides:
    """What the clip shows of the person."""
    return Sides(
        1 - gate.kept / gate.vertices, plan["auxiliary_views"].values, fit_error(context.inputs["fit"])
    )


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
    decided: tuple[Plan, Refinement, Gate],
    summary: dict[str, Any],
    cover: list[np.ndarray],
    own: StageRecord,
) -> Material:
    """What the report shows, from this stage and from the upstream stages' folders."""
    fit, train, settings = context.inputs["fit"], context.inputs["train"], context.settings
    plan, refinement, gate = decided
    return Material(
        summary=summary,
        clip=describe_clip(evidence),
        cover=cover,
        comparisons=assessment.slider,
        closeups=assessment.closeups,
        error_gain=settings.error_gain,
        turntable=context.output / "turntable.mp4",
        motion=context.output / "motion.mp4",
        overlay=(fit / "overlay.mp4", fit / "overlay.png"),
        curve=draw_curve(read_curve(train / "curve.parquet", "run the train stage again")),
        fit_curve=draw_fit(read_curve(fit / "curve.parquet", "run the fit stage again"), fit_seconds(fit)),
        plan=plan_rows(plan),
        scores=draw_scores(gate.scores, gate.tau),
        gate=gate.why,
        refinement=refinement_cost(context, refinement),
        score_picture=train / "visibility.png",
        omissions=omissions(evidence, settings, assessment.scores, gate, plan, refinement),
        stages=[*stage_records(context.inputs), own],
        versions=versions(),
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


def write_motion(context: Context, evidence: Evidence, animate: Animate) -> None:
    """Writes ``motion.mp4``, a motion that was never filmed, where it was asked for."""
    settings: EvaluateSettings = context.settings
    if not settings.motion_frames:
        return
    size = (settings.turntable_width, settings.turntable_height)
    expressions, start = evidence.fitted.expression.shape[1], time.monotonic()
    pictures = motion_pictures(animate, expressions, settings.motion_frames, settings.arm_angle, size)
    write_video(context.output / "motion.mp4", pictures, settings.turntable_fps)
    context.timing("motion_seconds", time.monotonic() - start)


def cover_pictures(
    evidence: Evidence, animate: Animate, assessment: Assessment, relaxed: Gaussians
) -> list[np.ndarray]:
    """The report's cover: as filmed, the avatar in that pose, the avatar turned to either side.

    Returns:
        Four pictures [H, W, 3] uint8 RGB of one height, the first and the last two of one width.
    """
    frame = assessment.comparisons[len(assessment.comparisons) // 2].frame
    mask = evidence.mask(frame)
    person = (person_box([mask]) or Box.whole(mask)).slices
    posed = on_grey(render_frame(animate, evidence, frame))
    turned = both_sides(relaxed)
    filmed = evidence.frame(frame)[person]
    return [resized(one, _COVER_HEIGHT) for one in (filmed, posed[person], *turned)]


@torch.no_grad()
def both_sides(gaussians: Gaussians) -> list[np.ndarray]:
    """The avatar from its right and from its left, 40 degrees off the front, cut to what is seen."""
    views = orbit(visible_extent(gaussians), 480, 640, 9)
    renderings = [render(gaussians, view) for view in (views[-1], views[1])]
    masks = [(rendering.alpha.clamp(0, 1) * 255).byte().numpy() for rendering in renderings]
    seen = (person_box(masks) or Box.whole(masks[0])).slices
    return [on_grey(rendering)[seen] for rendering in renderings]


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
