"""The sentences at the report's top, from numbers that were made up to make each of them true."""

import math

import pytest
import torch

from pipeline.body.joints import JOINT_NAMES
from pipeline.orbit_cameras import relaxed_pose
from pipeline.run.versions import PACKAGES, commit, package_version, versions
from stages.evaluate.report.videos import motion_pictures, motion_poses
from stages.evaluate.verdict import ClipCoverage, limits, quality, turned, verdict
from tests.stages.evaluate_subject import stand_in

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
    return {"means": means, "differences": gains, "confidence": 0.95, "frames": {"test": 7}}


@pytest.mark.parametrize(
    ("gain", "said"),
    [
        (
            (2.3, 1.5, 3.1),
            "2.3 dB better than copying the nearest training frame (95% interval +1.5 to +3.1)",
        ),
        ((-1.2, -2.0, -0.3), "1.2 dB worse than copying the nearest training frame"),
        (
            (0.2, -0.5, 0.9),
            "Level with copying the nearest training frame (+0.2 dB, 95% interval -0.5 to +0.9)",
        ),
        (
            (1.6, -3, 6),
            "+1.6 dB against copying the nearest training frame, which 7 held-out frames do not settle (",
        ),
    ],
)
def test_how_good_is_told_by_the_interval_and_not_by_the_mean(gain, said):
    assert quality(summary(over={"nearest_frame": gain})).startswith(said)


def test_it_is_compared_with_the_baseline_that_comes_nearest():
    both = summary(over={"nearest_frame": (6.0, 5.0, 7.0), "textured_mesh": (2.0, 1.0, 3.0)})
    assert quality(both).startswith("2.0 dB better than the textured mesh")
    both["means"]["test"]["avatar"]["lpips_alex"] = 0.037
    both["means"]["test"]["textured_mesh"]["lpips_alex"] = 0.017
    assert quality(both).endswith(
        "30.0 dB on frames it never saw, but less sharp (LPIPS x100 3.7 against 1.7)."
    )
    both["means"]["test"]["textured_mesh"]["lpips_alex"] = 0.05
    assert "less sharp" not in quality(both)


def test_without_held_out_frames_nothing_is_claimed():
    nothing = {"means": {"train": {"avatar": {"psnr": 33.0}}}, "differences": {}, "confidence": 0.95}
    assert quality(nothing).startswith("No frame was held out") and "33.0 dB" in quality(nothing)
    assert limits(nothing, WHOLE) == ""
    assert quality(summary()) == "30.0 dB on frames it never saw."


def test_what_costs_most_is_named_first_and_small_change_is_not():
    found = limits(summary(30.0, train=34.6, avatar_refined=32.0, second_mask=38.0), WHOLE)
    assert found.startswith(
        "What limits it most: new frames (4.6 dB below those it learnt from); then poses ("
    )
    assert "refining them gains 2.0 dB" in found and "masks" not in found
    assert limits(summary(30.0, train=30.7), WHOLE) == "No single limit stands out."
    allowed = limits(summary(30.0, train=30.7, second_mask=36.9), WHOLE)
    assert allowed == "No single limit stands out; masks would allow 36.9 dB."


def test_masks_limit_what_scores_as_the_truth_does():
    for avatar in (33.5, 36.0):  # at the ceiling, and above it: the avatar has learnt the mask
        found = limits(summary(avatar, second_mask=34.1, train=35.0), WHOLE)
        assert "most: masks (the truth itself scores 34.1 dB under a second mask)" in found
    assert "masks" not in limits(summary(30.0, second_mask=34.1, train=35.0), WHOLE)


def test_hands_are_named_where_they_are_much_worse_than_the_rest():
    means = summary(30.0)
    means["means"]["test"]["avatar"] |= {"psnr_person": 25.0, "psnr_hands": 17.0, "psnr_face": 23.0}
    assert limits(means, WHOLE) == "What limits it most: the hands (17.0 dB against 25.0 of the person)."


def test_what_one_sees_who_turns_it():
    assert turned(WHOLE) == "" and turned(ClipCoverage(0.0, (30.0,), None)) == ""
    back = turned(ClipCoverage(0.65, (90.0, 120.0, 150.0, 180.0, 210.0), None))
    assert back.startswith("Turned: 5 of 12 directions were never filmed, the back among them")
    assert "65% of the body" in back
    assert turned(ClipCoverage(0.2, (), None)).startswith("20% of the body")


def test_the_fits_error_is_said_and_empty_sentences_are_left_out():
    assert verdict(summary(), ClipCoverage(0.0, (), 3.61)) == [
        "30.0 dB on frames it never saw.",
        "The fit is off by 3.6 px.",
    ]


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
