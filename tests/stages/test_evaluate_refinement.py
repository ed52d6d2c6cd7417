"""What the person is composited on, and held-out poses refined on their own images."""

import dataclasses
import io
import json
import math
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from rich.console import Console

from pipeline.body import Pose, read_poses, write_poses
from pipeline.clip.camera import project
from pipeline.clip.curves import Curve
from pipeline.clip.frames import read_mask, write_mask
from pipeline.clip.plan import Plan, write_plan
from pipeline.config.evaluation_protocol import PROTOCOLS
from pipeline.metrics import psnr
from stages.evaluate.evaluated_clip import read_evaluated_clip
from stages.evaluate.methods import AVATAR, AvatarMethod, pose_gradient_animation
from stages.evaluate.refinement_allowance import allowance, is_asked_for
from stages.evaluate.report.terminal import show_summary
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.summary import protocol_sentences
from stages.evaluate.test_pose_refinement import EFFECT, NOT_REFINED, frame_loss, refine, refined_pose
from tests.made.blob import FRAMES, HEIGHT, TEST, WIDTH, make_clip, moving_poses, stand_in
from tests.made.body import open_body
from tests.made.plans import plan_of
from tests.made.portrait import moving_poses as body_poses
from tests.made.portrait import painted_avatar, write_trained


@pytest.fixture
def clip(tmp_path):
    return make_clip(tmp_path, soft=True)


def displace(clip):
    """The fit's poses 2 cm aside: 0.7 pixels of the tiny clip."""
    write_poses(clip.inputs["fit"] / "poses.parquet", moving_poses(shift=0.02))


def summary_of(output):
    return json.loads((output / "summary.json").read_text())


def held_out(output):
    return summary_of(output)["means"]["test"]


def must_not_be_asked(*_):
    raise AssertionError("nothing is refined, so nothing needs a gradient")


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """A displaced clip whose plan calls for refinement, evaluated without it, with it, and with it again."""
    clip = make_clip(tmp_path_factory.mktemp("displaced"), soft=True)
    displace(clip)
    write_plan(clip.inputs["plan"] / "plan.json", plan_of())
    off = clip.evaluate(name="off", follow=must_not_be_asked, refine_test_poses="off")
    asked = {"refine_test_poses": "on", "refine_steps": 30}
    return off, *(clip.evaluate(name=name, **asked) for name in ("on", "again"))


# The background


def test_the_interior_does_not_depend_on_the_background_and_the_rest_does(clip):
    for frame in FRAMES:  # a mask that is not quite 1 inside, as masks are
        mask = read_mask(clip.inputs["ingest"] / "masks", frame)
        write_mask(clip.inputs["ingest"] / "masks", frame, (mask * 0.8).astype(np.uint8))
    never = {"follow": must_not_be_asked}  # nor does the plan call for it
    black, white = (clip.evaluate(name=name, background=name, **never) for name in ("black", "white"))
    for split, method in (("test", "avatar"), ("test", "mean_frame"), ("train", "avatar")):
        one, other = (summary_of(output)["means"][split][method] for output in (black, white))
        assert one["psnr_interior"] == other["psnr_interior"]
        assert one["psnr"] != other["psnr"] and one["ssim"] != other["ssim"]
    for output in (black, white):
        summary = summary_of(output)
        assert summary["background"] == output.name
        assert "avatar_refined" not in held_out(output) and summary["refined"]["frames"] == 0
        text = io.StringIO()
        show_summary(summary, "report.html", Console(file=text))
        said = (summary["protocol"], (output / "report.html").read_text(), text.getvalue())
        assert all(f"on {output.name}" in one for one in said)
        assert "made up" in said[1]  # why the plan left refinement out


def test_on_white_every_picture_stands_on_white_and_refines_there(clip):
    displace(clip)
    means = held_out(clip.evaluate(background="white", refine_test_poses="on", refine_steps=30))
    assert means["mean_frame"]["psnr"] < means["nearest_frame"]["psnr"] < means["avatar"]["psnr"]
    assert means["avatar_refined"]["psnr"] > means["avatar"]["psnr"] + 5
    evaluated = clip.clip()
    drawn = AvatarMethod(AVATAR, evaluated, stand_in, TEST).render(TEST[0])("white")
    for picture in (evaluated.person(TEST[0], "white"), drawn):
        assert torch.equal(picture[0, 0], torch.ones(3))  # a corner where nobody stands


# Refinement of the whole stage


def test_refined_numbers_stand_beside_the_others(outputs):
    off, on, _ = outputs
    before, after = held_out(off), held_out(on)
    assert after.pop("avatar_refined")["psnr"] > before["avatar"]["psnr"] + 5
    assert after == before
    moved = read_poses(on / "test_poses.parquet")
    assert moved.frames == TEST and bool(moved.valid.all())
    error = (moved.transl - moving_poses().transl[-3:])[:, :2].abs()
    assert float(error.max()) < 0.005  # of 0.02 metres
    rows = pq.read_table(on / "metrics.parquet").to_pylist()
    assert {row["frame"] for row in rows if row["method"] == "avatar_refined"} == set(TEST)


