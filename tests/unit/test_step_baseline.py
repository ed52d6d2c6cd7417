"""The training step's benchmark: both of its contestants compute the same, and its clock adds up."""

import json
import time

import numba
import pytest
import torch

from benchmarks import animate, step
from benchmarks.avatars import avatar_of
from benchmarks.parts import PartClock
from benchmarks.straightforward import StraightforwardAvatar, matched_gradients
from pipeline.avatar import Architecture
from pipeline.numba_kernels import threads

SMALL = Architecture(plane_resolution=16, plane_channels=4, width=16, groups=4)
COUNT = 7000  # head, arms and some of the torso of the unsubdivided body


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Small cases: threads would mostly wait for each other."""
    numba.get_num_threads()  # its pool, when it starts, sets torch's number of threads
    with threads(1):
        yield


@pytest.fixture
def pair():
    avatar = avatar_of(COUNT, SMALL, half_precision=False)
    return avatar, StraightforwardAvatar(avatar)


@pytest.mark.parametrize("count", [COUNT, 14_000])
def test_an_avatar_is_about_as_large_as_asked_for(count):
    assert abs(len(avatar_of(count, SMALL)) / count - 1) < 0.02


def test_a_body_without_enough_vertices_is_refused():
    with pytest.raises(ValueError, match="no 10000000 vertices"):
        avatar_of(10_000_000, SMALL)


def test_straightforward_gaussians_are_ours(pair):
    avatar, plain = pair
    pose = step.frames_of(avatar, 1, 16)[0].pose
    ours, theirs = (model.pose(model.decode(), pose) for model in pair)
    for mine, other in zip(ours.gaussians.tensors(), theirs.gaussians.tensors(), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-5)
    assert ours.pose_offset.abs().max() > 0
    torch.testing.assert_close(ours.pose_offset, theirs.pose_offset, rtol=1e-4, atol=1e-7)


def test_straightforward_gradients_are_ours_also_over_several_frames(pair):
    contestants = [
        step.Contestant(str(shared), model, step.adam(model, fused=shared), shared)
        for shared, model in zip((True, False), pair, strict=True)
    ]
    frames = step.frames_of(pair[0], 2, 48)
    image, gradient = step.difference(*contestants, frames)
    assert image < 1e-5 and gradient < 1e-2
    for one in contestants:
        one.objective(frames).backward()
    for name, (mine, theirs) in matched_gradients(*pair).items():
        assert mine.abs().max() > 0, name
        assert (mine - theirs).norm() < 1e-2 * theirs.norm(), name


def test_posing_only_what_is_seen_changes_neither_picture_nor_what_it_teaches(pair):
    avatar, plain = pair
    ours = step.Contestant("seen", avatar, step.adam(avatar, fused=True), shared=True, seen=True)
    theirs = step.Contestant("plain", plain, step.adam(plain, fused=False), shared=False)
    frames = step.frames_of(avatar, 2, 48)
    assert 0 < len(frames[0].seen) < len(avatar)
    image, gradient = step.difference(ours, theirs, frames)
    assert image < 1e-5 and gradient < 1e-2


def parts_of(row):
    """The parts that a contestant has: bases have no networks."""
    networks = {"triplane", "static heads", "pose heads"}
    return set(step.PARTS) - (networks if row["contestant"] in (step.BASES, step.TWIN) else set())


def test_bases_in_one_pass_show_and_learn_what_their_twin_does():
    one, twin = step.bases_of(COUNT, "cpu")
    image, gradient = step.bases_difference(one, twin, step.frames_of(one.model, 2, 48))
    assert image < 1e-6 and gradient < 1e-4


def test_a_step_has_a_row_a_contestant_with_every_part(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(step, "avatar_of", lambda count, **kwargs: avatar_of(count, SMALL, **kwargs))
    path = tmp_path / "step.json"
    words = ["--gaussians", str(COUNT), "--sizes", "32", "--repeats", "2", "--json", str(path)]
    assert step.main(words) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert "straightforward takes" in last and "Gaussians at 32²" in last
    rows = json.loads(path.read_text())["rows"]
    names = [step.OURS, step.ALL, step.OURS_SINGLE, step.PLAIN, step.BASES, step.TWIN]
    assert [row["contestant"] for row in rows] == names
    for row in rows:
        assert len(row["steps"]) == 2 and all(set(one) == parts_of(row) for one in row["steps"])
        assert row["step_ms"] == pytest.approx(min(sum(one.values()) for one in row["steps"]))


def test_animation_has_a_row_a_contestant_and_a_headline(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(animate, "avatar_of", lambda count, _: avatar_of(count, SMALL))
    path = tmp_path / "animate.json"
    words = ["--gaussians", str(COUNT), "--sizes", "32", "--repeats", "2", "--json", str(path)]
    assert animate.main(words) == 0
    assert "frames a second" in capsys.readouterr().out.splitlines()[-1]
    rows = json.loads(path.read_text())["rows"]
    assert len(rows) == 4 and all(len(row["posing"]) == 2 for row in rows)
    for row in rows:
        assert row["asset_mib"] == 14 * 4 * row["gaussians"] / 2**20  # as the paper counts it


class Slow(torch.autograd.Function):
    """Waits forwards, and twice as long backwards."""

    @staticmethod
    def forward(ctx, x):
        time.sleep(0.02)
        return 2 * x

    @staticmethod
    def backward(ctx, gradient):
        time.sleep(0.04)
        return 2 * gradient


def test_the_clock_counts_a_part_in_both_directions_and_changes_nothing():
    clock, x = PartClock("rest"), torch.ones(3, requires_grad=True)
    slow = clock.timed("slow", Slow.apply)
    clock.start()
    (slow(3 * x) * 5).sum().backward()
    clock.stop()
    assert torch.equal(x.grad, torch.full((3,), 30.0))
    assert set(clock.spent) == {"slow", "rest"}
    assert clock.spent["slow"] >= 0.06  # sleeping lasts at least as long as asked for
