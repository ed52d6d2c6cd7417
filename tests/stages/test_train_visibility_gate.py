"""The visibility gate in training: what it counts, what it takes out, what comes back, and a resumed run."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.avatar import load_avatar
from pipeline.body import Pose
from pipeline.clip.plan import Decision, Plan
from pipeline.files.tables import read_table
from pipeline.untrusted import parse_json
from stages.train import run as stage
from stages.train.settings import apply_plan
from stages.train.visibility_gate import SCHEMA, VisibilityGate, ever_in_frame
from tests.made.body import open_body
from tests.made.plans import plan_of
from tests.made.portrait import TINY, bytes_of, context_for, data_for, run_counted, trainer_for

LATE = {"early_gate": False, "gate_from": 0.25, "gate_every": 2, "iterations": 12}


@pytest.fixture
def trainer(subject, tmp_path):
    return trainer_for(context_for(subject, tmp_path / "out", **LATE))


def truth(subject, tmp_path) -> torch.Tensor:
    """Which body vertices the five training frames have in their picture, [5, V]."""
    context = context_for(subject, tmp_path / "truth")
    data = data_for(context)
    train = data.clip.split.train
    body = trainer_for(context_for(subject, tmp_path / "whole", gate=False))
    return torch.stack([ever_in_frame(body.avatar, body.poses, data.crops, (frame,)) for frame in train])


def test_scores_over_epochs_are_those_of_the_frames(subject, tmp_path, trainer):
    expected = truth(subject, tmp_path).float().mean(0)
    for _ in range(10):  # two epochs of five frames
        trainer.step()
    captured, generated = trainer.hooks["gate"].scores()
    # Refined poses move a vertex across the border now and then.
    assert (captured - expected).abs().max() <= 0.2 and (captured != expected).float().mean() < 0.02
    assert trainer.hooks["gate"].drawn.tolist() == [10, 0] and not generated.any()


def test_warm_up_ends_when_it_should_and_what_is_gated_is_gone(trainer):
    body = len(trainer.avatar.vertex_ids)
    for _ in range(2):
        trainer.step()
    assert trainer.hooks["gate"].threshold is None and len(trainer.avatar) == body
    assert "train.gate_every" in trainer.hooks["gate"].described()
    trainer.step()
    assert trainer.hooks["gate"].described() == trainer.hooks["gate"].threshold.why
    assert trainer.hooks["gate"].threshold.closed and len(trainer.avatar) < 0.6 * body
    decoded = trainer.avatar.decode(0)
    assert len(decoded.offset) == len(trainer.avatar) == int(trainer.avatar.active.sum())
    values = trainer.step()
    assert all(np.isfinite(list(values.values())))


def test_gated_gaussians_send_the_triplane_no_gradient(trainer):
    for _ in range(5):
        trainer.step()
    full, part = trainer.avatar.surfaces[0].samples.matrix, trainer.avatar.surface(0).samples.matrix
    read = torch.zeros(2, full.shape[1], dtype=torch.bool)
    read[0, full.col_indices().long()] = read[1, part.col_indices().long()] = True
    trainer.step()
    mass = trainer.avatar.representation.triplane.planes.grad.abs().sum(-1).flatten()
    only_gated = read[0] & ~read[1]
    assert only_gated.sum() > 50 and float(mass[only_gated].sum()) == 0 < float(mass[read[1]].sum())
    trainer.avatar.gate(torch.ones_like(trainer.avatar.active))
    del trainer.hooks["gate"]
    trainer.step()
    mass = trainer.avatar.representation.triplane.planes.grad.abs().sum(-1).flatten()
    assert float(mass[only_gated].sum()) > 0


def test_laplacians_know_active_neighbours_only(trainer):
    full = trainer.avatar.surfaces[0]
    active = torch.zeros(len(full.canonical), dtype=torch.bool)
    active[full.canonical.faces[0]] = True
    lonely = int((~active).nonzero()[-1])
    active[lonely] = True
    trainer.avatar.gate(active)
    surface = trainer.avatar.surface(0)
    values = torch.arange(4.0)[:, None]
    means = (surface.neighbours @ values)[:, 0]
    place = int((surface.rows == lonely).nonzero())
    others = [row for row in range(4) if row != place]
    for row in others:
        near = [one for one in others if one != row]
        assert float(means[row]) == pytest.approx(float(values[near].mean()))
    assert float(means[place]) == float(values[place])  # nobody is left beside it
    assert all(bool(torch.isfinite(term)) for term in trainer.objective(0, 0, False).values())


def test_what_comes_into_view_later_returns(trainer):
    gate = trainer.hooks["gate"]
    hand = torch.zeros(len(trainer.avatar.vertex_ids), dtype=torch.bool)
    hand[trainer.avatar.surfaces[0].canonical.is_part("left_hand")] = True
    gate.drawn[0] = 10
    gate.hits[0] = torch.where(trainer.avatar.surfaces[0].canonical.is_part("head", "face"), 10, 0)
    gate.update()
    assert not trainer.avatar.active[hand].any()
    for _ in range(30):
        gate.drawn[0] += 1
        gate.hits[0] += (gate.hits[0] > 0) | hand
    gate.update()
    assert trainer.avatar.active[hand].all()


@pytest.mark.parametrize(("unseen", "kept"), [("generated", True), ("nothing", False)])
def test_generated_frames_are_counted_apart_and_keep_what_they_show(subject, tmp_path, unseen, kept):
    trainer = trainer_for(context_for(subject, tmp_path / "out", **LATE, unseen=unseen))
    gate, avatar = trainer.hooks["gate"], trainer.avatar
    face, leg = (avatar.surfaces[0].canonical.is_part(part) for part in ("face", "left_leg"))
    gate.drawn[:] = 4
    gate.hits[0], gate.hits[1] = 4 * face, 4 * leg
    gate.update()
    assert avatar.active[face].all() and bool(avatar.active[leg].all()) == kept


def test_full_body_in_view_keeps_the_gate_open(trainer):
    trainer.hooks["gate"].drawn[0] = 20
    trainer.hooks["gate"].hits[0] = torch.randint(15, 21, trainer.hooks["gate"].hits[0].shape)
    trainer.hooks["gate"].update()
    assert not trainer.hooks["gate"].threshold.closed and bool(trainer.avatar.active.all())


def test_one_training_frame_is_enough_for_a_threshold(subject, tmp_path):
    trainer = trainer_for(context_for(subject, tmp_path / "out", **LATE))
    split = dataclasses.replace(trainer.data.clip.split, train=(2,))
    clip = dataclasses.replace(trainer.data.clip, split=split)
    trainer.objective.data = dataclasses.replace(trainer.data, clip=clip, drawn=None)
    for _ in range(4):
        trainer.step()
    assert (
        set(trainer.hooks["gate"].scores()[0].unique().tolist()) == {0.0, 1.0}
        and trainer.hooks["gate"].threshold.closed
    )


@pytest.mark.slow
@pytest.mark.parametrize("looks", [{}, {"gate_every": 100}], ids=["a look after it", "none after it"])
def test_killed_after_the_gate_closed_and_rerun_gives_the_same_bytes(subject, tmp_path, monkeypatch, looks):
    whole = context_for(subject, tmp_path / "whole", **LATE | looks)
    stage.run(whole)
    context = context_for(subject, tmp_path / "out", **LATE | looks)
    run_counted(context, monkeypatch, kill_at=8)
    assert run_counted(context, monkeypatch) == list(range(5, 12))
    assert bytes_of(context.output) == bytes_of(whole.output)
    found = parse_json(context.output / "gate.json", "")
    assert found["drawn"] == {"captured": 12, "generated": 0} and found["tau"] > 0


def test_finer_level_is_gated_as_the_coarse_one(subject, tmp_path):
    changes = LATE | {"subdivisions": 1, "subdivide_from": 0.75}
    trainer = trainer_for(context_for(subject, tmp_path / "out", **changes))
    for _ in range(10):
        trainer.step()
    coarse, fine = trainer.avatar.surface(0), trainer.avatar.surface(1)
    assert trainer.level == 1 and len(fine.canonical) < 5 * len(coarse.canonical)
    assert torch.equal(fine.rows[: len(coarse.rows)], coarse.rows)
    assert torch.equal(fine.canonical.vertices, trainer.avatar.surfaces[1].canonical.vertices[fine.rows])
    assert len(fine.canonical.faces) == 4 * len(coarse.canonical.faces)


@pytest.mark.parametrize("unseen", ["nothing", "base"])
def test_finished_avatar_shows_nothing_or_the_base_where_nothing_was_seen(subject, tmp_path, unseen):
    context = context_for(subject, tmp_path / "out", unseen=unseen)
    stage.run(context)
    body = open_body()
    avatar = load_avatar(context.output / "avatar.safetensors", body)
    kept = read_table(context.output / "visibility.parquet", SCHEMA, "")["kept"]
    expression = torch.zeros(avatar.surfaces[0].canonical.expression_directions.shape[-1])
    with torch.no_grad():
        gaussians = avatar.gaussians(Pose(torch.zeros(55, 3), expression, torch.zeros(3)))
    assert len(avatar) == kept.sum()
    assert len(gaussians) == (len(kept) if unseen == "base" else kept.sum())
    if unseen == "base":
        colors = torch.empty(len(kept), 3)
        colors[torch.from_numpy(np.concatenate([np.flatnonzero(kept), np.flatnonzero(~kept)]))] = (
            gaussians.colors
        )
        roughness = (colors - avatar.surfaces[0].neighbours @ colors).abs().mean(1)[torch.from_numpy(~kept)]
        assert float(roughness.mean()) < 0.02 and float(colors.std()) > 0.1  # no noise


@pytest.mark.parametrize(
    ("effect", "field", "value"),
    [
        ("pose_heads", "pose_heads_from", 1.0),
        ("pose_refinement", "refine_poses", False),
        ("subdivision", "subdivisions", 0),
        ("face_loss", "face", 0.0),
        ("visibility_gate", "gate", False),
        ("face_residual", "residual_parts", ("left_hand", "right_hand")),
    ],
)
def test_training_builds_only_what_the_plan_names(effect, field, value):
    wanted = dataclasses.replace(TINY, subdivisions=2)
    assert getattr(apply_plan(wanted, plan_of(**{effect: False})), field) == value
    assert getattr(apply_plan(wanted, plan_of()), field) == getattr(wanted, field)


@pytest.mark.parametrize(
    ("wanted", "forced", "built"), [(2, False, 1), (1, False, 1), (0, False, 0), (2, True, 2)]
)
def test_the_mesh_is_no_finer_than_the_plan_says_unless_it_was_told_to(wanted, forced, built):
    levels = Decision("subdivision", True, 2.0, 1.5, "pixels apart", "made up", forced, (1,))
    others = [one for one in plan_of().decisions if one.effect != "subdivision"]
    settings = dataclasses.replace(TINY, subdivisions=wanted)
    assert apply_plan(settings, Plan((*others, levels))).subdivisions == built


def test_without_pose_heads_there_are_none(subject, tmp_path):
    trainer = trainer_for(context_for(subject, tmp_path / "out", pose_heads_from=1.0))
    assert not [name for name, _ in trainer.avatar.named_parameters() if name.startswith("pose_")]
    trainer.step()
    assert isinstance(trainer.hooks["gate"], VisibilityGate) and not trainer.avatar.pose_heads_active
