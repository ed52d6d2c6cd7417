"""The sentences at the report's top, from numbers that were made up to make each of them true."""

import math
import re

import pytest
import torch

from pipeline.body.joints import JOINT_NAMES
from pipeline.motion.novel_motion import motion_poses
from pipeline.orbit_cameras import relaxed_pose
from pipeline.run.versions import PACKAGES, commit, package_version, versions
from stages.evaluate.report.videos import motion_pictures
from stages.evaluate.verdict import ClipCoverage, limits, quality, turned, verdict
from tests.made.blob import stand_in

WHOLE = ClipCoverage(unmodelled=0.0, azimuths=(), fit_pixels=None)


def summary(avatar=30.0, over=None, train=None, **methods):
    """A summary of one subject: held-out PSNR by method, and what the avatar has over the baselines."""
    means = {
        "test": {"avatar": {"psnr": avatar}, **{name: {"psnr": value} for name, value in methods.items()}}
    }
    if train is not None:
        means["train"] = {"avatar": {"psnr": train}}
    keys = ("mean", "low", "high")
    gains = {name: {"psnr": dict(zip(keys, each, strict=True))} for name, each in (over or {}).items()}
    for name in gains:
        means["test"].setdefault(name, {"psnr": avatar - gains[name]["psnr"]["mean"]})
    if "avatar_refined" in methods:
        gains["avatar_refined"] = {"psnr": {"mean": avatar - methods["avatar_refined"]}}
    return {"means": means, "differences": gains, "confidence": 0.95, "frames": {"test": 7}}


def figures(sentence):
    """The numbers of a sentence, in their order."""
    return [float(one) for one in re.findall(r"[+-]?\d+(?:\.\d+)?", sentence)]


GAINS = {
    "better": (2.3, 1.5, 3.1), "worse": (-1.2, -2.0, -0.3), "level": (0.2, -0.5, 0.9), "open": (1.6, -3, 6),
}  # fmt: skip


@pytest.mark.parametrize("gain", GAINS.values(), ids=GAINS)
def test_how_good_is_told_with_its_interval_and_its_baseline(gain):
    said = quality(summary(over={"nearest_frame": gain}))
    assert "nearest training frame" in said
    assert {abs(gain[0]), *gain[1:]} <= set(figures(said))


def test_four_kinds_of_interval_are_told_apart_whatever_the_mean():
    def kind(gain):
        return re.sub(r"[+-]?\d+(\.\d+)?", "", quality(summary(over={"nearest_frame": gain})))

    kinds = {name: kind(gain) for name, gain in GAINS.items()}
    assert len(set(kinds.values())) == 4
    # The same mean: the interval alone decides.
    assert kind((2.3, -0.5, 5.1)) != kinds["better"] == kind((0.6, 0.2, 1.0))


def test_it_is_compared_with_the_baseline_that_comes_nearest():
    both = summary(over={"nearest_frame": (6.0, 5.0, 7.0), "textured_mesh": (2.0, 1.0, 3.0)})
    plain = quality(both)
    assert figures(plain)[0] == 2.0 and "textured mesh" in plain and "LPIPS" not in plain
    both["means"]["test"]["avatar"]["lpips_alex"] = 0.037
    both["means"]["test"]["textured_mesh"]["lpips_alex"] = 0.017
    assert "LPIPS" in quality(both) and figures(quality(both))[-2:] == [3.7, 1.7]
    both["means"]["test"]["textured_mesh"]["lpips_alex"] = 0.05
    assert quality(both) == plain


def test_without_held_out_frames_nothing_is_claimed():
    nothing = {"means": {"train": {"avatar": {"psnr": 33.0}}}, "differences": {}, "confidence": 0.95}
    assert figures(quality(nothing)) == [33.0] and limits(nothing, WHOLE) == ""
    assert figures(quality(summary())) == [30.0] and quality(summary()) != quality(nothing)


