"""Training when things go wrong: spikes, bad frames, rates that are far too high, long runs."""

import os

import numpy as np
import pytest
import torch

from pipeline import device
from pipeline.avatar import load_avatar
from pipeline.clip.frames import frame_path, write_frame, write_mask
from pipeline.errors import UserError
from pipeline.finite import NotFiniteError
from stages.train import run as stage
from stages.train import schedule
from stages.train.checkpoint import NAME, read_checkpoint
from stages.train.held_out import held_out_psnr, require_progress
from tests.made.body import open_body
from tests.made.portrait import (
    HEIGHT,
    TINY,
    WIDTH,
    change_loss,
    context_for,
    run_counted,
    trainer_for,
    with_footage,
)

SIZE = (HEIGHT, WIDTH)


def checkpoint_of(context):
    """The checkpoint that a stopped run left, whatever its key."""
    import json

    import safetensors

    with safetensors.safe_open(context.work / NAME, "pt") as file:
        key = json.loads(file.metadata()["checkpoint"])["key"]
    return read_checkpoint(context.work, key)


def all_finite(tensors):
    return all(bool(tensor.isfinite().all()) for tensor in tensors)


def steps(trainer, count):
    taken = [trainer.step() for _ in range(count)]
    assert np.isfinite([value for values in taken for value in values.values()]).all()
    trainer.require_finite()
    return [sum(values.values()) for values in taken]


# Frames


def test_a_frame_of_noise_among_good_ones_is_a_spike_and_no_more(subject, tmp_path):
    place = with_footage(subject, tmp_path / "noise")
    noise = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    write_frame(place / "ingest" / "frames", 2, noise)
    settings = {"iterations": 8, "face": 0.0}
    trainer = trainer_for(context_for(place, tmp_path / "out", **settings))
    clean = trainer_for(context_for(subject, tmp_path / "clean", **settings))
    steps(trainer, 8)
    steps(clean, 8)
    scores = [held_out_psnr(one, clean.data.clip.split.test) for one in (trainer, clean)]
    assert scores[0] > scores[1] - 6


@pytest.mark.parametrize("value", [0, 255], ids=["nobody", "everything is the person"])
def test_a_frame_with_an_empty_or_a_full_mask_is_trained_through(subject, tmp_path, value):
    place = with_footage(subject, tmp_path / "mask")
    write_mask(place / "ingest" / "masks", 1, np.full(SIZE, value, np.uint8))
    context = context_for(place, tmp_path / "out", iterations=6, face=0.0)
    stage.run(context)
    load_avatar(context.output / "avatar.safetensors", open_body())


@pytest.mark.parametrize("value", [0, 255], ids=["black", "white"])
def test_black_and_white_frames_are_trained_through(subject, tmp_path, value):
    place = with_footage(subject, tmp_path / "flat")
    for frame in range(5):
        write_frame(place / "ingest" / "frames", frame, np.full((*SIZE, 3), value, np.uint8))
    trainer = trainer_for(context_for(place, tmp_path / "out", face=0.0))
    steps(trainer, 6)


def test_masks_of_nobody_at_all_are_refused(subject, tmp_path):
    place = with_footage(subject, tmp_path / "nobody")
    for frame in range(6):
        write_mask(place / "ingest" / "masks", frame, np.zeros(SIZE, np.uint8))
    context = context_for(place, tmp_path / "out")
    with pytest.raises(UserError, match="shows nobody in the training frames; check the footage"):
        stage.run(context)
    assert not list(context.output.iterdir())


def test_a_damaged_frame_among_good_ones_stops_the_run_by_its_name(subject, tmp_path):
    place = with_footage(subject, tmp_path / "damaged")
    path = frame_path(place / "ingest" / "frames", 3)
    path.write_bytes(path.read_bytes()[:60])
    context = context_for(place, tmp_path / "out", initial_color=False, face=0.0)
    with pytest.raises(UserError, match=r"000003\.png is not a readable picture: run the ingest stage"):
        stage.run(context)
    assert not list(context.output.iterdir())


def test_one_frame_and_nothing_held_out(subject, tmp_path):
    from pipeline.clip.records import Split, write_split

    place = with_footage(subject, tmp_path / "single")
    write_split(place / "ingest" / "split.json", Split(train=(2,), test=()))
    context = context_for(place, tmp_path / "out")
    stage.run(context)
    assert (context.output / "avatar.safetensors").exists()


# Losses


def test_a_loss_spike_does_not_move_the_weights_further_than_a_step(subject, tmp_path, monkeypatch):
    """Adam divides by the spike what the spike multiplied: a million times the loss, one step's length."""
    trainer = trainer_for(context_for(subject, tmp_path / "out", iterations=20))
    steps(trainer, 6)
    weights = trainer.avatar.parameters
    before = torch.nn.utils.parameters_to_vector(weights()).detach().clone()
    change_loss(monkeypatch, "l1", lambda loss, pair: 1e6 * loss(*pair))
    trainer.step()
    moved = (torch.nn.utils.parameters_to_vector(weights()) - before).abs().max()
    assert moved < 12 * TINY.plane_learning_rate
    monkeypatch.undo()
    after = steps(trainer, 8)
    assert after[-1] < 10


def test_a_loss_of_the_largest_numbers_stops_by_name(subject, tmp_path, monkeypatch):
    trainer = trainer_for(context_for(subject, tmp_path / "out"))
    change_loss(monkeypatch, "l1", lambda loss, pair: 1e38 * 100 * loss(*pair).mean())
    with pytest.raises(NotFiniteError, match="loss term 'l1' is inf at iteration 0, frame"):
        trainer.step()


