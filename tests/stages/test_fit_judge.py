"""A fit judges itself: by keypoints, by what it covers of the mask, and by what lies outside."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.body import Identity, mean_identity, posed_vertices
from pipeline.body.rasterize import rasterize
from pipeline.clip.fit_quality import read_fit_quality
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import write_keypoints
from pipeline.clip.records import SHOT_STEP, Footage, write_cameras, write_footage
from pipeline.errors import UserError
from stages.fit import judge
from stages.fit.run import run
from stages.fit.settings import FitSettings
from tests.made.context import stage_context
from tests.made.detections import SIZE, make_clip, whole_body
from tests.made.fit_quality import good_fit


@pytest.fixture(scope="module")
def clip(model):
    return whole_body(make_clip(*model, count=2), *model)


@pytest.fixture(scope="module")
def silhouettes(model, clip):
    """The person's masks, [H, W] uint8 of every frame."""
    body, masks = model[0], {}
    for frame in clip.poses.frames:
        vertices = posed_vertices(body, mean_identity(body), clip.poses.pose(frame))
        masks[frame] = 255 * rasterize(clip.cameras[frame], vertices, body.faces).covered.astype(np.uint8)
    return masks


def measured(model, folder, clip, masks, poses=None, identity: Identity | None = None, keypoints=None):
    folder.mkdir(exist_ok=True)
    for frame, mask in masks.items():
        write_mask(folder, frame, mask)
    poses, identity = poses or clip.poses, identity or mean_identity(model[0])
    keypoints = keypoints or clip.keypoints
    error = torch.full((len(poses), 3), 0.5)
    return judge.measure_fit(model[0], identity, poses, keypoints, clip.cameras, error, folder, 0.4)


def test_the_true_body_passes(tmp_path, model, clip, silhouettes):
    quality = measured(model, tmp_path, clip, silhouettes)
    assert (quality.covered > 0.97).all() and (quality.outside < 0.03).all()
    assert quality.accepted.all() and judge.decide(quality, "clip.mp4", 0.0, False) == (quality, "")
    np.testing.assert_allclose(quality.size, [np.sqrt((mask > 0).sum()) for mask in silhouettes.values()])
    np.testing.assert_allclose(quality.reprojection, 0.5 / quality.size)


def test_a_body_beside_the_person_and_a_small_one_on_it_fail(tmp_path, model, clip, silhouettes):
    aside = dataclasses.replace(clip.poses, transl=clip.poses.transl + torch.tensor([0.8, 0.0, 0.0]))
    quality = measured(model, tmp_path / "a", clip, silhouettes, aside)
    assert not quality.passed.any() and (quality.outside > 0.8).all()
    far = dataclasses.replace(clip.poses, transl=clip.poses.transl * torch.tensor([1.8, 1.8, 1.8]))
    small = measured(model, tmp_path / "b", clip, silhouettes, far)
    assert not small.passed.any() and (small.covered < 0.5).all() and (small.outside < 0.5).all()


def test_legs_behind_a_desk_count_for_nothing(tmp_path, model, clip, silhouettes):
    desk = {frame: mask.copy() for frame, mask in silhouettes.items()}
    for mask in desk.values():
        rows = np.flatnonzero(mask.any(1))
        mask[rows[0] + int(0.4 * len(rows)) :] = 0
    points = clip.keypoints.whole_body.copy()
    points[:, [13, 14, 15, 16], 2] = 0.0
    unseen = dataclasses.replace(clip.keypoints, whole_body=points)
    hidden = measured(model, tmp_path / "a", clip, desk, keypoints=unseen)
    walking = measured(model, tmp_path / "b", clip, desk)
    assert (walking.outside > hidden.outside + 0.15).all()
    assert hidden.passed.all()


def test_a_clip_upside_down_is_refused_with_what_to_do(tmp_path, model, clip, silhouettes):
    turned = {frame: np.ascontiguousarray(mask[::-1, ::-1]) for frame, mask in silhouettes.items()}
    points = clip.keypoints.whole_body.copy()
    points[..., :2] = SIZE - points[..., :2]
    keypoints = dataclasses.replace(clip.keypoints, whole_body=points)
    quality = measured(model, tmp_path, clip, turned, keypoints=keypoints)
    angle = judge.turned_faces(keypoints, 0.4)
    assert abs(angle) > 150 and abs(judge.turned_faces(clip.keypoints, 0.4)) < 30
    with pytest.raises(UserError, match=r"clip\.mp4.*2 of 2 frames.*turn the clip upright.*fit\.accept=any"):
        judge.decide(quality, "clip.mp4", angle, False)
    accepted, note = judge.decide(quality, "clip.mp4", angle, True)
    assert accepted.accepted.all() and not accepted.passed.any() and "fit.accept=any" in note


def test_single_frames_are_left_out_and_a_rig_lives_by_its_best_camera():
    good = good_fit([0, 1, 2, 3, SHOT_STEP, SHOT_STEP + 1, 2 * SHOT_STEP, 2 * SHOT_STEP + 1])
    covered = good.covered.copy()
    covered[[1, 4, 5, 6, 7]] = 0.2
    spoilt = dataclasses.replace(good, covered=covered)
    spoilt = dataclasses.replace(spoilt, accepted=spoilt.passed)
    quality, note = judge.decide(spoilt, "rig", 0.0, False)
    assert quality.accepted.tolist() == [True, False, True, True, False, False, False, False]
    assert note.startswith("5 of 8 frames") and str(SHOT_STEP) in note
    with pytest.raises(UserError, match=r"rig.*ingest\.person"):
        judge.decide(spoilt.of(spoilt.frames[4:]), "rig", 0.0, False)


@pytest.mark.parametrize("accept", ["good", "any"])
def test_the_stage_refuses_a_body_that_is_elsewhere_unless_told_otherwise(tmp_path, model, clip, accept):
    folder = tmp_path / "ingest"
    frames = clip.poses.frames
    corner = np.zeros((SIZE, SIZE), np.uint8)
    corner[:40, :40] = 255
    write_keypoints(make(folder) / "keypoints.parquet", clip.keypoints)
    write_cameras(folder / "cameras.parquet", clip.cameras)
    footage = Footage("elsewhere.mp4", SIZE, SIZE, 25.0, 1.0, 2, 2, {}, 1, (0.0, 0.04), {})
    write_footage(folder / "footage.json", footage)
    for frame in frames:
        write_frame(folder / "frames", frame, np.full((SIZE, SIZE, 3), 40, np.uint8))
        write_mask(folder / "masks", frame, corner)
    settings = FitSettings(iterations=5, accept=accept)
    context = stage_context("fit", settings, tmp_path / "out", {"ingest": folder})
    if accept == "good":
        with pytest.raises(UserError, match=r"elsewhere\.mp4"):
            run(context)
        assert not (context.output / "poses.parquet").exists()
    else:
        run(context)
        quality = read_fit_quality(context.output)
        assert quality.accepted.all() and not quality.passed.any()
        assert any("fit.accept=any" in line for line in context.logged)


def make(folder):
    for name in ("frames", "masks"):
        (folder / name).mkdir(parents=True)
    return folder