def test_what_costs_most_is_named_first_and_small_change_is_not():
    found = limits(summary(30.0, train=34.6, avatar_refined=32.0, second_mask=38.0), WHOLE)
    assert 0 < found.index("new frames") < found.index("poses") and "masks" not in found
    assert figures(found)[0] == 4.6 and 2.0 in figures(found)
    none = limits(summary(30.0, train=30.7), WHOLE)
    assert figures(none) == [] and none
    allowed = limits(summary(30.0, train=30.7, second_mask=36.9), WHOLE)
    assert "masks" in allowed and figures(allowed) == [36.9] and allowed.startswith(none.rstrip("."))


def test_masks_limit_what_scores_as_the_truth_does():
    for avatar in (33.5, 36.0):  # at the ceiling, and above it: the avatar has learnt the mask
        found = limits(summary(avatar, second_mask=34.1, train=35.0), WHOLE)
        assert "masks" in found and 34.1 in figures(found)
    assert "masks" not in limits(summary(30.0, second_mask=34.1, train=35.0), WHOLE)


def test_hands_are_named_where_they_are_much_worse_than_the_rest():
    means = summary(30.0)
    means["means"]["test"]["avatar"] |= {"psnr_person": 25.0, "psnr_hands": 17.0, "psnr_face": 23.0}
    found = limits(means, WHOLE)
    assert "hands" in found and "face" not in found and figures(found) == [17.0, 25.0]


def test_what_one_sees_who_turns_it():
    assert turned(WHOLE) == "" and turned(ClipCoverage(0.0, (30.0,), None)) == ""
    back = turned(ClipCoverage(0.65, (90.0, 120.0, 150.0, 180.0, 210.0), None))
    assert figures(back) == [5, 12, 65] and "back" in back
    aside = turned(ClipCoverage(0.65, (30.0, 60.0, 90.0), None))
    assert figures(aside) == [65] and "back" not in aside
    assert figures(turned(ClipCoverage(0.2, (), None))) == [20]


def test_the_fits_error_is_said_and_empty_sentences_are_left_out():
    found = verdict(summary(), ClipCoverage(0.0, (), 3.61))
    assert found[0] == quality(summary()) and len(found) == 2 and figures(found[1]) == [3.6]


# The motion that was never filmed


def test_the_motion_lifts_the_arms_turns_the_head_and_comes_back():
    poses = list(motion_poses(8, 1.0))
    left, right, head = (JOINT_NAMES.index(name) for name in ("left_shoulder", "right_shoulder", "head"))
    assert torch.equal(poses[0], relaxed_pose(1.0))
    assert poses[4][left, 2] == -poses[4][right, 2] == pytest.approx(0.9)  # above the T pose
    assert poses[2][head, 1] == -poses[6][head, 1] == pytest.approx(0.3)
    assert all(bool(pose.isfinite().all()) for pose in poses)


def test_the_motion_stays_in_the_picture():
    pictures = list(motion_pictures(stand_in, 4, 4, 1.0, (48, 64)))
    assert len(pictures) == 4 and pictures[0].shape == (64, 48, 3)
    ground = int(pictures[0][0, 0, 0])
    for picture in pictures:
        rim = [picture[0], picture[-1], picture[:, 0], picture[:, -1]]
        # What reaches the rim is no more than the far tail of a Gaussian.
        assert max(int(abs(side.astype(int) - ground).max()) for side in rim) < 40
        assert abs(picture.astype(int) - ground).max() > 100


# Versions


def test_versions_name_what_is_installed_and_leave_out_what_is_not():
    found = versions()
    assert found["flexiavatar"] == "0.1.0" and found["torch"] == torch.__version__
    assert set(found) <= {"flexiavatar", "commit", "python", *PACKAGES} and all(found.values())
    assert package_version("no-such-package-anywhere") == ""
    assert commit() == "" or math.isclose(len(commit().rstrip("+")), 12)
