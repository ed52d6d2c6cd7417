import dataclasses
import io
import json
import re

import gsply
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from rich.console import Console

from pipeline.body import Pose, Poses, write_poses
from pipeline.clip.curves import read_curve
from pipeline.clip.frames import spread_end_to_end, write_png
from pipeline.clip.plan import read_plan
from pipeline.errors import UserError
from pipeline.metrics import PSNR_CAP
from pipeline.orbit_cameras import relaxed_pose
from stages.evaluate import STAGE
from stages.evaluate.exports import avatar_rig
from stages.evaluate.frame_metrics import Scorer
from stages.evaluate.report.plots import plot_training, plot_visibility
from stages.evaluate.report.terminal import show_summary
from stages.evaluate.run import evaluate, report_place
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.upstream import VISIBILITY as VISIBILITY_READ
from stages.evaluate.upstream import read_gate
from stages.train.visibility_gate import SCHEMA as VISIBILITY
from tests.glb_reader import Glb, read_splat_glb
from tests.made.blob import (
    FRAMES,
    TEST,
    make_clip,
    moving_poses,
    stand_in,
    wrong,
)
from tests.made.body import BODY_FILE, open_body
from tests.made.doll import awake_avatar
from tests.ply_reader import read_ply


@pytest.fixture
def clip(tmp_path):
    return make_clip(tmp_path)


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """One evaluation that many tests look at and none changes."""
    return make_clip(tmp_path_factory.mktemp("blob")).evaluate()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The report of a clip whose stages recorded all that they can, with the fit's overlay as a video."""
    clip = make_clip(tmp_path_factory.mktemp("recorded"))
    fit, train = clip.inputs["fit"], clip.inputs["train"]
    timed = {"seconds": 12.34, "timings": {"curve_seconds": [[0, 0.0], [50, 4.5]]}}
    (fit / "run.json").write_text(json.dumps(timed))
    (fit / "manifest.json").write_text('{"settings": {"iterations": 400, "odd": ["a", "b"]}}')
    (fit / "overlay.mp4").write_bytes(b"any bytes")
    (train / "run.json").write_text("{broken")
    write_png(train / "visibility.png", np.full((4, 8, 3), 90, np.uint8))
    return (clip.evaluate() / "report.html").read_text()


@pytest.fixture(scope="module")
def worse(tmp_path_factory):
    """The evaluation of an avatar in wrong colours, its name unfriendly and the fit's overlay a picture."""
    clip = make_clip(tmp_path_factory.mktemp("worse"))
    (clip.inputs["fit"] / "overlay.png").write_bytes(b"any bytes")
    context = dataclasses.replace(clip.context(), subject="<script>x</script>")
    evaluate(context, clip.clip(), wrong, wrong, Scorer({}))
    return context.output


# What is published


def test_everything_named_is_published(published):
    names = {path.name for path in published.iterdir()}
    pictures = {"comparison.png", "cover.png", "turntable.mp4", "motion.mp4"}
    splats = {"avatar.ply", "avatar.spz", "avatar_splats.glb"}
    assert names == {"metrics.parquet", "summary.json", "report.html", *splats, *pictures}


def test_the_avatar_that_made_the_clip_scores_as_its_eight_bits_allow(published):
    means = json.loads((published / "summary.json").read_text())["means"]
    # Rounding to 8 bits leaves an error of 1/255 / sqrt(12): 58.9 dB where every pixel is coloured.
    for split in ("test", "train"):
        assert 58 < means[split]["avatar"]["psnr"] < PSNR_CAP
        assert 58 < means[split]["avatar"]["psnr_interior"] < 61
        assert means[split]["avatar"]["ssim"] > 0.999


def test_the_baselines_stand_beside_it(published):
    summary = json.loads((published / "summary.json").read_text())
    held_out = summary["means"]["test"]
    assert held_out["mean_frame"]["psnr"] < held_out["nearest_frame"]["psnr"] < held_out["avatar"]["psnr"]
    # The blob moves one way, so the last training frame is nearest to all that follow.
    assert summary["nearest"] == {str(frame): FRAMES[-4] for frame in TEST}
    assert "mean_frame" not in summary["means"]["train"]


def test_every_frame_has_a_row(published):
    rows = pq.read_table(published / "metrics.parquet").to_pylist()
    assert set(rows[0]) == {"frame", "split", "method", "metric", "value", "view"}
    held_out = {(row["frame"], row["method"], row["metric"]) for row in rows if row["split"] == "test"}
    metrics = ("psnr", "psnr_interior", "psnr_person", "ssim", "psnr_face", "ssim_face")
    methods = ("avatar", "mean_frame", "nearest_frame")
    expected = {(frame, method, metric) for frame in TEST for method in methods for metric in metrics}
    expected |= {(frame, method, "flicker") for frame in TEST[1:] for method in methods}
    expected |= {(TEST[0], method, f"{metric}_hands") for method in methods for metric in ("psnr", "ssim")}
    cuts = [f"psnr_{background}_{mask}" for background in ("black", "white") for mask in ("own", "truth")]
    assert held_out == expected | {(frame, "avatar", cut) for frame in TEST for cut in cuts}
    trained = {row["frame"] for row in rows if row["split"] == "train"}
    assert trained == set(spread_end_to_end([frame for frame in FRAMES if frame not in TEST], 8))


