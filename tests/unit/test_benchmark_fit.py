"""The fit benchmark's error measures against hand-made truth, and its tables on figures that mean nothing."""

import dataclasses
import json
import math

import pytest
import roma
import torch

from benchmarks import fit
from benchmarks.fit_truth import ANCHORS, Errors, from_anchor, make_clips, mean_of_seen, measure, procrustes
from pipeline.body import joint_index
from stages.ingest.mannequin import DETECTORS, FRAMINGS, MannequinSpec

FRAMES, POINTS = 4, 9


@pytest.fixture
def target():
    return torch.randn(FRAMES, POINTS, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def stage():
    return fit.load_stage()


@pytest.fixture(scope="module")
def clip(stage):
    return make_clips(MannequinSpec(framing="upper", frames=2, size=64, identity=1), stage, DETECTORS[:1])[0]


def measured(clip, stage, **changes):
    """Errors of the truth with some of its poses' fields changed."""
    poses = dataclasses.replace(clip.truth.poses, **changes)
    return measure(clip.truth.identity, poses, clip, stage)


def test_every_framing_has_an_anchor_and_motions():
    assert set(ANCHORS) == set(FRAMINGS) == set(fit.MOTIONS)


def test_procrustes_takes_out_a_similarity(target):
    rotation = roma.rotvec_to_rotmat(torch.tensor([0.3, -1.0, 2.0]))
    points = 1.7 * target @ rotation.mT + torch.tensor([3.0, -1.0, 0.5])
    seen = torch.ones(FRAMES, POINTS, dtype=torch.bool)
    torch.testing.assert_close(procrustes(points, target, seen), target, atol=1e-4, rtol=0)
    assert from_anchor(points, target, 0).mean() > 0.5


def test_procrustes_does_not_mirror(target):
    mirrored = target * torch.tensor([-1.0, 1.0, 1.0])
    seen = torch.ones(FRAMES, POINTS, dtype=torch.bool)
    assert (procrustes(mirrored, target, seen) - target).norm(dim=-1).mean() > 0.2


def test_only_seen_points_decide_on_the_similarity(target):
    seen = torch.ones(FRAMES, POINTS, dtype=torch.bool)
    seen[:, 3] = False
    points = target.clone()
    points[:, 3] += 100
    aligned = procrustes(points, target, seen)
    torch.testing.assert_close(aligned[seen], target[seen], atol=1e-4, rtol=0)
    assert (aligned[:, 3] - target[:, 3]).norm(dim=-1).min() > 99


def test_frames_with_fewer_than_three_seen_points_do_not_count(target):
    seen = torch.ones(FRAMES, POINTS, dtype=torch.bool)
    seen[1, 2:] = False
    away = (procrustes(target + 1, target, seen) - target).norm(dim=-1)
    assert away[1].isnan().all()
    assert mean_of_seen(away, seen) == pytest.approx(0, abs=1e-5)


def test_the_anchor_takes_out_the_place_and_nothing_else(target):
    points = target + torch.tensor([1.0, 2.0, 3.0])
    points[:, 5, 0] += 0.25
    expected = torch.zeros(FRAMES, POINTS)
    expected[:, 5] = 0.25
    torch.testing.assert_close(from_anchor(points, target, 2), expected, atol=1e-5, rtol=0)


def test_the_mean_is_over_what_was_seen():
    distance = torch.tensor([[1.0, 50.0], [3.0, math.nan]])
    assert mean_of_seen(distance, torch.tensor([[True, False], [True, True]])) == 2.0
    assert math.isnan(mean_of_seen(distance, torch.zeros(2, 2, dtype=torch.bool)))


def test_the_truth_has_no_error(stage, clip):
    for name, error in dataclasses.asdict(measured(clip, stage)).items():
        assert error == pytest.approx(0, abs=1e-2), name


def test_a_body_in_another_place_errs_in_the_picture_alone(stage, clip):
    errors = measured(clip, stage, transl=clip.truth.poses.transl + torch.tensor([0.1, 0.0, 0.0]))
    assert errors.pixels > 1
    for name in ("joints", "pelvis", "procrustes", "body", "surface"):
        assert getattr(errors, name) == pytest.approx(0, abs=1e-2), name


def test_unseen_joints_and_vertices_do_not_count(stage, clip):
    """The knees are below the picture: bending them costs nothing but at a pelvis that stays."""
    rotation = clip.truth.poses.rotation.clone()
    rotation[:, joint_index("left_knee"), 0] += 1.0
    errors = measured(clip, stage, rotation=rotation)
    assert max(errors.joints, errors.surface, errors.pixels) < 1e-2
    rotation[:, joint_index("head"), 0] += 0.5
    errors = measured(clip, stage, rotation=rotation)
    assert errors.surface > 5 and errors.pixels > 1


def test_a_larger_body_farther_away_is_the_same_after_procrustes(clip):
    """One picture cannot tell them apart."""
    larger = 1.1 * clip.joints
    aligned = procrustes(larger, clip.joints, clip.joint_seen)
    assert mean_of_seen((aligned - clip.joints).norm(dim=-1), clip.joint_seen) < 1e-5
    assert mean_of_seen(from_anchor(larger, clip.joints, joint_index("neck")), clip.joint_seen) > 0.005


def test_what_is_seen_is_before_the_body_and_in_the_picture(clip):
    share = clip.vertex_seen.float().mean(1)
    assert ((share > 0.1) & (share < 0.6)).all()
    below = clip.vertices[..., 1] < clip.joints[:, joint_index("left_knee"), None, 1]
    assert not (clip.vertex_seen & below).any()


def test_posing_the_landmarks_costs_less_than_the_mesh(stage):
    landmarks, mesh = fit.posing_cost(stage, 2)  # raises where the two disagree
    assert 0 < landmarks and 0 < mesh


def test_tables_headline_and_files(monkeypatch, capsys, tmp_path, stage, clip):
    errors = Errors(*(float(number) for number in range(1, 7)))

    def pretend(clip, stage, variant, settings):
        worse = {"tau = 0": 2.0, "no mask": 3.0}.get(variant, 1.0)
        return fit.Run(
            clip.detector, clip.spec.framing, "", 1, variant, settings.iterations, 5.0,
            dataclasses.replace(errors, joints=worse),
        )  # fmt: skip

    def one_clip(framing, stage, detectors, quick, bvh):
        for name in detectors:
            yield dataclasses.replace(
                clip, detector=name, spec=dataclasses.replace(clip.spec, framing=framing)
            )

    monkeypatch.setattr(fit, "fit", pretend)
    monkeypatch.setattr(fit, "clips_of", one_clip)
    table, figure = tmp_path / "fit.json", tmp_path / "fit.png"
    fit.main(["--quick", "--json", str(table), "--figure", str(figure)])
    lines = capsys.readouterr().out.splitlines()
    assert sum("| no mask " in line for line in lines) == 3
    assert "upper 2.00 and 3.00" in lines[-1] and lines[-1].startswith("fit: ")
    record = json.loads(table.read_text())
    assert len(record["errors"]) == 3 * len(fit.VARIANTS)
    assert all(len(row["runs"]) == 1 for row in record["errors"])
    assert {row["iterations"] for row in record["effort"]} == set(fit.QUICK_EFFORTS)
    assert figure.read_bytes().startswith(b"\x89PNG")

    few = ["--quick", "--framings", "upper", "--variants", fit.MASKED, "tau = 0", "--no-effort"]
    fit.main([*few, "--json", str(table)])
    record = json.loads(table.read_text())
    assert [(row["framing"], row["variant"]) for row in record["errors"]] == [
        ("upper", fit.MASKED), ("upper", "tau = 0")
    ]  # fmt: skip
    assert "effort" not in record and "upper 2.00 and nan" in capsys.readouterr().out
