"""The evaluate stage: reads what the other stages published, scores the methods, writes the report."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from pipeline.avatar import Avatar, load_avatar
from pipeline.body import Pose
from pipeline.clip.curves import read_curve
from pipeline.clip.frames import spread_end_to_end, write_png, write_video
from pipeline.clip.plan import EFFECTS, Plan, read_plan
from pipeline.clip.records import write_json
from pipeline.config.evaluation_protocol import PHOTOGRAPH
from pipeline.config.settings import as_dict
from pipeline.detection.mediapipe import FaceFinder
from pipeline.metrics import Lpips
from pipeline.metrics.face_identity import FaceRecognizer
from pipeline.orbit_cameras import orbit, relaxed_pose, visible_extent
from pipeline.pictures import side_by_side
from pipeline.run.job import peak_memory, shown
from pipeline.run.stage import Context
from pipeline.run.versions import versions
from pipeline.splat import Gaussians
from pipeline.store import artifact
from pipeline.viewer.page import viewer_page
from pipeline.viewer.shown import NOVEL_FRAMES, filmed_motion, novel_motion, packed_avatar
from stages.evaluate import STAGE
from stages.evaluate.baselines import frame_baselines
from stages.evaluate.evaluated_clip import EvaluatedClip, read_evaluated_clip
from stages.evaluate.exports import Rig, avatar_rig, write_exports
from stages.evaluate.frame_metrics import AlignedFaceEmbedder, FaceEmbedder, Scorer, open_arcface
from stages.evaluate.methods import (
    AVATAR,
    REFINED,
    Animate,
    AvatarMethod,
    Method,
    baked_animation,
    pose_gradient_animation,
)
from stages.evaluate.other_cameras import camera_folders, read_true_surface, score_other_cameras
from stages.evaluate.refinement_allowance import allowance, is_asked_for, steps_of
from stages.evaluate.report.omissions import omissions
from stages.evaluate.report.page import ReportContents, video_uri, write_report
from stages.evaluate.report.pictures import (
    GAP,
    Comparisons,
    comparison_sheet,
    cover_pictures,
    empty_comparisons,
)
from stages.evaluate.report.plots import plot_registration, plot_training, plot_visibility
from stages.evaluate.report.terminal import show_summary
from stages.evaluate.report.videos import motion_pictures, turntable_pictures
from stages.evaluate.scores import TableRow, frames_to_score, score_clip, score_table, write_scores
from stages.evaluate.second_mask import SecondMask, no_second_mask, second_mask
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.summary import summarise
from stages.evaluate.test_pose_refinement import (
    NOT_REFINED,
    PictureLoss,
    RefinedTestPoses,
    refine,
    write_refined,
)
from stages.evaluate.textured_mesh import TexturedMesh, textured_mesh
from stages.evaluate.turned import SeenSurface, Turned, look_around, seen_surface
from stages.evaluate.upstream import (
    GateRecord,
    StageRecord,
    fit_error,
    fit_seconds,
    read_gate,
    stage_records,
    trained_representation,
)
from stages.evaluate.verdict import ClipCoverage, verdict


def run(context: Context) -> None:
    """Evaluates the trained avatar of one subject.

    Publishes ``metrics.parquet``, ``summary.json``, ``report.html``, ``comparison.png``, ``cover.png``,
    ``turntable.mp4``, ``motion.mp4``, the splats ``avatar.ply``, ``avatar.spz`` and ``avatar_splats.glb``,
    the rigged mesh ``avatar.glb``; ``avatar.html`` where it was asked for, and ``test_poses.parquet`` where
    the test poses were refined.

    Raises:
        UserError: a file of an upstream stage or an asset is missing or damaged.
    """
    settings: EvaluateSettings = context.settings
    start = time.monotonic()
    clip = read_evaluated_clip(context.inputs, context.body_file, settings.choices.edge_colors == PHOTOGRAPH)
    avatar = load_avatar(context.inputs["train"] / "avatar.safetensors", clip.body)
    networks = {str(name): Lpips(context.assets["lpips"], name) for name in settings.lpips_networks}
    scorer = Scorer(networks, settings.choices.background, settings.choices.render_mask)
    animate, mesh = baked_animation(avatar), make_mesh(context, clip)
    rig = avatar_rig(avatar, clip.body, context.body_file, relaxed(clip, settings))
    evaluate(
        context,
        clip,
        animate,
        pose_gradient_animation(avatar),
        scorer,
        mesh=mesh,
        second=second_mask(context, clip),
        embedder=FaceRecognizer(context.assets["dlib"], context.assets["identity"])
        if settings.identity
        else None,
        arcface=open_arcface(settings.arcface, settings.protocol, context.log),
        other_cameras=other_camera_rows(context, clip, animate, mesh),
        surface=seen_surface(avatar),
        rig=rig,
        packed=pack_avatar(context, clip, avatar) if settings.interactive else None,
        start=start,
    )


def pack_avatar(context: Context, clip: EvaluatedClip, avatar: Avatar) -> bytes:
    """The avatar for the interactive page, with the motion that was never filmed and the clip's own."""
    settings: EvaluateSettings = context.settings
    start, poses = time.monotonic(), clip.shown_poses()
    novel = novel_motion(settings.arm_angle, settings.motion_frames or NOVEL_FRAMES, settings.turntable_fps)
    motions = [novel, filmed_motion(poses, clip.cameras, clip.frames_a_second())]
    packed = packed_avatar(avatar, poses, motions, context.body_file, settings.arm_angle)
    context.timing("page_seconds", time.monotonic() - start)
    return packed