def test_summary_holds_the_means_of_the_rows(published):
    summary = json.loads((published / "summary.json").read_text())
    rows = pq.read_table(published / "metrics.parquet").to_pylist()
    wanted = ("test", "nearest_frame", "psnr")
    values = [row["value"] for row in rows if (row["split"], row["method"], row["metric"]) == wanted]
    assert summary["means"]["test"]["nearest_frame"]["psnr"] == pytest.approx(np.mean(values), abs=1e-6)
    assert (summary["gaussians"], summary["frames"]) == (40, {"train": 9, "test": 3})


def test_the_ply_holds_the_turned_avatar(published):
    found = read_ply(published / "avatar.ply")
    expected = stand_in(Pose(relaxed_pose(1.0), torch.zeros(4), torch.zeros(3)), None)
    upright = torch.tensor([1.0, -1.0, -1.0])  # viewers show -Y upright
    assert torch.allclose(found.means, upright * expected.means, atol=1e-6)


def test_the_other_formats_hold_the_avatar_upright(published):
    expected = stand_in(Pose(relaxed_pose(1.0), torch.zeros(4), torch.zeros(3)), None)
    assert torch.allclose(read_splat_glb(published / "avatar_splats.glb").means, expected.means, atol=1e-6)
    packed = gsply.read_spz(published / "avatar.spz")
    assert np.abs(packed.means - expected.means.numpy()).max() < 5e-5


def test_the_rig_is_published_and_the_report_states_sizes(tmp_path):
    body, pose = open_body(), Pose(torch.zeros(55, 3), torch.zeros(38), torch.zeros(3))
    rig = avatar_rig(awake_avatar(), body, BODY_FILE, pose)
    output = make_clip(tmp_path).evaluate(rig=rig, glb_texture=32)
    assert len(Glb(output / "avatar.glb").asset.skins[0].joints) == 55
    files = json.loads((output / "summary.json").read_text())["files"]
    assert set(files) == {"avatar.glb", "avatar.ply", "avatar.spz", "avatar_splats.glb"}
    report = (output / "report.html").read_text()
    for name, size in files.items():
        assert size == (output / name).stat().st_size
        assert f"{name}</code> ({size / 1e6:.2f} MB)" in report


def test_the_same_inputs_give_the_same_bytes(published, clip):
    again = clip.evaluate()
    for path in published.iterdir():
        if path.name != "report.html":  # it shows how long the stages took
            assert path.read_bytes() == (again / path.name).read_bytes(), path.name


def test_a_wrong_avatar_scores_low_and_is_not_marked_best(worse):
    held_out = json.loads((worse / "summary.json").read_text())["means"]["test"]
    assert held_out["avatar"]["psnr"] < held_out["nearest_frame"]["psnr"]
    assert f"<b>{held_out['avatar']['psnr']:.2f}</b>" not in (worse / "report.html").read_text()


def test_held_out_frames_are_shown_in_the_fits_pose_and_training_frames_in_the_refined(clip):
    write_poses(clip.inputs["train"] / "poses.parquet", moving_poses(shift=5.0))
    evaluated = clip.clip()
    assert float(evaluated.pose(TEST[0]).transl[0]) < 1 < float(evaluated.pose(FRAMES[0]).transl[0])


def test_a_frame_without_pose_says_what_to_run(clip):
    poses = moving_poses()
    fewer = Poses(FRAMES[:-1], poses.rotation[:-1], poses.expression[:-1], poses.transl[:-1])
    for stage in ("fit", "train"):
        write_poses(clip.inputs[stage] / "poses.parquet", fewer)
    with pytest.raises(UserError, match=f"no pose for frame {FRAMES[-1]}.*fit"):
        clip.evaluate()


def test_a_clip_without_held_out_frames_is_reported_as_such(tmp_path):
    output = make_clip(tmp_path, test=()).evaluate()
    means = json.loads((output / "summary.json").read_text())["means"]
    assert set(means) == {"train"}
    assert f"{means['train']['avatar']['psnr']:.2f}" in (output / "report.html").read_text()


# The report


def test_the_report_needs_nothing_but_itself(published):
    report = (published / "report.html").read_text()
    sources = re.findall(r'\b(?:src|href|poster|srcset|action|data)="([^"]*)"', report)
    assert sources and all(source.startswith(("data:", "#")) for source in sources)
    assert not re.search(r"@import|<script src|<link|<iframe|url\(\s*['\"]?(?!#)", report)
    assert "default-src 'none'" in report