def test_the_refinement_is_shown_and_no_longer_left_out(outputs):
    report, text = (outputs[1] / "report.html").read_text(), io.StringIO()
    show_summary(summary_of(outputs[1]), "report.html", Console(file=text))
    score = f"{held_out(outputs[1])['avatar_refined']['psnr']:.2f}"
    assert score in report and score in text.getvalue() and "30 steps" in summary_of(outputs[1])["protocol"]


def test_off_leaves_nothing_behind_and_says_why(outputs):
    off = outputs[0]
    assert "avatar_refined" not in held_out(off) and not (off / "test_poses.parquet").exists()
    assert summary_of(off)["refined"] == {"frames": 0, "stopped": [], "steps": 0}
    report = (off / "report.html").read_text()
    assert "evaluate.refine_test_poses=off" in report


def test_equal_runs_give_equal_bytes(outputs):
    for name in ("test_poses.parquet", "metrics.parquet", "summary.json", "comparison.png"):
        assert (outputs[1] / name).read_bytes() == (outputs[2] / name).read_bytes(), name


@pytest.mark.parametrize("asked", ["on", "off"])
@pytest.mark.parametrize("planned", [True, False])
def test_settings_overrule_and_nothing_else_does(asked, planned):
    plan = plan_of(test_time_refinement=planned)
    assert is_asked_for(EvaluateSettings(refine_test_poses=asked), plan) == (asked == "on")
    assert is_asked_for(EvaluateSettings(), plan) is None
    decisions = [dataclasses.replace(one, forced=one.effect == EFFECT) for one in plan.decisions]
    assert is_asked_for(EvaluateSettings(), Plan(tuple(decisions))) == planned


# What it costs


@pytest.mark.parametrize(
    ("steps", "frames", "each"),
    [(100_000, 3, 60), (1200, 3, 40), (300, 2, 12), (180, 1, 12), (20, 0, 0)],
)
def test_by_default_it_takes_a_share_of_the_work_of_training(clip, monkeypatch, steps, frames, each):
    """First fewer steps, then fewer frames; the person's box is half of the picture."""
    evaluated = clip.clip()
    half = SimpleNamespace(width=WIDTH, height=HEIGHT / 2)
    monkeypatch.setattr(type(evaluated), "person_box", lambda self, margin: half)
    allowed = allowance(evaluated, EvaluateSettings(refine_share=0.2), None, steps)
    assert (len(allowed.frames), allowed.steps) == (frames, each)
    assert 2 * frames * each <= 0.2 * steps + 1
    assert ("training" in allowed.why) == bool(frames)
    asked = allowance(evaluated, EvaluateSettings(), True, steps)
    assert (len(asked.frames), asked.steps) == (len(TEST), 60) and "%" in asked.why
    assert not allowance(evaluated, EvaluateSettings(), False, steps).frames


def test_both_numbers_stand_in_the_report_without_being_asked_for(clip):
    displace(clip)
    curve = Curve([(4000, "l1", 0.1)])
    curve.write(clip.inputs["train"] / "curve.parquet")
    output = clip.evaluate()
    means = held_out(output)
    assert means["avatar_refined"]["psnr"] > means["avatar"]["psnr"] + 2
    assert summary_of(output)["refined"]["frames"] == len(TEST)


def test_without_held_out_frames_nothing_is_refined(tmp_path):
    output = make_clip(tmp_path, test=(), soft=True).evaluate(
        follow=must_not_be_asked, refine_test_poses="on"
    )
    assert summary_of(output)["refined"]["frames"] == 0


# Where it breaks


def test_a_frame_that_is_not_finite_keeps_its_fitted_pose_and_says_so(clip, capsys):
    poses = moving_poses()

    def follow(pose, time):
        gaussians = stand_in(pose, time)
        if time != TEST[1] / 25:
            return gaussians
        change = pose.transl - pose.transl.detach()
        rooted = change.square().sum().sqrt()  # 0, and its slope is not a number
        return dataclasses.replace(gaussians, means=gaussians.means + rooted)

    output = clip.evaluate(follow=follow, refine_test_poses="on", refine_steps=3)
    assert summary_of(output)["refined"]["stopped"] == [TEST[1]]
    kept = read_poses(output / "test_poses.parquet")
    assert kept.valid.tolist() == [True, False, True]
    assert torch.equal(kept.transl[1], poses.transl[-2])
    assert f"of {TEST[1]} " in capsys.readouterr().out
    assert set(held_out(output)["avatar_refined"]) == set(held_out(output)["avatar"])


