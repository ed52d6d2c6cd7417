"""Otsu's threshold and the visibility gate: all shapes of histogram, everything gated, flicker."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.avatar import Avatar
from pipeline.avatar.otsu_threshold import (
    BINS,
    LARGEST_LOSS,
    LEAST_CUT,
    evidence_threshold,
    fixed_threshold,
    histogram,
    otsu_threshold,
    share_below,
)
from pipeline.body import mean_identity
from pipeline.errors import UserError
from pipeline.untrusted import parse_json
from stages.train import run as stage
from stages.train.frame_evidence import settle_unseen
from stages.train.visibility_gate import VisibilityGate
from tests.made.body import open_body
from tests.made.portrait import TINY, context_for, trainer_for, with_poses
from tests.stability.test_skinning import SMALL

RNG = np.random.default_rng(0)
SHAPES = {
    "all 0": np.zeros(100),
    "all 1": np.ones(100),
    "all in one bin": np.full(100, 0.5) + RNG.uniform(0, 1e-4, 100),
    "one score": np.array([0.3]),
    "two equal scores": np.array([0.3, 0.3]),
    "two neighbouring bins": np.repeat([100 / BINS, 101 / BINS], 50),
    "0 and 1": np.repeat([0.0, 1.0], 50),
    "one outlier low": np.r_[0.0, np.ones(9999)],
    "one outlier high": np.r_[np.zeros(9999), 1.0],
    "three spikes": np.repeat([0.0, 0.5, 1.0], [30, 30, 40]),
    "a spike every bin": (np.arange(BINS) + 0.5) / BINS,
    "on the bins' edges": np.arange(BINS + 1) / BINS,
    "uniform": RNG.random(5000),
    "bell": np.clip(RNG.normal(0.5, 0.1, 5000), 0, 1),
    "two bells": np.clip(np.r_[RNG.normal(0.2, 0.05, 2000), RNG.normal(0.9, 0.05, 3000)], 0, 1),
    "bathtub": RNG.beta(0.2, 0.2, 5000),
    "exponential": np.clip(RNG.exponential(0.05, 5000), 0, 1),
    "1 frame in 5,000": np.repeat([0.0, 2e-4, 1.0], [300, 300, 400]),
    "denormal scores": np.repeat([5e-324, 1.0], [400, 600]),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_every_histogram_has_a_threshold_within_its_range(shape):
    scores = SHAPES[shape]
    tau, separability, low = otsu_threshold(histogram(scores))
    assert 0 <= tau <= 1 and 0 <= separability <= 1 + 1e-9 and 0 <= low <= tau
    for found in (evidence_threshold(scores), fixed_threshold(scores, 0.5)):
        values = (found.tau, found.otsu, found.separability, found.low_mean, found.cut, found.lost)
        assert np.isfinite(values).all() and found.why
        assert 0 <= found.cut <= 1 and 0 <= found.lost <= 1
    found = evidence_threshold(scores)
    if found.closed:
        assert found.lost <= LARGEST_LOSS and found.cut >= LEAST_CUT
        assert (scores >= found.tau).any()  # something is left


def test_a_threshold_never_gates_everything():
    for scores in SHAPES.values():
        assert (scores >= evidence_threshold(scores).tau).any()


def test_scores_that_differ_by_rounding_give_one_threshold():
    """Counts divided by the number of looks: 1/3 is not exactly what 2/6 is in float32."""
    for looks in (3, 7, 500, 4999):
        hits = np.repeat([0, looks // 3, looks], [300, 5, 700])
        thresholds = {
            evidence_threshold(np.float64(np.float32(hits / looks))).tau,
            evidence_threshold(hits / looks).tau,
        }
        assert len(thresholds) == 1


@pytest.mark.parametrize(
    "scores", [np.zeros(0), np.array([0.2, np.nan]), np.array([-0.1, 0.5]), np.array([0.5, 1.1])]
)
def test_scores_that_are_none_are_refused(scores):
    with pytest.raises(ValueError, match="scores"):
        histogram(scores)


# In training


def test_a_gate_that_would_take_everything_stays_open_and_says_so(subject, tmp_path):
    """A threshold set by hand that no vertex reaches."""
    settings = {"gate_threshold": 1.0, "gate_from": 0.25, "gate_every": 2, "iterations": 8}
    trainer = trainer_for(context_for(subject, tmp_path / "out", **settings))
    before = int(trainer.avatar.active.sum())
    trainer.hooks["gate"].drawn[:] = 10
    trainer.hooks["gate"].hits[:] = 9
    found = trainer.hooks["gate"].update()
    assert not found.closed and "all of the body" in found.why
    assert int(trainer.avatar.active.sum()) == before
    values = trainer.step()
    assert np.isfinite(list(values.values())).all()
    (tmp_path / "written").mkdir()
    evidence = settle_unseen(trainer.avatar, trainer.poses, trainer.data, trainer.settings)
    trainer.hooks["gate"].write(tmp_path / "written", evidence)
    assert parse_json(tmp_path / "written" / "gate.json", "")["tau"] == 0


def test_an_avatar_without_any_point_is_refused():
    body = open_body()
    with pytest.raises(ValueError, match="kept vertices"):
        Avatar(body, mean_identity(body), torch.zeros(0, dtype=torch.long), SMALL)
    avatar = Avatar(body, mean_identity(body), torch.arange(50), SMALL)
    with pytest.raises(ValueError, match="at least one"):
        avatar.gate(torch.zeros(50, dtype=torch.bool))


def test_a_body_outside_every_picture_is_refused(subject, tmp_path):
    def away(poses):
        return dataclasses.replace(poses, transl=poses.transl + torch.tensor([50.0, 0, 0]))

    context = context_for(with_poses(subject, tmp_path / "away", away), tmp_path / "out")
    with pytest.raises(UserError, match="outside every frame; run fit again"):
        stage.run(context)
    assert not list(context.output.iterdir())


def test_flicker_at_the_threshold_keeps_training_finite_and_weights_in_place(subject, tmp_path):
    """A hundred vertices cross the threshold at every look."""
    settings = {"gate_from": 1.0, "iterations": 12, "subdivisions": 1, "subdivide_from": 0.3}
    trainer = trainer_for(context_for(subject, tmp_path / "out", **settings))
    on = trainer.avatar.active.clone()
    off = on.clone()
    off[torch.nonzero(on)[::7][:100, 0]] = False
    sizes = set()
    for step in range(8):
        trainer.avatar.gate(on if step % 2 else off)
        values = trainer.step()
        sizes.add(len(trainer.avatar))
        assert np.isfinite(list(values.values())).all()
    assert len(sizes) > 1
    trainer.require_finite()


def test_flickering_gate_gives_the_same_run_twice(subject, tmp_path):
    settings = {"gate_from": 1.0, "iterations": 4}
    ends = []
    for name in ("one", "two"):
        trainer = trainer_for(context_for(subject, tmp_path / name, **settings))
        on = trainer.avatar.active.clone()
        off = on.clone()
        off[torch.nonzero(on)[::5][:200, 0]] = False
        for step in range(4):
            trainer.avatar.gate(on if step % 2 else off)
            trainer.step()
        ends.append(torch.nn.utils.parameters_to_vector(trainer.avatar.parameters()))
    assert torch.equal(*ends)


def test_what_was_never_looked_at_has_a_score_of_zero():
    body = open_body()
    avatar = Avatar(body, mean_identity(body), torch.arange(50), SMALL)
    gate = VisibilityGate(avatar, len(body.v_template), TINY)
    assert not gate.scores().any() and gate.scores().isfinite().all()
    found = gate.update()
    assert not found.closed and bool(avatar.active.all())
    assert share_below(np.zeros(5), 0.5) == (1.0, 0.0)
