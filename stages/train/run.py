"""The run of the train stage: reads the inputs, trains, publishes."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import torch
from torch import Tensor

from pipeline.avatar import Architecture, Avatar, save_avatar
from pipeline.avatar.canonical import dilate
from pipeline.body import write_poses
from pipeline.clip.frames import write_png
from pipeline.clip.plan import read_plan
from pipeline.clip.spread import spread_from_start
from pipeline.config.settings import as_dict
from pipeline.device import moved, resolve
from pipeline.errors import UserError
from pipeline.metrics import Lpips
from pipeline.numba_kernels import threads
from pipeline.run.compile_timer import CompileTimer, compile_timer
from pipeline.run.stage import Context
from stages.train.apply_plan import apply_plan
from stages.train.checkpoint import NAME, read_checkpoint, run_key, write_checkpoint
from stages.train.data import TrainingData, read_training_data
from stages.train.divergence import WATCHED, require_progress
from stages.train.initial_colors import color_unseen, initial_color_logits
from stages.train.loop import Trainer, describe, point_values
from stages.train.poses import PoseRefinement
from stages.train.score_picture import score_picture
from stages.train.settings import TrainSettings
from stages.train.step_costs import step_costs
from stages.train.timer import TrainingTimer
from stages.train.visibility_gate import VisibilityGate, ever_in_frame, write_ungated


def run(context: Context) -> None:
    """Trains the avatar of one subject.

    Publishes ``avatar.safetensors``, ``curve.parquet``, ``visibility.parquet``, ``gate.json``,
    ``visibility.png`` where anything was counted, and ``poses.parquet`` (the training frames' refined,
    all others as fitted). Goes on from ``context.work`` if a run of the same settings and inputs was
    killed.

    Raises:
        UserError: if the inputs do not go together, or training diverges.
        NotFiniteError: a number of it is not finite; names it, the iteration and the frame.
    """
    with threads(context.settings.threads), compile_timer() as compiled:
        train_subject(context, compiled)
        context.timing("compile_seconds", compiled.seconds)
        context.timing("compile_cpu_seconds", compiled.cpu_seconds)


def train_subject(context: Context, compiled: CompileTimer) -> None:
    """Reads the inputs, trains what the plan calls for, and writes what is published."""
    data = read_training_data(context)
    settings = apply_plan(context.settings, read_plan(context.inputs["plan"] / "plan.json"))
    device = resolve(settings.device)
    context.log(f"computes on {device}")
    context.timing("device", str(device))
    refinement = PoseRefinement(moved(data.poses, device), data.clip.split.train)
    started = time.monotonic()
    avatar, data = prepare(data, refinement, settings, context)
    network = Lpips(context.assets["lpips"], settings.lpips_network) if settings.lpips else None
    gate = VisibilityGate(avatar, len(data.clip.body.v_template), settings) if settings.gate else None
    trainer = Trainer(avatar, refinement, data, settings, network, gate)
    context.timing("prepare_seconds", time.monotonic() - started)
    train(trainer, context, compiled)
    trainer.require_finite()
    publish(trainer, context)


def publish(trainer: Trainer, context: Context) -> None:
    """Writes the finished avatar, its poses, curve and visibility."""
    avatar, output, clip = trainer.avatar, context.output, trainer.data.clip
    avatar.unseen = "base" if trainer.settings.unseen == "base" else "nothing"
    if avatar.unseen == "base":
        color_unseen(avatar)
    save_avatar(output / "avatar.safetensors", avatar)
    write_poses(output / "poses.parquet", trainer.poses.refined(clip.poses.frames))
    trainer.curve.write(output / "curve.parquet")
    if trainer.gate is None:
        write_ungated(output, len(clip.body.v_template))
    else:
        scores, kept = trainer.gate.write(output)
        write_png(output / "visibility.png", score_picture(clip.body, avatar.identity, scores, kept))


def prepare(
    data: TrainingData, refinement: PoseRefinement, settings: TrainSettings, context: Context
) -> tuple[Avatar, TrainingData]:
    """The untrained avatar on the poses' device: the vertices to keep of the body, in their initial colours.

    Returns:
        The avatar, and the data with the texture of the face loss where that has a weight.
    """
    kept = keep(data, refinement, settings, context)
    # What is shown in its base colours in the end belongs to the avatar, though it is never trained.
    rows = torch.nonzero(kept | (settings.unseen == "base"))[:, 0]
    clip, sizes = data.clip, architecture(settings)
    avatar = Avatar(clip.body, clip.identity, rows, sizes, settings.seed, settings.half_precision)
    avatar.to(refinement.poses.rotation.device)
    avatar.pose_heads_active = avatar.residuals_active = False
    set_time_range(avatar, data)
    if settings.initial_color or settings.face:
        chosen, made = (spread_from_start(frames, settings.color_frames) for frames in data.sources)
        logits = initial_color_logits(avatar.eval(), refinement, data, chosen, made)
        if settings.face:
            data = dataclasses.replace(data, texture=torch.sigmoid(logits))
        if settings.initial_color:
            avatar.base_color.copy_(logits)
    avatar.gate(kept[rows].to(avatar.device))
    parts = ", ".join(region.part for region in avatar.surface().residual) or "no part"
    context.log(
        f"{int(kept.sum())} of {len(kept)} body vertices are kept, {len(avatar)} Gaussians; "
        f"residual colours of: {parts}"
    )
    return avatar.train(), data


def keep(data: TrainingData, refinement: PoseRefinement, settings: TrainSettings, context: Context) -> Tensor:
    """The body vertices that get a Gaussian to begin with, [V] bool on the CPU.

    Raises:
        UserError: no training frame has any of the body in its picture.
    """
    clip = data.clip
    everything = torch.arange(len(clip.body.v_template))
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0)
    body = Avatar(clip.body, clip.identity, everything, bare).to(refinement.poses.rotation.device)
    seen = ever_in_frame(body, refinement, data.crops, clip.split.train)
    if not bool(seen.any()):
        raise UserError(f"{context.inputs['fit']}: the fitted body is outside every frame; run fit again")
    if not (settings.gate and settings.early_gate):
        return torch.ones(len(seen), dtype=torch.bool)
    # The rings are what offsets and refined poses may bring in.
    return dilate(seen, body.surfaces[0].canonical.faces, settings.gate_rings).cpu()


def set_time_range(avatar: Avatar, data: TrainingData) -> None:
    """Tells the avatar's residual heads when the training frames were filmed."""
    seconds = data.clip.seconds
    times = [seconds[frame] for frame in data.clip.split.train if frame in seconds]
    if times:
        avatar.residuals.time_range.copy_(torch.tensor([min(times), max(times)]))


