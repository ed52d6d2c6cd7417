"""A subject small enough to train on in seconds: the open body in colour, six frames of 48 x 64."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from pipeline.avatar import Architecture, Avatar
from pipeline.body import Poses, load_body, mean_identity, write_identity, write_poses
from pipeline.clip.camera import facing_camera
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.plan import read_plan, write_plan
from pipeline.clip.records import Footage, Split, write_cameras, write_footage, write_split
from pipeline.splat import render
from stages.train import objective
from stages.train.data import TrainingData, read_training_data
from stages.train.loop import Trainer
from stages.train.run import build_trainer
from stages.train.settings import TrainSettings, apply_plan
from tests.plans import plan_of

BODY_FILE = Path(__file__).parents[2] / "data" / "body" / "open_body.npz"
FRAMES, WIDTH, HEIGHT = 6, 48, 64
TINY = TrainSettings(
    representation="triplane",
    iterations=12,
    held_out_every=6,
    held_out_frames=1,
    checkpoint_every=5,
    plane_resolution=16,
    plane_channels=4,
    width=16,
    groups=4,
    subdivisions=0,
    color_frames=3,
    gate_from=0.25,
    gate_every=2,
    residual_from=0.3,
    face=0.8,
    lpips=0.0,
    lpips_from=0.0,
)


def moving_poses(count: int = FRAMES) -> Poses:
    """A head and shoulders 0.75 m away; the body turns and the head nods."""
    rotation = torch.zeros(count, 55, 3)
    phase = torch.linspace(-1, 1, count)
    rotation[:, 0, 1] = 0.2 * phase
    rotation[:, 15, 0] = 0.1 * phase
    rotation[:, 16, 2] = -1.1
    rotation[:, 17, 2] = 1.1
    transl = torch.tensor([0.0, -0.44, -0.6]).expand(count, 3).clone()
    return Poses(tuple(range(count)), rotation, torch.zeros(count, 5), transl)


def painted_avatar() -> Avatar:
    """The mean body in the colours in which the subject is filmed; nothing of it was learnt."""
    body = load_body(BODY_FILE)
    small = {"width": 16, "groups": 4, "residual_width": 16}
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0, **small)
    avatar = Avatar(body, mean_identity(body), torch.arange(len(body.v_template)), bare).eval()
    avatar.base_color.copy_(2 * torch.sin(9 * body.v_template))
    return avatar


def write_subject(folder: Path) -> None:
    """Writes ``ingest``, ``fit`` and ``plan`` as those stages would publish them."""
    ingest, fit, plan = folder / "ingest", folder / "fit", folder / "plan"
    for made in (ingest / "frames", ingest / "masks", fit, plan):
        made.mkdir(parents=True)
    body, poses, avatar = load_body(BODY_FILE), moving_poses(), painted_avatar()
    camera = facing_camera(WIDTH, HEIGHT, 1.2 * HEIGHT)
    for frame in poses.frames:
        with torch.no_grad():
            gaussians = avatar.gaussians(poses.pose(frame))
            rendering = render(gaussians, camera)
        over_grey = rendering.color + (1 - rendering.alpha)[..., None] * 0.5
        write_frame(ingest / "frames", frame, (over_grey.clamp(0, 1).numpy() * 255).astype(np.uint8))
        write_mask(ingest / "masks", frame, (rendering.alpha.clamp(0, 1).numpy() * 255).astype(np.uint8))
    write_cameras(ingest / "cameras.parquet", {frame: camera for frame in poses.frames})
    seconds = tuple(0.5 + frame / 10 for frame in poses.frames)
    footage = Footage("made", WIDTH, HEIGHT, 10.0, 1.0, FRAMES, FRAMES, {}, 1, seconds, {})
    write_footage(ingest / "footage.json", footage)
    write_split(ingest / "split.json", Split(train=poses.frames[:-1], test=poses.frames[-1:]))
    write_identity(fit / "identity.safetensors", avatar.identity, body)
    write_poses(fit / "poses.parquet", poses)
    unseen = {"left_hand_residual": False, "right_hand_residual": False}  # they hang below the picture
    write_plan(plan / "plan.json", plan_of(**unseen))


def context_for(folder: Path, output: Path, work: Path | None = None, **changes):
    """A stand-in for the runner's context; ``changes`` are settings."""
    work = work or output.with_name(f"{output.name}-work")
    output.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)

    @contextlib.contextmanager
    def progress(total: int, label: str, costs=None):
        yield SimpleNamespace(advance=lambda n=1, note="": None, skip=lambda n: None)

    return SimpleNamespace(
        settings=dataclasses.replace(TINY, **changes),
        inputs={name: folder / name for name in ("ingest", "fit", "plan")},
        body_file=BODY_FILE,
        output=output,
        work=work,
        progress=progress,
        log=lambda message: None,
        timing=lambda name, value: None,
    )


def data_for(context) -> TrainingData:
    """What the stage reads under a context."""
    inputs, margin = context.inputs, context.settings.crop_margin
    return read_training_data(
        inputs["ingest"], inputs["fit"], inputs.get("auxiliary"), context.body_file, margin
    )


def trainer_for(context) -> Trainer:
    """A trainer as the stage builds it under a context; hooks that write files are not among its hooks."""
    plan = read_plan(context.inputs["plan"] / "plan.json")
    settings = apply_plan(context.settings, plan)
    return build_trainer(data_for(context), settings)


def change_loss(monkeypatch, name: str, change: Callable[[Callable, tuple], torch.Tensor]) -> None:
    """Puts ``change(loss, operands)`` in the place of a frame term's loss."""

    def changed(term):
        if term.name != name:
            return term
        return dataclasses.replace(term, loss=lambda *operands: change(term.loss, operands))

    monkeypatch.setattr(objective, "FRAME_TERMS", tuple(changed(term) for term in objective.FRAME_TERMS))