def make_mesh(context: Context, clip: EvaluatedClip) -> TexturedMesh | None:
    """The textured mesh, where it was asked for and there is anything to compare it in."""
    settings: EvaluateSettings = context.settings
    if not settings.mesh_frames or not (clip.split.test or camera_folders(clip)):
        return None
    start = time.monotonic()
    frames = spread_end_to_end(clip.split.train, settings.mesh_frames)
    with context.progress(len(frames), "textured mesh") as progress:
        mesh = textured_mesh(clip, frames, progress.advance)
    context.timing("mesh_seconds", time.monotonic() - start)
    return mesh


def other_camera_rows(
    context: Context, clip: EvaluatedClip, animate: Animate, mesh: TexturedMesh | None
) -> list[TableRow]:
    """The scores in a mannequin's other cameras; none for any other subject."""
    if not camera_folders(clip):
        return []
    start = time.monotonic()
    methods: list[AvatarMethod | TexturedMesh] = [AvatarMethod(AVATAR, clip, animate, ())]
    methods += [] if mesh is None else [mesh]
    background = context.settings.choices.background
    rows = list(score_other_cameras(clip, methods, read_true_surface(clip), background))
    context.timing("views_seconds", time.monotonic() - start)
    return rows


def evaluate(
    context: Context,
    clip: EvaluatedClip,
    animate: Animate,
    follow: Animate,
    scorer: Scorer,
    *,
    mesh: TexturedMesh | None = None,
    second: SecondMask | None = None,
    embedder: FaceEmbedder | None = None,
    arcface: AlignedFaceEmbedder | None = None,
    other_cameras: Sequence[TableRow] = (),
    surface: SeenSurface | None = None,
    rig: Rig | None = None,
    packed: bytes | None = None,
    start: float | None = None,
) -> None:
    """Evaluates whatever turns a pose into Gaussians; everything is written to ``context.output``.

    Args:
        context: of the run.
        clip: the clip.
        animate: a pose -> Gaussians.
        follow: the same with gradients that reach the pose; asked only where test poses are refined.
        scorer: the metrics.
        mesh: the textured mesh, where it is scored.
        second: the second masks, where the ceiling is measured.
        embedder: of faces, where they are compared.
        arcface: the same as the paper does, where it is asked for.
        other_cameras: scores in cameras that are not the clip's.
        surface: of the Gaussians, if they are to be looked at from all sides.
        rig: the body with the avatar's colours, if it is to be published.
        packed: the avatar for the interactive page, see ``pipeline.viewer.packed``; None without one.
        start: when the stage began, by ``time.monotonic``; now if None.
    """
    settings: EvaluateSettings = context.settings
    start = time.monotonic() if start is None else start
    plan, gate = read_plan(context.inputs["plan"] / "plan.json"), read_gate(context.inputs["train"])
    refined = refine_test_poses(context, clip, plan, follow, scorer.background)
    avatar = AvatarMethod(AVATAR, clip, animate, [*clip.split.test, *clip.split.train])
    mean, nearest = frame_baselines(clip, scorer.background, settings.baseline_frames)
    second = second or no_second_mask(clip)
    refined_avatar = AvatarMethod(REFINED, clip, animate, refined.poses.keys(), refined.poses)
    methods: list[Method] = [avatar, refined_avatar, mean, nearest, *([mesh] if mesh else []), second]
    comparisons = empty_comparisons(clip, settings)
    table = score_table(
        [*score(context, clip, methods, scorer, (embedder, arcface), comparisons), *other_cameras]
    )
    write_scores(context.output / "metrics.parquet", table)
    standing = relaxed_gaussians(clip, animate, settings)
    files = write_exports(context, standing, rig)
    cover = write_pictures(context, avatar, standing, comparisons)
    summary = summarise(context, clip, table, scorer, nearest.nearest, refined, gate, second)
    summary["gaussians"], summary["files"] = len(standing), dict(files)
    turned = turn(context, standing, surface)
    summary["turned"] = None if turned is None else turned.numbers
    summary["verdict"] = verdict(summary, clip_coverage(context, clip, plan, gate))
    write_json(context.output / "summary.json", summary)
    contents = report_contents(
        context, clip, summary, table, comparisons, cover, (plan, refined, gate), time.monotonic() - start
    )
    contents = dataclasses.replace(contents, turned=turned, packed=packed)
    if packed is not None:
        film = video_uri(context.output / "turntable.mp4")
        page = viewer_page(context.subject, packed, film)
        (context.output / "avatar.html").write_text(page, encoding="utf-8")
    write_report(context.output / "report.html", contents)
    show_summary(summary, shown(report_place(context.output)))