def architecture(settings: TrainSettings) -> Architecture:
    """The part of the settings that an avatar's file has to remember."""
    names = [field.name for field in dataclasses.fields(Architecture) if field.name != "pose_heads"]
    remembered = {name: getattr(settings, name) for name in names}
    remembered["residual_parts"] = () if settings.residual_from == 1 else settings.residual_parts
    return Architecture(**remembered, pose_heads=settings.pose_heads_from < 1)


def train(trainer: Trainer, context: Context, compiled: CompileTimer) -> None:
    """Runs the iterations that are left, with checkpoints and points of the curve."""
    settings, clip, poses = trainer.settings, trainer.data.clip, trainer.data.poses
    key = run_key(as_dict(settings), [poses.rotation, poses.transl, trainer.avatar.kept])
    resume(trainer, context.work, key, context)
    shown = clip.spread(settings.held_out_frames, "test") if settings.held_out_frames else ()
    timer, first = TrainingTimer(context.work, trainer.iteration, compiled), trainer.iteration
    watched = shown or clip.spread(WATCHED)
    if trainer.untrained is None:
        with timer.paused():
            trainer.untrained = trainer.held_out(watched)
    with context.progress(settings.iterations, "training", step_costs(trainer)) as progress:
        progress.skip(trainer.iteration)
        while trainer.iteration < settings.iterations:
            values = trainer.step()
            last = trainer.iteration == settings.iterations
            if last or trainer.iteration % settings.held_out_every == 0:
                timer.mark(trainer.iteration)
                trainer.require_finite()
                with timer.paused():
                    now = trainer.held_out(watched)
                require_progress(trainer.untrained, now, trainer.iteration, settings)
                held_out = now if shown else None
                trainer.curve.point(trainer.iteration, point_values(trainer, held_out))
                report(trainer.iteration, values, held_out, context)
            if not last and trainer.iteration % settings.checkpoint_every == 0:
                write_checkpoint(context.work, trainer.checkpoint(key))
                timer.save(trainer.iteration)
            progress.advance(1, describe(values))
    record_time(timer, first, trainer.iteration, context)


def record_time(timer: TrainingTimer, first: int, last: int, context: Context) -> None:
    """Writes the seconds that the iterations took to run.json: of all, and for each of this process's.

    ``curve_seconds`` has iteration, wall-clock and processor seconds of each point of the curve.
    """
    _, wall, _ = timer.now(last)
    context.timing("train_seconds", wall)
    context.timing("milliseconds_an_iteration", 1e3 * (wall - timer.earlier[1]) / max(1, last - first))
    context.timing("curve_seconds", timer.marks)
    context.timing("earlier_seconds", timer.earlier[1])
    context.timing("earlier_cpu_seconds", timer.earlier[2])


def resume(trainer: Trainer, work: Path, key: str, context: Context) -> None:
    """Restores the last checkpoint of this very run, if there is one."""
    checkpoint = read_checkpoint(work, key)
    if checkpoint is not None:
        trainer.resume(checkpoint)
        context.log(f"goes on from iteration {checkpoint.iteration}")
    elif (work / NAME).exists():
        context.log("the checkpoint of a killed run is damaged, or of other inputs: training begins anew")


def report(iteration: int, values: dict[str, float], held_out: float | None, context: Context) -> None:
    """Logs the loss terms, and the held-out PSNR where there is one."""
    note = "" if held_out is None else f", held-out PSNR {held_out:.2f} dB"
    context.log(f"iteration {iteration}: {describe(values)}{note}")
