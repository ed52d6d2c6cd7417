"""The train stage on a tiny synthetic subject: what it learns, resumes, publishes and refuses."""

import dataclasses

import pytest
import torch

from pipeline.avatar import load_avatar
from pipeline.body import Poses, read_poses
from pipeline.body import poses as poses_module
from pipeline.clip import curves
from pipeline.clip.fitted_clip import read_fitted_clip
from pipeline.errors import UserError
from pipeline.files.tables import read_table
from pipeline.splat import render
from stages.train import run as stage
from stages.train.held_out import held_out_psnr
from stages.train.loop import Trainer
from stages.train.visibility_gate import SCHEMA
from tests.made.portrait import (
    bytes_of,
    change_loss,
    context_for,
    run_counted,
    trainer_for,
    with_poses,
)

PUBLISHED = {
    "avatar.safetensors", "curve.parquet", "gate.json", "poses.parquet", "visibility.parquet",
    "visibility.png",
}  # fmt: skip
KINDS = {"triplane": {}, "bases": {"representation": "bases", "bases": 1}}


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    """A representation, as settings name it."""
    return request.param


@pytest.fixture(scope="module")
def finished(kind, subject, tmp_path_factory):
    """What one uninterrupted run publishes."""
    context = context_for(subject, tmp_path_factory.mktemp(kind) / "finished", **KINDS[kind])
    stage.run(context)
    return context.output


@pytest.fixture(scope="module")
def learnt(finished, body):
    """Its avatar, read back."""
    return load_avatar(finished / "avatar.safetensors", body)


only_triplane = pytest.mark.parametrize("kind", ["triplane"], indirect=True)
only_bases = pytest.mark.parametrize("kind", ["bases"], indirect=True)


def test_publishes_everything_and_all_of_it_finite(kind, finished, learnt):
    assert set(bytes_of(finished)) == PUBLISHED
    rows = read_table(finished / "curve.parquet", curves.SCHEMA, "")
    expected = {"l1", "ssim", "face", "laplacian_offset", "psnr", "gaussians"}
    assert expected | ({"residual_size"} if kind == "triplane" else set()) <= set(rows["name"])
    assert set(rows["iteration"]) == {6, 12}
    assert all(bool(tensor.isfinite().all()) for tensor in learnt.state_dict().values())