def turn(context: Context, relaxed: Gaussians, surface: SeenSurface | None) -> Turned | None:
    """The avatar from all sides; the back of the head is searched for a face where MediaPipe is at hand."""
    if surface is None:
        return None
    start, asset = time.monotonic(), context.assets.get("mediapipe")
    finder = None if asset is None else FaceFinder(asset, context.work / "mediapipe.log")
    turned = look_around(relaxed, surface, finder)
    context.timing("turned_seconds", time.monotonic() - start)
    return turned


def score(
    context: Context,
    clip: EvaluatedClip,
    methods: Sequence[Method],
    scorer: Scorer,
    faces: tuple[FaceEmbedder | None, AlignedFaceEmbedder | None],
    comparisons: Comparisons,
) -> list[TableRow]:
    """The scores of the clip; ``comparisons`` gets the pictures that are shown."""
    frames = frames_to_score(clip, context.settings.training_frames)
    start = time.monotonic()
    rows: list[TableRow] = []
    with context.progress(len(frames), "scoring") as progress:
        for scored in score_clip(clip, methods, scorer, frames, *faces):
            rows += scored.rows
            comparisons.add(scored)
            progress.advance()
    context.timing("scoring_seconds", time.monotonic() - start)
    return rows


def refine_test_poses(
    context: Context, clip: EvaluatedClip, plan: Plan, follow: Animate, background: str
) -> RefinedTestPoses:
    """Refines the held-out frames' poses as far as that is allowed, and publishes them."""
    settings: EvaluateSettings = context.settings
    curve = read_curve(context.inputs["train"] / "curve.parquet", "run the train stage again")
    allowed = allowance(clip, settings, is_asked_for(settings, plan), steps_of(curve))
    if not allowed.frames:
        return NOT_REFINED
    context.log(allowed.why)
    start = time.monotonic()
    with context.progress(len(allowed.frames), "refining test poses") as progress:
        perceptual, advance = refinement_lpips(context), progress.advance
        refined = refine(clip, follow, background, allowed.steps, advance, perceptual, allowed.frames)
    context.timing("refinement_seconds", time.monotonic() - start)
    write_refined(context.output / "test_poses.parquet", refined)
    context.log(refinement_cost(context, refined))
    return refined


def refinement_lpips(context: Context) -> PictureLoss | None:
    """The weighted LPIPS of the refinement; None where it has no weight."""
    settings: EvaluateSettings = context.settings
    if not settings.refine_lpips:
        return None
    network = Lpips(context.assets["lpips"], settings.refine_lpips_network)
    return lambda image, truth: settings.refine_lpips * network(image, truth)[0]


def refinement_cost(context: Context, refined: RefinedTestPoses) -> str:
    """The time that refining the test poses took, in a sentence; empty where they were not refined."""
    if not refined.poses:
        return ""
    seconds = context.timings["refinement_seconds"]
    each = f"{len(refined.poses)} frames, {refined.steps} steps each"
    stopped = ", ".join(map(str, refined.stopped))
    left = f" The loss of {stopped} was not finite: the pose of the fit was kept there." if stopped else ""
    return f"Refining the test poses took {seconds:.1f} s: {each}.{left}"


@torch.no_grad()
def relaxed_gaussians(clip: EvaluatedClip, animate: Animate, settings: EvaluateSettings) -> Gaussians:
    """The avatar in the turn's pose."""
    return animate(relaxed(clip, settings), None)


def relaxed(clip: EvaluatedClip, settings: EvaluateSettings) -> Pose:
    """The turn's pose, facing +Z at the origin, without expression."""
    expression = torch.zeros(clip.poses.expression.shape[1])
    return Pose(relaxed_pose(settings.arm_angle), expression, torch.zeros(3))


