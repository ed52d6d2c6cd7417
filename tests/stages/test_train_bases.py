"""The train stage with linear bases: runs, resumes, and clips that drive few bases or none."""

import dataclasses

import pytest
import torch

from pipeline.avatar import load_avatar
from pipeline.body import load_body, read_poses, write_poses
from pipeline.clip.records import Split, write_split
from pipeline.errors import UserError
from pipeline.finite import NotFiniteError
from stages.train import run as stage
from stages.train.loop import Trainer
from stages.train.settings import (
    TrainSettings,
    apply_plan,
    settings_without_effect,
)
from tests.plans import plan_of
from tests.stages.train_subject import BODY_FILE, context_for, moving_poses, trainer_for, write_subject

BASES = {"representation": "bases", "bases": 1, "iterations": 8, "held_out_every": 4, "checkpoint_every": 3}


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    folder = tmp_path_factory.mktemp("subject")
    write_subject(folder)
    return folder


@pytest.fixture(scope="module")
def finished(subject):
    """One uninterrupted run, and its log."""
    context, lines = context_for(subject, subject / "bases", **BASES), []
    context.log = lines.append
    stage.run(context)
    return context.output, lines


@pytest.fixture
def changed(tmp_path):
    """The subject in a folder of its own, with other poses or another split."""
    write_subject(tmp_path / "subject")
    return tmp_path / "subject"


def bytes_of(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_learns_and_says_what_it_is(finished):
    output, lines = finished
    assert any("bases: 1 driven by pose and face" in line for line in lines)
    avatar = load_avatar(output / "avatar.safetensors", load_body(BODY_FILE))
    assert (avatar.architecture.representation, avatar.architecture.bases) == ("bases", 1)
    assert not avatar.architecture.residual_parts and avatar.pose_heads_active
    learnt = avatar.representation
    for values in (learnt.offset, learnt.log_scale, learnt.color, learnt.bases):
        assert bool((values != 0).any())
    assert bool((learnt.bases == 0).all(1).any())  # the back of the head was never seen


def test_same_seed_same_bytes_also_when_killed(subject, finished, tmp_path, monkeypatch):
    context = context_for(subject, tmp_path / "out", **BASES)
    original = Trainer.step

    class Killed(BaseException):
        pass

    def step(self):
        if self.iteration == 5:
            raise Killed
        return original(self)

    monkeypatch.setattr(Trainer, "step", step)
    with pytest.raises(Killed):
        stage.run(context)
    monkeypatch.undo()
    lines = []
    context.log = lines.append
    stage.run(context)
    assert any("goes on from iteration 3" in line for line in lines)
    assert bytes_of(context.output) == bytes_of(finished[0])


def test_more_bases_than_frames_drive_are_as_many_as_they_drive(subject, tmp_path):
    context = context_for(subject, tmp_path, **{**BASES, "bases": 100})
    trainer = trainer_for(context)
    assert 0 < trainer.avatar.architecture.bases <= 4  # five training frames less their mean
    assert trainer.level == len(trainer.avatar.surfaces) - 1  # the finest, from the first step
    trainer.step()


@pytest.mark.parametrize(("frames", "bases"), [((0,), 0), ((0, 4), 1)])
def test_one_frame_drives_no_bases_and_two_drive_one(changed, tmp_path, frames, bases):
    write_split(changed / "ingest" / "split.json", Split(train=frames, test=(5,)))
    context = context_for(changed, tmp_path / "out", **{**BASES, "iterations": 3})
    stage.run(context)
    avatar = load_avatar(context.output / "avatar.safetensors", load_body(BODY_FILE))
    assert avatar.architecture.bases == bases and len(avatar.representation) == bases


def test_one_pose_and_a_still_face_drive_no_bases(changed, tmp_path):
    poses = moving_poses()
    still = dataclasses.replace(poses, rotation=poses.rotation[:1].expand_as(poses.rotation).clone())
    write_poses(changed / "fit" / "poses.parquet", still)
    trainer = trainer_for(context_for(changed, tmp_path / "out", **BASES))
    assert trainer.avatar.architecture.bases == 0
    trainer.step()
    assert "bases_learning_rate" not in trainer.avatar.representation.parameter_groups()


def test_still_face_leaves_the_poses_bases(subject, tmp_path):
    poses = read_poses(subject / "fit" / "poses.parquet")
    assert not bool(poses.expression.any())
    assert trainer_for(context_for(subject, tmp_path, **BASES)).avatar.architecture.bases > 0


def test_fitted_expression_that_is_not_finite_is_refused_with_its_frame(subject, tmp_path):
    from stages.train.initial_avatar import clip_conditions
    from tests.stages.train_subject import data_for

    data = data_for(context_for(subject, tmp_path, **BASES))
    expression = data.clip.poses.expression.clone()
    expression[2, 0] = torch.nan
    clip = dataclasses.replace(data.clip, poses=dataclasses.replace(data.clip.poses, expression=expression))
    with pytest.raises(NotFiniteError, match="fitted expression is not finite in frame 2"):
        clip_conditions(dataclasses.replace(data, clip=clip))


def test_plan_without_change_of_pose_gives_no_bases():
    settings = TrainSettings(representation="bases")
    asked = apply_plan(settings, plan_of(pose_heads=False))
    assert (asked.bases, asked.pose_heads_from) == (0, 1.0)
    asked = apply_plan(settings, plan_of())
    assert (asked.bases, asked.pose_heads_from, asked.subdivide_from) == (settings.bases, 0.0, 0.0)


@pytest.mark.parametrize(
    ("representation", "name", "value"),
    [("bases", "pose_noise", 0.1), ("bases", "plane_resolution", 64), ("triplane", "bases", 3)],
)
def test_settings_that_the_representation_does_not_read_are_named(representation, name, value):
    settings = TrainSettings(representation=representation, **{name: value}, l1=0.7)
    assert settings_without_effect(settings) == (name,)
    assert settings_without_effect(TrainSettings(representation=representation)) == ()


def test_rates_far_too_high_are_refused_by_the_rates_that_bases_have(subject, tmp_path):
    context = context_for(
        subject, tmp_path / "out", **{**BASES, "color_learning_rate": 0.9, "offset_learning_rate": 0.9,
                                      "scale_learning_rate": 0.9, "bases_learning_rate": 0.9,
                                      "warm_up": 0, "iterations": 40, "offset_unit": 1.0},
    )  # fmt: skip
    with pytest.raises(UserError, match="color_learning_rate"):
        stage.run(context)
