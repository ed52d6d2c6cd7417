"""The train stage with linear bases: clips that drive few of them or none; test_train.py has the rest."""

import dataclasses

import pytest
import torch

from pipeline.avatar import ClipConditions, load_avatar
from pipeline.body import read_poses
from pipeline.clip.records import Split, write_split
from pipeline.finite import NotFiniteError
from stages.train import run as stage
from stages.train.initial_avatar import architecture
from stages.train.settings import TrainSettings, apply_plan, for_bases, settings_without_effect
from tests.made.plans import plan_of
from tests.made.portrait import context_for, data_for, trainer_for, with_footage, with_poses

BASES = {"representation": "bases", "bases": 1}


def test_more_bases_than_frames_drive_are_as_many_as_they_drive(subject, tmp_path):
    context = context_for(subject, tmp_path, **{**BASES, "bases": 100})
    trainer = trainer_for(context)
    assert 0 < trainer.avatar.architecture.bases <= 4  # five training frames less their mean
    assert trainer.level == len(trainer.avatar.surfaces) - 1  # the finest, from the first step
    trainer.step()


@pytest.mark.parametrize(("frames", "asked", "bends"), [(99, 8, 0), (100, 8, 8), (100, 3, 3), (100, 0, 0)])
def test_clips_of_a_hundred_frames_have_bends(frames, asked, bends):
    generator = torch.Generator().manual_seed(2)
    theta, expression = (torch.randn(frames, size, generator=generator) for size in (12, 4))
    settings = for_bases(TrainSettings(bases=5, bends=asked))
    found = architecture(settings, ClipConditions(theta, expression, ()), 4)
    assert (found.bases, found.bends) == (5 + bends, bends)


@pytest.mark.parametrize(("frames", "bases"), [((0,), 0), ((0, 4), 1)])
def test_one_frame_drives_no_bases_and_two_drive_one(subject, body, tmp_path, frames, bases):
    changed = with_footage(subject, tmp_path / "changed")
    write_split(changed / "ingest" / "split.json", Split(train=frames, test=(5,)))
    context = context_for(changed, tmp_path / "out", **{**BASES, "iterations": 3})
    stage.run(context)
    avatar = load_avatar(context.output / "avatar.safetensors", body)
    assert avatar.architecture.bases == bases and len(avatar.representation) == bases


def test_one_pose_and_a_still_face_drive_no_bases(subject, tmp_path):
    def still(poses):
        return dataclasses.replace(poses, rotation=poses.rotation[:1].expand_as(poses.rotation).clone())

    changed = with_poses(subject, tmp_path / "changed", still)
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