def write_pictures(
    context: Context, avatar: AvatarMethod, relaxed: Gaussians, comparisons: Comparisons
) -> list[np.ndarray]:
    """Writes ``turntable.mp4``, ``motion.mp4``, ``cover.png`` and ``comparison.png``; returns the cover's."""
    write_turntable(context, relaxed)
    write_motion(context, avatar)
    cover = cover_pictures(avatar, comparisons.frames[len(comparisons.frames) // 2], relaxed)
    write_png(context.output / "cover.png", side_by_side(cover, GAP))
    sheet = comparison_sheet(comparisons.sheet, comparisons.error_gain)
    write_png(context.output / "comparison.png", sheet)
    return cover


def write_turntable(context: Context, gaussians: Gaussians) -> None:
    """Writes ``turntable.mp4``."""
    settings: EvaluateSettings = context.settings
    size = (settings.turntable_width, settings.turntable_height)
    cameras = orbit(visible_extent(gaussians), *size, settings.turntable_frames)
    start = time.monotonic()
    with context.progress(len(cameras), "turntable") as progress:

        def pictures() -> Iterator[np.ndarray]:
            for picture in turntable_pictures(gaussians, cameras):
                yield picture
                progress.advance()

        write_video(context.output / "turntable.mp4", pictures(), settings.turntable_fps)
    context.timing("turntable_seconds", time.monotonic() - start)


def write_motion(context: Context, avatar: AvatarMethod) -> None:
    """Writes ``motion.mp4``, a motion that was never filmed, where it was asked for."""
    settings: EvaluateSettings = context.settings
    if not settings.motion_frames:
        return
    size = (settings.turntable_width, settings.turntable_height)
    expressions, start = avatar.clip.poses.expression.shape[1], time.monotonic()
    pictures = motion_pictures(avatar.animate, expressions, settings.motion_frames, settings.arm_angle, size)
    write_video(context.output / "motion.mp4", pictures, settings.turntable_fps)
    context.timing("motion_seconds", time.monotonic() - start)


def clip_coverage(context: Context, clip: EvaluatedClip, plan: Plan, gate: GateRecord) -> ClipCoverage:
    """The parts of the person that the clip shows, and how well the body fits it."""
    unmodelled, azimuths = 1 - gate.kept / gate.vertices, plan["auxiliary_views"].values
    return ClipCoverage(unmodelled, azimuths, fit_error(context.inputs["fit"]), clip.quality)


def report_contents(
    context: Context,
    clip: EvaluatedClip,
    summary: dict[str, Any],
    table: pd.DataFrame,
    comparisons: Comparisons,
    cover: list[np.ndarray],
    decided: tuple[Plan, RefinedTestPoses, GateRecord],
    seconds: float,
) -> ReportContents:
    """Everything that the report shows, from this stage and from the upstream stages' folders."""
    fit, train, settings = context.inputs["fit"], context.inputs["train"], context.settings
    plan, refined, gate = decided
    own = StageRecord(STAGE.name, as_dict(settings), seconds, peak_memory(), STAGE.version, "this run")
    registration = read_curve(fit / "curve.parquet", "run the fit stage again")
    upstream = stage_records(context.inputs)
    representation = trained_representation(upstream)
    return ReportContents(
        summary=summary,
        clip=describe_clip(clip, representation),
        cover=cover,
        comparisons=comparisons.slider,
        closeups=comparisons.closeups,
        error_gain=comparisons.error_gain,
        turntable=context.output / "turntable.mp4",
        motion=context.output / "motion.mp4",
        overlay=(fit / "overlay.mp4", fit / "overlay.png"),
        training_plots=plot_training(read_curve(train / "curve.parquet", "run the train stage again")),
        registration_plots=plot_registration(registration, fit_seconds(fit)),
        visibility_plots=plot_visibility(gate.scores, gate.tau),
        visibility_picture=train / "visibility.png",
        plan=[plan[effect] for effect in EFFECTS],
        gate=gate.why,
        refinement_cost=refinement_cost(context, refined),
        omissions=omissions(clip.footage, clip.split, settings, table, gate, plan, refined, representation),
        stages=[*upstream, own],
        versions=versions(),
    )


def describe_clip(clip: EvaluatedClip, representation: str | None) -> str:
    """A sentence on where the avatar comes from, and one on what it is made of where that is known."""
    footage = clip.footage
    frames = f"{len(clip.split.train)} frames to learn from and {len(clip.split.test)} held out"
    made = f"Made from {footage.name} ({footage.width} × {footage.height}): {frames}."
    return made if representation is None else f"{made} Its representation: {representation}."


def report_place(output: Path) -> Path:
    """The report's path once the stage's result is published."""
    if output.parent.name.startswith(artifact.SCRATCH):
        return output.parent.parent / artifact.LATEST / "report.html"
    return output / "report.html"