def test_the_report_shows_every_number_sentence_and_picture(published):
    report = (published / "report.html").read_text()
    summary = json.loads((published / "summary.json").read_text())
    for method in ("avatar", "nearest_frame", "mean_frame"):
        assert f"{summary['means']['test'][method]['psnr']:.2f}" in report
    assert report.count("<video") == 2 and "<svg" in report  # no overlay was published by this fit
    assert report.count('class="row slide"') == len(TEST)
    assert report.count('class="row slide" data-said') == len(TEST)
    assert all(sentence in report for sentence in summary["verdict"])
    # Counts of the footage that are not 0 are told, the names of settings, and how to get on.
    for text in ("no person was found", "10 of 50", "avatar.ply", "evaluate.error_gain"):
        assert text in report, text
    assert "unreadable" not in report


def test_times_and_settings_of_the_stages_are_shown_where_they_are_recorded(recorded):
    assert "12.3" in recorded and "fit.iterations" in recorded and "a, b" in recorded
    assert recorded.count("not recorded") == 3  # ingest, plan and train


def test_what_users_name_is_escaped(worse):
    report = (worse / "report.html").read_text()
    assert "<script>x" not in report and report.count("<script") == 1


@pytest.mark.parametrize("kind", ["<video", "<img"])
def test_the_fits_overlay_is_embedded(recorded, worse, kind):
    report = recorded if kind == "<video" else (worse / "report.html").read_text()
    assert re.search(rf'{kind} src="data:[a-z0-9/]+;base64,YW55IGJ5dGVz"', report)


def test_curve_and_visibility_are_read_as_train_writes_them(clip):
    lines = read_curve(clip.inputs["train"] / "curve.parquet", "run train again")
    assert lines["psnr"] == [(10, 30.0), (20, 40.0), (30, 50.0)]
    gate = read_gate(clip.inputs["train"])
    assert (gate.kept, gate.vertices, gate.tau) == (40, 50, 0.5) and gate.scores.sum() == 40
    assert all(VISIBILITY.field(one.name) == one for one in VISIBILITY_READ)
    with pytest.raises(UserError, match="train stage again"):
        read_curve(clip.inputs["train"] / "visibility.parquet", "run the train stage again")


def test_the_training_plots_show_the_metric_and_the_losses_and_are_drawn_the_same_each_time():
    lines = {
        "l1": [(1, 0.5)],
        "offset": [(1, 0.25), (2, 0.5)],
        "pose_offset": [(2, 0.25)],
        "psnr": [(2, 20.0)],
    }
    plots = plot_training(lines)
    assert len(plots) == 2 and plots == plot_training(lines)
    # Every loss term but L1 and SSIM is part of the regularisers: two lines, and 0.75 at iteration 2.
    summed = {"l1": [(1, 0.5)], "regulariser": [(1, 0.25), (2, 0.75)], "psnr": [(2, 20.0)]}
    assert plots == plot_training(summed) != plot_training({**lines, "offset": [(1, 0.25)]})
    assert plot_training({}) == plot_training({"gaussians": [(1, 40.0)]}) == []


# The terminal


def summary_text(summary, path, **console):
    text = io.StringIO()
    show_summary(summary, str(path), Console(file=text, **console))
    return text.getvalue()


def test_the_terminal_summary_ends_with_the_reports_path(published):
    summary = json.loads((published / "summary.json").read_text())
    path = published / ("deep/" * 40) / "report.html"
    plain = summary_text(summary, path)
    assert plain.splitlines()[-1] == f"report: {path}"
    assert "\x1b" not in plain and "nearest training frame" in plain and len(plain.splitlines()) < 16
    coloured = summary_text(summary, path, force_terminal=True, width=80)
    assert "\x1b[1m" in coloured and coloured.splitlines()[-1].endswith("report.html")


def test_the_path_is_where_the_store_will_publish(tmp_path):
    scratch = tmp_path / "evaluate" / ".scratch-abc" / "output"
    assert report_place(scratch) == tmp_path / "evaluate" / "latest" / "report.html"
    assert report_place(tmp_path) == tmp_path / "report.html"


# Settings and declaration


def test_the_stage_reads_what_it_declares():
    assert STAGE.settings is EvaluateSettings
    assert STAGE.demands(EvaluateSettings()).assets == ("lpips", "u2netp")
    lean = EvaluateSettings(second_mask="edge", identity=True)
    assert STAGE.demands(lean).assets == ("lpips", "dlib", "identity")
    assert set(STAGE.needs) == {"ingest", "fit", "plan", "train"}


def test_the_plan_and_the_scores_are_shown(recorded, published):
    plan = read_plan(published.parent / "plan" / "plan.json")
    for report in (recorded, (published / "report.html").read_text()):
        assert all(one.why in report for one in plan.decisions) and "0.50" in report
    pictures = [report.count("<img") for report in (recorded, (published / "report.html").read_text())]
    assert pictures[0] == pictures[1] + 1  # the body, coloured by its scores


def test_nothing_counted_draws_nothing():
    assert plot_visibility(np.zeros(50), 0.0) == []
    scores = np.linspace(0, 1, 50)
    assert plot_visibility(scores, 0.3) == plot_visibility(scores, 0.3)
