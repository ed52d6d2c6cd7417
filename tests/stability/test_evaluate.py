"""Plan and evaluation of clips that have hardly anything to measure."""

import dataclasses
import json
import math

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import empty_keypoints, read_keypoints, write_keypoints
from pipeline.clip.plan import EFFECTS, read_plan
from pipeline.clip.records import Split, write_split
from pipeline.errors import UserError
from pipeline.files.tables import write_table
from pipeline.orbit_cameras import orbit, visible_extent
from pipeline.splat import Gaussians, render
from stages.plan import measure
from stages.plan.run import run as run_plan
from tests.made.blob import FRAMES, HEIGHT, TEST, WIDTH, make_clip, stand_in
from tests.made.portrait import FRAMES as PLANNED
from tests.stages.test_plan import context_of, write_planned


def summary_of(output):
    return json.loads((output / "summary.json").read_text())


def assert_published(output):
    """Everything is there, and every number in it is one."""
    names = {path.name for path in output.iterdir()}
    assert {"metrics.parquet", "summary.json", "report.html", "avatar.ply", "turntable.mp4"} <= names

    def walk(value):
        if isinstance(value, dict | list):
            for part in value.values() if isinstance(value, dict) else value:
                walk(part)
        assert not isinstance(value, float) or math.isfinite(value)

    walk(summary_of(output))


def invisible(pose, time):
    seen = stand_in(pose, time)
    return dataclasses.replace(seen, opacities=torch.zeros(40))


def nobody(pose, time):
    return stand_in(pose, time).select(torch.zeros(0, dtype=torch.long))


def broken(pose, time):
    seen = stand_in(pose, time)
    return dataclasses.replace(seen, means=seen.means * math.nan)


def enormous(pose, time):
    seen = stand_in(pose, time)
    return dataclasses.replace(seen, scales=seen.scales * 1e12, means=seen.means * 1e9)


SOAKED = pytest.mark.soak


@pytest.mark.parametrize(
    "animate", [broken, *(pytest.param(one, marks=SOAKED) for one in (nobody, invisible, enormous))]
)
def test_avatars_that_cannot_be_seen_are_scored_all_the_same(tmp_path, animate):
    output = make_clip(tmp_path).evaluate(animate)
    assert_published(output)
    assert summary_of(output)["means"]["test"]["avatar"]["psnr"] < 25


@SOAKED
def test_nothing_held_out(tmp_path):
    output = make_clip(tmp_path, test=()).evaluate()
    assert_published(output)
    assert "train" in summary_of(output)["means"] and "test" not in summary_of(output)["means"]


@SOAKED
def test_one_training_frame(tmp_path):
    clip = make_clip(tmp_path)
    write_split(clip.inputs["ingest"] / "split.json", Split(FRAMES[:1], FRAMES[1:2]))
    output = clip.evaluate()
    assert_published(output)
    assert summary_of(output)["nearest"] == {str(FRAMES[1]): FRAMES[0]}


def test_a_clip_of_one_frame_in_all(tmp_path):
    clip = make_clip(tmp_path)
    write_split(clip.inputs["ingest"] / "split.json", Split(FRAMES[:1], ()))
    assert_published(clip.evaluate())


@pytest.mark.parametrize("value", [0, pytest.param(255, marks=SOAKED)], ids=["empty", "full"])
def test_masks_empty_or_full_everywhere(tmp_path, value):
    clip = make_clip(tmp_path)
    for frame in FRAMES:
        write_mask(clip.inputs["ingest"] / "masks", frame, np.full((HEIGHT, WIDTH), value, np.uint8))
    output = clip.evaluate()
    assert_published(output)
    inside = summary_of(output)["means"]["test"]["avatar"]["psnr_interior"]
    assert (inside is None) == (value == 0)


def test_one_held_out_mask_is_empty(tmp_path):
    clip = make_clip(tmp_path)
    write_mask(clip.inputs["ingest"] / "masks", TEST[0], np.zeros((HEIGHT, WIDTH), np.uint8))
    output = clip.evaluate()
    assert_published(output)
    assert summary_of(output)["means"]["test"]["avatar"]["psnr_interior"] > 50
    rows = pq.read_table(output / "metrics.parquet").to_pylist()
    inside = {row["frame"] for row in rows if row["metric"] == "psnr_interior" and row["split"] == "test"}
    assert inside == set(TEST[1:])