def test_another_seed_another_avatar(subject, tmp_path):
    first, same, other = (
        trainer_for(context_for(subject, tmp_path / name, seed=seed))
        for name, seed in (("first", 0), ("same", 0), ("other", 1))
    )
    weights = [torch.nn.utils.parameters_to_vector(one.avatar.parameters()) for one in (first, same, other)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_killed_and_rerun_gives_the_same_bytes(kind, subject, finished, tmp_path, monkeypatch):
    context = context_for(subject, tmp_path / "out", **KINDS[kind])
    run_counted(context, monkeypatch, kill_at=8)
    assert not list(context.output.iterdir())
    assert run_counted(context, monkeypatch) == list(range(5, 12))  # a checkpoint every five iterations
    assert bytes_of(context.output) == bytes_of(finished)
    # What the killed process took up to its checkpoint is not forgotten.
    timings = context.timings
    iterations, wall, cpu = zip(*timings["curve_seconds"], strict=True)
    assert iterations == (6, 12) and sorted(wall) == list(wall) and sorted(cpu) == list(cpu)
    assert 0 < timings["earlier_seconds"] < wall[0] and 0 < timings["earlier_cpu_seconds"] < cpu[0]
    assert timings["train_seconds"] >= wall[-1]


def test_training_comes_closer_to_the_training_frames(subject, tmp_path):
    context = context_for(
        subject,
        tmp_path / "out",
        iterations=15,
        initial_color=False,
        subdivisions=1,
        subdivide_from=0.8,
        learning_rate=1e-2,
        warm_up=1,
    )
    trainer = trainer_for(context)
    frames = trainer.data.clip.split.train
    before = held_out_psnr(trainer, frames)
    assert trainer.level == 0
    while trainer.iteration < 15:
        trainer.step()
    assert trainer.level == 1
    assert held_out_psnr(trainer, frames) > before + 3


def test_initial_colors_are_near_the_truth(subject, tmp_path):
    context = context_for(subject, tmp_path / "out")
    trainer = trainer_for(context)
    grey = trainer_for(context_for(subject, tmp_path / "grey", initial_color=False))
    frames = trainer.data.clip.split.test
    assert held_out_psnr(trainer, frames) > held_out_psnr(grey, frames) + 5


@only_triplane
def test_gate_keeps_what_is_seen_and_its_surroundings(subject, finished, body, tmp_path):
    table = read_table(finished / "visibility.parquet", SCHEMA, "")
    seen, kept = table["captured"] > 0, table["kept"]
    assert kept[seen].all() and 0 < seen.sum() < kept.sum() < len(kept) / 2
    assert not table["generated"].any() and not (table["early"] & kept).any()
    assert body.v_template[~torch.from_numpy(kept), 1].min() < -1  # the feet are gone
    context = context_for(subject, tmp_path / "open", gate=False)
    assert len(trainer_for(context).avatar) == len(kept)


def test_refined_poses_change_in_training_frames_only(subject, finished):
    fitted, refined = read_poses(subject / "fit" / "poses.parquet"), read_poses(finished / "poses.parquet")
    assert fitted.frames == refined.frames
    assert (refined.rotation[:-1] != fitted.rotation[:-1]).any(2).any(1).all()
    assert torch.equal(refined.rotation[-1], fitted.rotation[-1])
    assert torch.equal(refined.transl[-1], fitted.transl[-1])
    assert (refined.rotation - fitted.rotation).abs().max() < 0.05


def test_only_drawn_frames_move(subject, tmp_path):
    trainer = trainer_for(context_for(subject, tmp_path / "out", refine_from=0.0))
    trainer.step()
    trainer.step()
    moved = [name for name, change in trainer.poses.rotation.items() if bool((change != 0).any())]
    assert len(moved) == 2


def test_published_avatar_renders_the_held_out_frame_as_training_saw_it(subject, kind, body, tmp_path):
    """Without completion, whose Gaussians are pixels wide in a picture of this size."""
    context = context_for(subject, tmp_path / "left", **KINDS[kind] | {"unseen": "generated"})
    stage.run(context)
    finished = context.output
    learnt = load_avatar(finished / "avatar.safetensors", body)
    clip = read_fitted_clip(subject / "ingest", subject / "fit", body)
    view = clip.view(5)
    with torch.no_grad():
        gaussians = learnt.gaussians(clip.pose(5), clip.seconds[5])
        rendering = render(gaussians, view.camera)
    error = (rendering.color - view.composite(torch.zeros(3))).square().mean()
    curve_rows = read_table(finished / "curve.parquet", curves.SCHEMA, "")
    last = curve_rows["value"][(curve_rows["name"] == "psnr") & (curve_rows["iteration"] == 12)]
    assert -10 * torch.log10(error) == pytest.approx(float(last[0]), abs=0.05)


@only_triplane
def test_published_avatar_has_learnt_residuals_of_what_is_seen(learnt):
    residuals = learnt.representation.residuals
    assert list(residuals.heads) == ["face"]  # the hands hang below the picture
    assert learnt.residuals_active and learnt.pose_heads_active
    torch.testing.assert_close(residuals.time_range, torch.tensor([0.5, 0.9]))
    assert bool((residuals.heads["face"].last.weight != 0).any())


@only_bases
def test_published_avatar_has_learnt_bases_of_what_is_seen(learnt):
    assert (learnt.architecture.representation, learnt.architecture.bases) == ("bases", 1)
    assert not learnt.architecture.residual_parts and learnt.pose_heads_active
    made = learnt.representation
    assert all(bool((one != 0).any()) for one in (made.offset, made.log_scale, made.color, made.bases))
    assert bool((made.bases == 0).all(1).any())  # the back of the head was never seen


def test_residuals_can_be_left_out(subject, tmp_path):
    trainer = trainer_for(context_for(subject, tmp_path / "never", residual_from=1.0))
    assert not trainer.avatar.representation.residuals.heads
    assert "residual_size" not in trainer.step()


def test_residuals_begin_when_they_are_told_to(subject, tmp_path):
    trainer = trainer_for(context_for(subject, tmp_path / "out", residual_from=0.25))
    assert ["residual_size" in trainer.step() for _ in range(5)] == [False, False, False, True, True]


def test_term_that_is_not_finite_stops_with_its_name_and_iteration(subject, tmp_path, monkeypatch):
    context = context_for(subject, tmp_path / "out", iterations=3)
    calls = []

    def poisoned(loss, operands):
        calls.append(1)
        return loss(*operands) * (float("nan") if len(calls) == 3 else 1)

    change_loss(monkeypatch, "ssim", poisoned)
    with pytest.raises(UserError, match="loss term 'ssim' is nan at iteration 2"):
        stage.run(context)
    assert not list(context.output.iterdir())


def test_weight_that_is_not_finite_is_never_published(subject, tmp_path, monkeypatch):
    context = context_for(subject, tmp_path / "out", iterations=3)
    original = Trainer.step

    def step(self):
        values = original(self)
        if self.iteration == 3:
            self.avatar.representation.color.last.bias.data[0] = float("inf")
        return values

    monkeypatch.setattr(Trainer, "step", step)
    with pytest.raises(UserError, match="color.last.bias is not finite after iteration 3"):
        stage.run(context)
    assert not list(context.output.iterdir())


def without_last(poses: Poses) -> Poses:
    return Poses(poses.frames[:-1], poses.rotation[:-1], poses.expression[:-1], poses.transl[:-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without_last, "no pose for frame 5"),
        (lambda poses: dataclasses.replace(poses, transl=poses.transl * float("nan")), "finite"),
        (lambda poses: dataclasses.replace(poses, transl=-poses.transl), "outside every frame"),
    ],
)
def test_poses_that_cannot_be_used_say_what_to_do(subject, tmp_path, change, message, monkeypatch):
    monkeypatch.setattr(poses_module, "rows_not_finite", lambda values: [])  # somebody else wrote them
    with pytest.raises(UserError, match=message) as caught:
        stage.run(context_for(with_poses(subject, tmp_path / "altered", change), tmp_path / "out"))
    assert "fit" in str(caught.value)


def test_resumed_run_takes_up_the_skinning_weights_where_they_were(subject, tmp_path):
    settings = {"skinning": "nearest", "skin_every": 4, "face": 0.0}
    through, stopped, resumed = (
        trainer_for(context_for(subject, tmp_path / name, **settings)) for name in ("one", "two", "three")
    )
    for _ in range(8):
        through.step()
    for _ in range(6):
        stopped.step()
    resumed.resume(stopped.checkpoint("key"))
    assert bool((resumed.avatar.skin_rows >= 0).any())
    for _ in range(2):
        resumed.step()
    assert torch.equal(resumed.avatar.skin_rows, through.avatar.skin_rows)
    weights = [torch.nn.utils.parameters_to_vector(one.avatar.parameters()) for one in (through, resumed)]
    assert torch.equal(*weights)
