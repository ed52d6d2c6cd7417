"""Running the train stage."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from pipeline.avatar import Architecture, Avatar, Canonical, save_avatar
from pipeline.avatar.residual import part_rows
from pipeline.body import BodyModel, Identity, Poses, load_body, read_identity, read_poses, write_poses
from pipeline.errors import UserError
from pipeline.metrics import Lpips
from pipeline.records import Split, read_cameras, read_footage, read_split
from pipeline.settings import as_dict
from pipeline.stage import Context
from pipeline.threads import threads
from stages.train.checkpoint import read_checkpoint, run_key, write_checkpoint
from stages.train.data import Frames, person_box, spread
from stages.train.generated import BothFrames, Generated, joined, read_generated
from stages.train.loop import Trainer, describe, point_values
from stages.train.objective import Evidence
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings
from stages.train.visibility import Visibility, first_colors, measure, write_visibility


@dataclasses.dataclass(frozen=True)
class Inputs:
    """What the stage reads.

    Attributes:
        body, identity, poses: the fitted person.
        split: the frames to learn from and those held out.
        crops: training frames around the person.
        whole: uncropped frames.
        times: seconds of frames from the clip's start, of all that have a time.
        generated: frames that a model made of sides the camera never saw, if there are any.
    """

    body: BodyModel
    identity: Identity
    poses: Poses
    split: Split
    crops: Frames
    whole: Frames
    times: Mapping[int, float]
    generated: Generated | None = None

    @property
    def views(self) -> Frames:
        """Every frame that is learnt from, captured and generated."""
        return BothFrames(self.crops, self.generated.views) if self.generated else self.crops  # type: ignore[return-value]

    @property
    def all_poses(self) -> Poses:
        """The poses of captured and generated frames."""
        return joined(self.poses, self.generated.poses) if self.generated else self.poses

    def evidence(self, texture: Tensor | None) -> Evidence:
        """The training frames, and the mean colours that they show, [N, 3]."""
        made = self.generated.frames if self.generated else ()
        return Evidence(self.views, (*self.split.train, *made), self.times, texture)


def run(context: Context) -> None:
    """Trains the avatar of one subject.

    Publishes ``avatar.safetensors``, ``curve.parquet``, ``visibility.parquet`` and ``poses.parquet``
    (the training frames' refined, all others as fitted). Goes on from ``context.work`` if a run of
    the same settings and inputs was killed.

    Raises:
        UserError: if the inputs do not go together, or training diverges.
    """
    with threads(context.settings.threads):
        train_subject(context)


def train_subject(context: Context) -> None:
    """Reads the inputs, trains, and writes what is published."""
    inputs, settings = read_inputs(context), context.settings
    refinement = PoseRefinement(inputs.all_poses, inputs.split.train)
    started = time.monotonic()
    avatar, visibility, texture = prepare(inputs, refinement, settings, context)
    network = Lpips(context.assets["lpips"], settings.lpips_network) if settings.lpips else None
    trainer = Trainer(avatar, refinement, inputs.evidence(texture), settings, network)
    context.timing("prepare_seconds", time.monotonic() - started)
    train(trainer, inputs, context)
    trainer.require_finite()
    save_avatar(context.output / "avatar.safetensors", trainer.avatar)
    write_poses(context.output / "poses.parquet", refinement.refined(inputs.poses.frames))
    write_visibility(context.output / "visibility.parquet", visibility)
    trainer.curve.write(context.output / "curve.parquet")


def read_inputs(context: Context) -> Inputs:
    """Reads and checks what ingest and fit published."""
    ingest, fit, settings = context.inputs["ingest"], context.inputs["fit"], context.settings
    body = load_body(context.body_file)
    poses, cameras, split = (
        read_poses(fit / "poses.parquet"),
        read_cameras(ingest / "cameras.parquet"),
        read_split(ingest / "split.json"),
    )
    _check(fit / "poses.parquet", poses, split, set(cameras))
    box = person_box(ingest, split.train, settings.crop_margin)
    return Inputs(
        body=body,
        identity=read_identity(fit / "identity.safetensors", body),
        poses=poses,
        split=split,
        crops=Frames(ingest, cameras, box),
        whole=Frames(ingest, cameras),
        times=dict(zip(sorted(cameras), read_footage(ingest / "footage.json").seconds, strict=False)),
        generated=read_generated(context.inputs.get("auxiliary"), poses),
    )


def prepare(
    inputs: Inputs, refinement: PoseRefinement, settings: TrainSettings, context: Context
) -> tuple[Avatar, Visibility, Tensor | None]:
    """The untrained avatar: what to keep of the body, and its first colours.

    Returns:
        The avatar, what the clip shows of the body, and the texture of the face loss, [N, 3]; None
        where it has no weight.
    """
    chosen = spread(inputs.split.train, settings.gate_frames)
    everything = torch.arange(len(inputs.body.v_template))
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0, scale=settings.scale)
    body = Avatar(inputs.body, inputs.identity, everything, bare).eval()
    body.pose_heads_active = False
    made = spread(inputs.generated.frames, settings.gate_frames) if inputs.generated else ()
    visibility = measure(body, refinement, inputs.views, chosen, settings.gate_rings, made)
    if not bool((visibility.frames > 0).any()):
        raise UserError(f"{context.inputs['fit']}: the fitted body is outside every frame; run fit again")
    if not settings.gate:
        visibility = dataclasses.replace(visibility, kept=torch.ones_like(visibility.kept))
    kept = torch.nonzero(visibility.kept)[:, 0]
    sizes = architecture(settings, seen_parts(body.surfaces[0].canonical, visibility, settings))
    avatar = Avatar(inputs.body, inputs.identity, kept, sizes, settings.seed, settings.half_precision)
    avatar.pose_heads_active = avatar.residuals_active = False
    set_time_range(avatar, inputs)
    seen = float((visibility.frames > 0).float().mean())
    context.log(
        f"{seen:.0%} of the body is seen, {len(kept)} of {len(everything)} vertices are kept, "
        f"{len(avatar)} Gaussians; residual colours of: {', '.join(sizes.residual_parts) or 'no part'}"
    )
    texture = None
    if settings.initial_color or settings.face:
        logits = first_colors(avatar.eval(), refinement, inputs.views, chosen, settings.mask_band, made)
        texture = torch.sigmoid(logits) if settings.face else None
        if settings.initial_color:
            avatar.base_color.copy_(logits)
    return avatar.train(), visibility, texture


def seen_parts(canonical: Canonical, visibility: Visibility, settings: TrainSettings) -> tuple[str, ...]:
    """The parts that get a residual head: of those wanted, the ones that the clip shows enough of."""
    if settings.residual_from == 1:
        return ()
    seen = visibility.frames > 0
    shares = {
        part: float(seen[rows].float().mean())
        for part, rows in part_rows(canonical, settings.residual_parts).items()
    }
    return tuple(part for part, share in shares.items() if 0 < share >= settings.residual_seen)


def set_time_range(avatar: Avatar, inputs: Inputs) -> None:
    """Tells the avatar's residual heads when the training frames were filmed."""
    times = [inputs.times[frame] for frame in inputs.split.train if frame in inputs.times]
    if times:
        avatar.residuals.time_range.copy_(torch.tensor([min(times), max(times)]))


def architecture(settings: TrainSettings, residual_parts: tuple[str, ...]) -> Architecture:
    """The part of the settings that an avatar's file has to remember."""
    names = [field.name for field in dataclasses.fields(Architecture)]
    remembered = {name: getattr(settings, name) for name in names}
    return Architecture(**{**remembered, "residual_parts": residual_parts})


def train(trainer: Trainer, inputs: Inputs, context: Context) -> None:
    """Runs the iterations that are left, with checkpoints and points of the curve."""
    settings = context.settings
    poses = inputs.all_poses
    key = run_key(as_dict(settings), [poses.rotation, poses.transl, trainer.avatar.kept])
    resume(trainer, context.work, key, context)
    shown = spread(inputs.split.test, settings.held_out_frames) if settings.held_out_frames else ()
    started, first = time.monotonic(), trainer.iteration
    with context.progress(settings.iterations, "training") as progress:
        progress.advance(trainer.iteration)
        while trainer.iteration < settings.iterations:
            values = trainer.step()
            last = trainer.iteration == settings.iterations
            if last or trainer.iteration % settings.held_out_every == 0:
                held_out = trainer.held_out(inputs.whole, shown) if shown else None
                trainer.curve.point(trainer.iteration, point_values(trainer, held_out))
                report(trainer.iteration, values, held_out, context)
            if not last and trainer.iteration % settings.checkpoint_every == 0:
                write_checkpoint(context.work, trainer.checkpoint(key))
            progress.advance(1, describe(values))
    done = trainer.iteration - first
    context.timing("train_seconds", time.monotonic() - started)
    context.timing("milliseconds_an_iteration", 1e3 * (time.monotonic() - started) / max(1, done))


def resume(trainer: Trainer, work: Path, key: str, context: Context) -> None:
    """Goes on from the last checkpoint of this very run, if there is one."""
    checkpoint = read_checkpoint(work, key)
    if checkpoint is not None:
        trainer.resume(checkpoint)
        context.log(f"goes on from iteration {checkpoint.iteration}")


def report(iteration: int, values: dict[str, float], held_out: float | None, context: Context) -> None:
    """One line about how training goes."""
    note = "" if held_out is None else f", held-out PSNR {held_out:.2f} dB"
    context.log(f"iteration {iteration}: {describe(values)}{note}")


def _check(path: Path, poses: Poses, split: Split, cameras: set[int]) -> None:
    missing = sorted({*split.train, *split.test} - set(poses.frames))
    if missing:
        raise UserError(f"{path} has no pose for frame {missing[0]}; run the fit stage again")
    without = sorted(set(poses.frames) - cameras)
    if without:
        raise UserError(f"{path}: frame {without[0]} has no camera; run the ingest stage again")
    for name in ("rotation", "expression", "transl"):
        if not bool(torch.isfinite(getattr(poses, name)).all()):
            raise UserError(f"{path} holds numbers that are not finite; run the fit stage again")