@SOAKED
@pytest.mark.parametrize("value", [0, 255], ids=["black", "white"])
def test_flat_frames(tmp_path, value):
    clip = make_clip(tmp_path)
    for frame in FRAMES:
        write_frame(clip.inputs["ingest"] / "frames", frame, np.full((HEIGHT, WIDTH, 3), value, np.uint8))
    assert_published(clip.evaluate())


def test_refining_poses_on_an_empty_mask_keeps_what_is_finite(tmp_path):
    clip = make_clip(tmp_path, soft=True)
    write_mask(clip.inputs["ingest"] / "masks", TEST[0], np.zeros((HEIGHT, WIDTH), np.uint8))
    output = clip.evaluate(refine_test_poses="on", refine_steps=3)
    assert_published(output)


def cloud(scale, offset, count=5):
    means = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)) * scale + offset
    turned = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    return Gaussians(
        means, turned, torch.full((count, 3), abs(scale)), torch.rand(count, 3), torch.ones(count)
    )


@pytest.mark.parametrize(("scale", "offset"), [(0.0, 0.0), (1e-9, 0.0), (1e4, 0.0), (1.0, 1e6), (1e15, 0.0)])
def test_a_turntable_of_any_size_has_finite_cameras(scale, offset):
    gaussians = cloud(scale, offset)
    for camera in orbit(visible_extent(gaussians), 32, 48, 4):
        assert camera.translation.isfinite().all() and camera.intrinsics.isfinite().all()
        assert render(gaussians, camera).color.isfinite().all()


# The plan


@pytest.fixture
def planned(tmp_path):
    write_planned(tmp_path)
    return tmp_path


def plan_of(clip):
    context = context_of(clip)
    run_plan(context)
    plan = read_plan(context.output / "plan.json")
    assert {one.effect for one in plan.decisions} == set(EFFECTS)
    assert all(math.isfinite(one.measured) and one.why for one in plan.decisions)
    return plan


def test_a_plan_of_one_frame(planned):
    write_split(planned / "ingest" / "split.json", Split((2,), ()))
    plan = plan_of(planned)
    assert plan["pose_heads"].measured == 0 and not plan.on("pose_heads")


def test_a_plan_without_any_keypoint_or_residual(planned):
    write_keypoints(planned / "ingest" / "keypoints.parquet", empty_keypoints(np.arange(PLANNED)))
    nothing = {"frame": np.zeros(0, np.int32), "pixels": np.zeros(0, np.float32)}
    write_table(planned / "fit" / "residuals.parquet", measure.RESIDUALS, nothing)
    plan = plan_of(planned)
    for name in ("face_residual", "left_hand_residual", "pose_heads", "test_time_refinement"):
        assert not plan.on(name), name


@pytest.mark.parametrize("place", ["one point", "one line", "far outside"])
def test_a_plan_of_keypoints_without_extent(planned, place):
    keypoints = read_keypoints(planned / "ingest" / "keypoints.parquet")
    keypoints.whole_body[..., 2] = 0.9
    keypoints.whole_body[..., :2] = 1e6 if place == "far outside" else 20.0
    if place == "one line":
        keypoints.whole_body[..., 0] = np.arange(133)
    write_keypoints(planned / "ingest" / "keypoints.parquet", keypoints)
    plan_of(planned)


def test_a_plan_of_nobody_is_refused(planned):
    for frame in range(PLANNED):
        write_mask(planned / "ingest" / "masks", frame, np.zeros((64, 48), np.uint8))
    with pytest.raises(UserError, match="nobody"):
        plan_of(planned)


def test_a_plan_of_pictures_smaller_than_the_window_is_refused(planned):
    for frame in range(PLANNED):
        write_mask(planned / "ingest" / "masks", frame, np.full((2, 2), 255, np.uint8))
    with pytest.raises(UserError, match="at least 11 pixels"):
        plan_of(planned)
