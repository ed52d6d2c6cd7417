"""The run of the train stage: reads the inputs, trains, publishes."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import torch

from pipeline.clip.plan import read_plan
from pipeline.config.settings import as_dict
from pipeline.device import moved, product_dtype, resolve
from pipeline.metrics import Lpips
from pipeline.numba_kernels import threads
from pipeline.run.compile_timer import CompileTimer, compile_timer
from pipeline.run.stage import Context
from stages.train.calm_colors import CalmColors
from stages.train.checkpoint import NAME, read_checkpoint, run_key
from stages.train.data import TrainingData, read_training_data
from stages.train.frame_choice import frames_to_draw
from stages.train.held_out import WATCHED, HeldOutCurve
from stages.train.hooks import Checkpoints, Log, NearestSkinning, ProgressBar
from stages.train.initial_avatar import initial_avatar
from stages.train.loop import Hook, Trainer
from stages.train.objective import describe_objective
from stages.train.poses import PoseRefinement
from stages.train.publish import publish
from stages.train.scene import read_scene
from stages.train.schedule import step_costs
from stages.train.settings import (
    TrainSettings,
    apply_plan,
    settings_without_effect,
)
from stages.train.timer import TrainingTimer
from stages.train.visibility_gate import VisibilityGate


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
    with threads(context.settings.threads), compile_timer(context.log) as compiled:
        train_subject(context, compiled)
        context.timing("compile_seconds", compiled.seconds)
        context.timing("compile_cpu_seconds", compiled.cpu_seconds)


def train_subject(context: Context, compiled: CompileTimer) -> None:
    """Reads the inputs, trains what the plan calls for, and writes what is published."""
    inputs, log = context.inputs, context.log
    auxiliary, margin = inputs.get("auxiliary"), context.settings.crop_margin
    data = read_training_data(inputs["ingest"], inputs["fit"], auxiliary, context.body_file, margin)
    plan = read_plan(inputs["plan"] / "plan.json")
    settings = apply_plan(context.settings, plan)
    if context.settings.face and not settings.face:
        log(f"no face loss, though train.face is {context.settings.face:g}: {plan['face_loss'].why}")
    device = resolve(settings.device)
    log_computing(context, device)
    started = time.monotonic()
    network = Lpips(context.assets["lpips"], settings.lpips_network) if settings.lpips else None
    trainer = build_trainer(data, settings, device, network, log)
    captured, made = trainer.data.sources
    log(f"learns from {len(captured)} captured and {len(made)} generated frames")
    context.timing("prepare_seconds", time.monotonic() - started)
    log(describe_objective(trainer.settings))
    levels = range(len(trainer.avatar.surfaces))
    costs = step_costs(settings, [len(trainer.avatar.surface(level).canonical) for level in levels])
    with context.progress(settings.iterations, "training", costs) as progress:
        curve, timer = add_run_hooks(trainer, context.work, compiled, log)
        trainer.hooks["progress"] = ProgressBar(progress)
        first = trainer.iteration
        trainer.run()
    for name, value in timer.summary(first, trainer.iteration).items():
        context.timing(name, value)
    hook = trainer.hooks.get("gate")
    gate = hook if isinstance(hook, VisibilityGate) else None
    if gate is not None:
        log(f"visibility gate: {gate.described()}; {len(trainer.avatar)} Gaussians are left")
    publish(trainer, curve.curve, gate, context.output)


def log_computing(context: Context, device: torch.device) -> None:
    """Says where and in which precision training computes, and which settings have no effect."""
    settings, words = context.settings, f"computes on {device}"
    context.timing("device", str(device))
    if settings.representation == "triplane":
        kind = str(product_dtype(device, settings.half_precision)).removeprefix("torch.")
        context.timing("precision", kind)
        words += f", heads in {kind}"
    context.log(words)
    ignored = settings_without_effect(settings)
    if ignored:
        names = ", ".join(f"train.{name}" for name in ignored)
        context.log(f"without effect on train.representation={settings.representation}: {names}")


def build_trainer(
    data: TrainingData,
    settings: TrainSettings,
    device: torch.device | str = "cpu",
    network: Lpips | None = None,
    log: Log = lambda line: None,
) -> Trainer:
    """A trainer of the untrained avatar, with the hooks that change what is trained.

    Args:
        data: to learn from.
        settings: with the plan applied.
        device: where it computes.
        network: LPIPS, if it has a weight.
        log: for a line on the avatar.

    Raises:
        UserError: as of ``initial_avatar``.
    """
    drawn = frames_to_draw(data, settings.iterations * settings.batch, settings.visits)
    if len(drawn) < len(data.clip.split.train):
        log(f"draws the {len(drawn)} most different of {len(data.clip.split.train)} training frames")
    scene = read_scene(data.clip, data.crops.box, log) if settings.scene_share else None
    settings = settings if scene else dataclasses.replace(settings, scene_share=0.0)
    data = dataclasses.replace(data, drawn=drawn, scene=scene)
    refinement = PoseRefinement(moved(data.poses, device), data.clip.split.train)
    avatar, data = initial_avatar(data, refinement, settings, log)
    hooks: dict[str, Hook] = {}
    if settings.gate:
        hooks["gate"] = VisibilityGate(avatar, len(data.clip.body.v_template), settings)
    if settings.representation == "bases" and settings.calm_from < 1:
        first = max(1, round(settings.calm_from * settings.iterations))
        hooks["calm"] = CalmColors(avatar.base_color, first)
    if settings.skinning == "nearest":
        hooks["skinning"] = NearestSkinning(settings.skin_every)
    return Trainer(avatar, refinement, data, settings, network, hooks)


def add_run_hooks(
    trainer: Trainer, work: Path, compiled: CompileTimer, log: Log
) -> tuple[HeldOutCurve, TrainingTimer]:
    """Adds the curve and the checkpoints of a run to its trainer, and goes on from the last checkpoint.

    Args:
        trainer: at iteration 0.
        work: the folder for checkpoints.
        compiled: what this process compiles.
        log: for lines on the way.

    Returns:
        The curve, and the timer of the iterations.
    """
    settings, clip, poses = trainer.settings, trainer.data.clip, trainer.data.poses
    key = run_key(as_dict(settings), [poses.rotation, poses.transl, trainer.avatar.vertex_ids])
    shown = clip.spread(settings.held_out_frames, "test") if settings.held_out_frames else ()
    timer = TrainingTimer(work, compiled)
    curve = HeldOutCurve(shown, shown or clip.spread(WATCHED), timer, log)
    trainer.hooks["curve"] = curve
    trainer.hooks["checkpoints"] = Checkpoints(work, key, settings.checkpoint_every, timer)
    resume(trainer, work, key, log)
    timer.start(trainer.iteration)
    return curve, timer


def resume(trainer: Trainer, work: Path, key: str, log: Log) -> None:
    """Restores the last checkpoint of this very run, if there is one."""
    checkpoint = read_checkpoint(work, key)
    if checkpoint is not None:
        trainer.resume(checkpoint)
        log(f"goes on from iteration {checkpoint.iteration}")
    elif (work / NAME).exists():
        log("the checkpoint of a killed run is damaged, or of other inputs: training begins anew")