def test_a_slope_that_is_not_finite_stops_before_any_weight_moves(subject, tmp_path, monkeypatch):
    """The loss is finite; its slope, the root's at nothing, is not."""
    context = context_for(subject, tmp_path / "out", checkpoint_every=2, iterations=8)
    calls = []

    def rooted(loss, pair):
        calls.append(1)
        value = loss(*pair)
        return value + (value - value.detach()).square().sqrt() if len(calls) == 6 else value

    change_loss(monkeypatch, "l1", rooted)
    frame = schedule.drawn_frame(TINY.seed, (0, 1, 2, 3, 4), 5)
    with pytest.raises(NotFiniteError, match=f"the gradient of .* not finite at iteration 5, frame {frame} "):
        stage.run(context)
    assert not list(context.output.iterdir())
    saved = checkpoint_of(context)
    assert saved.iteration == 4 and all_finite(saved.tensors.values())
    monkeypatch.undo()
    assert run_counted(context, monkeypatch) == list(range(4, 8))


def test_every_frame_of_a_step_is_named(subject, tmp_path, monkeypatch):
    trainer = trainer_for(context_for(subject, tmp_path / "out", batch=2))
    change_loss(monkeypatch, "ssim", lambda loss, pair: loss(*pair) * float("nan"))
    with pytest.raises(NotFiniteError, match=r"loss term 'ssim' is nan at iteration 0, frames \d, \d;"):
        trainer.step()


# Rates


def far_too_high(factor):
    """The triplane's rates, all multiplied."""
    names = ("learning_rate", "plane_learning_rate", "pose_learning_rate")
    return {"warm_up": 1, **{name: factor * getattr(TINY, name) for name in names}}


NAMES = ("color", "offset", "scale", "bases")
BASES = {"representation": "bases", "bases": 1, "warm_up": 0, "offset_unit": 1.0}
BASES |= {f"{name}_learning_rate": 0.9 for name in NAMES}


@pytest.mark.parametrize(
    ("rates", "name"),
    [
        (far_too_high(100), "learning_rate"),
        pytest.param(far_too_high(1e4), "learning_rate", marks=pytest.mark.soak),
        (BASES, "color_learning_rate"),
    ],
    ids=["a hundred times", "ten thousand times", "bases"],
)
def test_rates_far_too_high_end_with_a_clear_error_and_the_last_good_checkpoint(
    subject, tmp_path, rates, name
):
    """Finite ruins; before, they were published. Rates that overflow are refused as settings."""
    settings = {"iterations": 30, "held_out_every": 4, "checkpoint_every": 1, "face": 0.0}
    context = context_for(subject, tmp_path / "out", **settings, **rates)
    with pytest.raises(UserError, match=rf"training stopped: .*{name}.* checkpoint is kept, nothing"):
        stage.run(context)
    assert not list(context.output.iterdir())
    saved = checkpoint_of(context)
    assert saved.iteration in (1, 3) and all_finite(saved.tensors.values())


def test_a_worse_avatar_is_refused_and_a_better_one_is_not():
    for before, after in ((20.0, 17.1), (20.0, 30.0), (37.0, 25.1)):
        require_progress(before, after, 250, TINY)
    with pytest.raises(UserError, match=r"after 250 iterations its pictures are worse .* 16\.9 dB of 20\.0"):
        require_progress(20.0, 16.9, 250, TINY)


# Long


def drift(subject, tmp_path, count, **settings):
    """The loss of every step, and the held-out PSNR at the end."""
    trainer = trainer_for(context_for(subject, tmp_path, iterations=count, **settings))
    taken = steps(trainer, count)
    return np.array(taken), held_out_psnr(trainer, trainer.data.clip.split.test)


def test_bfloat16_follows_float32_over_a_few_steps(subject, tmp_path, monkeypatch):
    monkeypatch.setattr(device, "multiplies_bfloat16", lambda device: True)
    half, single = (
        drift(subject, tmp_path / name, 6, half_precision=name == "half") for name in ("half", "single")
    )
    assert np.abs(half[0] - single[0]).max() < 0.05 * single[0][0]
    assert abs(half[1] - single[1]) < 0.5


@pytest.mark.soak
@pytest.mark.timeout(3000)
def test_thousands_of_steps_on_one_frame(subject, tmp_path):
    from pipeline.clip.records import Split, write_split

    place = with_footage(subject, tmp_path / "single")
    write_split(place / "ingest" / "split.json", Split(train=(2,), test=(5,)))
    count = int(os.environ.get("FLEXIAVATAR_SOAK_STEPS", "4000"))
    trainer = trainer_for(context_for(place, tmp_path / "out", iterations=count))
    taken = steps(trainer, count)
    print(f"seed {TINY.seed}: loss {taken[0]:.4f} to {taken[-1]:.4f} in {count} steps")
    assert taken[-1] < 0.5 * taken[0]


def test_a_settled_run_stays_settled(subject, tmp_path):
    """Nothing is left to learn: Adam's second moments fade, and its steps must not blow up."""
    trainer = trainer_for(
        context_for(subject, tmp_path / "out", iterations=24, final_rate=1.0, warm_up=1, face=0.0)
    )
    taken = steps(trainer, 24)
    assert max(taken[12:]) < 1.5 * max(taken[:10])