def fitted_pose():
    return Pose(torch.zeros(55, 3), torch.zeros(4), torch.zeros(3))


def test_a_loss_or_gradient_that_is_not_finite_stops():
    calls = []

    def breaks(pose):
        calls.append(1)
        return pose.transl.sum() * (math.nan if len(calls) == 3 else 1)

    assert refined_pose(breaks, fitted_pose(), 10) is None and len(calls) == 3
    # The square root's slope at zero is infinite, its value is not.
    assert refined_pose(lambda pose: pose.transl.abs().sum().sqrt(), fitted_pose(), 10) is None


def test_the_best_pose_met_is_kept():
    start = fitted_pose()
    # Adam's first step of 1e-3 leaps over this minimum.
    found = refined_pose(lambda pose: (pose.transl - 1e-5).abs().sum(), start, 3)
    assert torch.equal(found.transl, start.transl)
    nearer = refined_pose(lambda pose: (pose.transl - 0.02).square().sum(), start, 60)
    assert torch.allclose(nearer.transl, torch.full((3,), 0.02), atol=2e-3)
    assert torch.equal(nearer.rotation, start.rotation)  # what the loss does not look at stays


@pytest.mark.parametrize("mask", [0, 255], ids=["nobody", "everything"])
def test_a_useless_mask_leaves_finite_poses(clip, mask):
    write_mask(clip.inputs["ingest"] / "masks", TEST[0], np.full((HEIGHT, WIDTH), mask, np.uint8))
    poses = refine(clip.clip(), stand_in, "black", 4, lambda: None).poses
    for pose in poses.values():
        assert all(bool(part.isfinite().all()) for part in (pose.rotation, pose.expression, pose.transl))


# A body


@pytest.fixture(scope="module")
def painted(tmp_path_factory):
    """The painted body, one frame held out, and the poses it was filmed in."""
    return read_evaluated_clip(write_trained(tmp_path_factory.mktemp("body")), open_body())


def score(clip, animate, pose):
    frame = clip.split.test[0]
    shown = AvatarMethod(AVATAR, clip, animate, [frame], {frame: pose}).render(frame)
    return psnr(shown("black"), clip.person(frame))


@torch.no_grad()
def off_by(clip, animate, pose):
    """How far the Gaussians inside the picture are from where they were filmed, a mean in pixels."""
    camera = clip.camera(clip.split.test[0])
    true = project(camera, animate(clip.pose(clip.split.test[0]), None).means)
    seen = ((true > 0) & (true < torch.tensor([camera.width, camera.height]))).all(1)
    return float((project(camera, animate(pose, None).means) - true)[seen].norm(dim=1).mean())


def test_a_displaced_body_comes_back_and_the_networks_stay(painted):
    poses = body_poses()
    poses.rotation[-1, 15] += torch.tensor([0.05, 0.08, 0.0])
    poses.transl[-1] += torch.tensor([0.012, -0.01, 0.0])
    displaced = dataclasses.replace(painted, poses=poses)
    avatar = painted_avatar()
    networks = {name: value.numpy().tobytes() for name, value in avatar.state_dict().items()}
    animate, frame = pose_gradient_animation(avatar), painted.split.test[0]
    before, after = displaced.pose(frame), refine(displaced, animate, "black", 24, lambda: None).poses[frame]
    assert score(painted, animate, after) > score(painted, animate, before) + 3
    far = off_by(painted, animate, before)  # pixels
    assert far > 2 and off_by(painted, animate, after) < far / 4
    assert {name: value.numpy().tobytes() for name, value in avatar.state_dict().items()} == networks
    assert all(weight.grad is None for weight in avatar.parameters())


def test_a_further_loss_of_the_pictures_takes_part(painted):
    animate, frame = pose_gradient_animation(painted_avatar()), painted.split.test[0]
    losses = [
        frame_loss(painted, animate, "black", frame, perceptual)(painted.pose(frame))
        for perceptual in (None, lambda image, truth: 0.2 * (image - 1).abs().mean())
    ]
    assert float(losses[1].detach()) > float(losses[0].detach()) + 0.1


def test_a_perfect_pose_is_left_alone(painted):
    animate, frame = pose_gradient_animation(painted_avatar()), painted.split.test[0]
    found = refine(painted, animate, "black", 6, lambda: None).poses[frame]
    assert score(painted, animate, found) > score(painted, animate, painted.pose(frame)) - 0.1
    assert float((found.transl - painted.pose(frame).transl).abs().max()) < 0.003  # metres


def test_the_protocol_names_what_was_done():
    for name, choices in PROTOCOLS.items():
        sentences = protocol_sentences(choices, NOT_REFINED, name)
        assert "refined" not in sentences and f" {name}." in sentences
        other = dataclasses.replace(choices, background="white" if choices.background == "black" else "black")
        assert f" {name}." not in protocol_sentences(other, NOT_REFINED, name)
