"""A subject small enough to train on in seconds: the open body in colour, six frames of 48 x 64."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.avatar import Architecture, Avatar
from pipeline.body import Poses, mean_identity, read_poses, write_poses
from pipeline.clip.camera import facing_camera
from pipeline.clip.keypoints import empty_keypoints, write_keypoints
from pipeline.clip.plan import read_plan
from pipeline.splat import render
from stages.train import objective
from stages.train.data import TrainingData, read_training_data
from stages.train.loop import Trainer
from stages.train.run import build_trainer, run
from stages.train.settings import TrainSettings, apply_plan
from tests.made.body import open_body
from tests.made.context import RecordedContext, stage_context
from tests.made.plans import plan_of
from tests.made.published import publish, simple_footage

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
    threads=1,
    visits=0.0,
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
    body = open_body()
    small = {"width": 16, "groups": 4, "residual_width": 16}
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0, **small)
    avatar = Avatar(body, mean_identity(body), torch.arange(len(body.v_template)), bare).eval()
    avatar.base_color.copy_(2 * torch.sin(9 * body.v_template))
    return avatar


@functools.cache
def pictures() -> list[tuple[np.ndarray, np.ndarray]]:
    """Frame and mask of each pose: the painted avatar over grey."""
    avatar, poses, camera = painted_avatar(), moving_poses(), facing_camera(WIDTH, HEIGHT, 1.2 * HEIGHT)
    drawn = []
    for frame in poses.frames:
        with torch.no_grad():
            rendering = render(avatar.gaussians(poses.pose(frame)), camera)
        over_grey = rendering.color + (1 - rendering.alpha)[..., None] * 0.5
        images = (over_grey, rendering.alpha)
        drawn.append(tuple((image.clamp(0, 1).numpy() * 255).astype(np.uint8) for image in images))
    return drawn


def write_subject(folder: Path) -> None:
    """Writes ``ingest``, ``fit`` and ``plan`` as those stages would publish them."""
    body, poses = open_body(), moving_poses()
    camera = facing_camera(WIDTH, HEIGHT, 1.2 * HEIGHT)
    unseen = {"left_hand_residual": False, "right_hand_residual": False}  # they hang below the picture
    publish(
        folder,
        pictures(),
        dict.fromkeys(poses.frames, camera),
        (body, mean_identity(body), poses),
        simple_footage(WIDTH, HEIGHT, 10.0, FRAMES, start=0.5),
        plan=plan_of(**unseen),
    )


def write_trained(folder: Path) -> dict[str, Path]:
    """The same with ``train``'s poses beside it and no keypoints, as evaluation reads it: stage -> folder."""
    write_subject(folder)
    (folder / "train").mkdir()
    write_poses(folder / "train" / "poses.parquet", moving_poses())
    write_keypoints(folder / "ingest" / "keypoints.parquet", empty_keypoints(np.arange(FRAMES)))
    return {name: folder / name for name in ("ingest", "fit", "plan", "train")}


def with_poses(subject: Path, folder: Path, change: Callable[[Poses], Poses]) -> Path:
    """Another folder of the subject, whose poses went through ``change``."""
    shutil.copytree(subject / "fit", folder / "fit")
    for name in ("ingest", "plan"):
        (folder / name).symlink_to(subject / name)
    write_poses(folder / "fit" / "poses.parquet", change(read_poses(subject / "fit" / "poses.parquet")))
    return folder


def with_footage(subject: Path, folder: Path) -> Path:
    """Another folder of the subject, whose footage may be changed."""
    shutil.copytree(subject / "ingest", folder / "ingest")
    for name in ("fit", "plan"):
        (folder / name).symlink_to(subject / name)
    return folder


def context_for(folder: Path, output: Path, work: Path | None = None, **changes) -> RecordedContext:
    """The train stage's context over a subject's folder; ``changes`` are settings."""
    inputs = {name: folder / name for name in ("ingest", "fit", "plan")}
    return stage_context("train", dataclasses.replace(TINY, **changes), output, inputs, work)


def data_for(context: RecordedContext) -> TrainingData:
    """What the stage reads under a context."""
    inputs, margin = context.inputs, context.settings.crop_margin
    return read_training_data(inputs["ingest"], inputs["fit"], inputs.get("auxiliary"), open_body(), margin)


def trainer_for(context: RecordedContext) -> Trainer:
    """A trainer as the stage builds it under a context; hooks that write files are not among its hooks."""
    plan = read_plan(context.inputs["plan"] / "plan.json")
    settings = apply_plan(context.settings, plan)
    return build_trainer(data_for(context), settings)


class Killed(BaseException):
    """Stands for a kill: nothing of ours catches it."""


def run_counted(
    context: RecordedContext, monkeypatch: pytest.MonkeyPatch, kill_at: int | None = None
) -> list[int]:
    """Runs the stage, to its end or to a kill at an iteration: the iterations at which it took a step."""
    step, taken = Trainer.step, []

    def counted(self):
        if self.iteration == kill_at:
            raise Killed
        taken.append(self.iteration)
        return step(self)

    ends = contextlib.nullcontext() if kill_at is None else pytest.raises(Killed)
    with monkeypatch.context() as patch, ends:
        patch.setattr(Trainer, "step", counted)
        run(context)
    return taken


def bytes_of(folder: Path) -> dict[str, bytes]:
    """The content of every file of a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def change_loss(monkeypatch, name: str, change: Callable[[Callable, tuple], torch.Tensor]) -> None:
    """Puts ``change(loss, operands)`` in the place of a frame term's loss."""

    def changed(term):
        if term.name != name:
            return term
        return dataclasses.replace(term, loss=lambda *operands: change(term.loss, operands))

    monkeypatch.setattr(objective, "FRAME_TERMS", tuple(changed(term) for term in objective.FRAME_TERMS))
