"""The fitted clip: what it reads of ingest's and fit's folders, and what it refuses."""

import dataclasses
import shutil

import numpy as np
import pytest
import torch

from pipeline.body import posed_vertices, read_poses, write_poses
from pipeline.clip.boxes import Box
from pipeline.clip.fitted_clip import read_fitted_clip
from pipeline.clip.frames import read_frame, read_mask, write_mask
from pipeline.clip.keypoints import empty_keypoints, write_keypoints
from pipeline.clip.records import Split, read_cameras, read_footage, write_cameras, write_footage, write_split
from pipeline.clip.views import ViewCache
from pipeline.errors import UserError
from tests.made.body import BODY_FILE, open_body
from tests.made.portrait import FRAMES, HEIGHT, WIDTH, moving_poses

BOX = Box(left=5, top=7, right=41, bottom=60)


@pytest.fixture
def changed(subject, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(subject, tmp_path / "subject")


def read(folder, body=None):
    body = body or open_body()
    return read_fitted_clip(folder / "ingest", folder / "fit", body)


def test_it_holds_what_ingest_and_fit_published(subject, body):
    clip = read(subject)
    assert clip.split == Split(tuple(range(FRAMES - 1)), (FRAMES - 1,))
    assert clip.footage.name == "made" and clip.body.digest == body.digest
    assert clip.seconds == pytest.approx({frame: 0.5 + frame / 10 for frame in range(FRAMES)})
    assert np.array_equal(clip.frame(2), read_frame(subject / "ingest" / "frames", 2))
    assert np.array_equal(clip.mask(2), read_mask(subject / "ingest" / "masks", 2))
    assert torch.equal(clip.pose(3).rotation, moving_poses().rotation[3])
    assert torch.equal(clip.vertices(3), posed_vertices(body, clip.identity, moving_poses().pose(3)))
    assert clip.spread(2) == (0, 2) and clip.spread(9, "test") == (FRAMES - 1,)


def test_a_view_is_the_frame_and_its_camera(subject):
    clip = read(subject)
    whole, part = clip.view(1), clip.view(1, BOX)
    assert torch.equal(whole.color, torch.from_numpy(clip.frame(1)).float() / 255)
    assert torch.equal(whole.alpha, torch.from_numpy(clip.mask(1)).float() / 255)
    assert (whole.camera.width, whole.camera.height) == (WIDTH, HEIGHT)
    assert torch.equal(part.color, whole.color[7:60, 5:41]) and torch.equal(
        part.alpha, whole.alpha[7:60, 5:41]
    )
    assert (part.camera.width, part.camera.height) == (36, 53)
    shift = whole.camera.intrinsics[:2, 2] - part.camera.intrinsics[:2, 2]
    assert shift.tolist() == [5, 7] == [BOX.left, BOX.top]
    grey = torch.full((3,), 0.5)
    outside = whole.alpha == 0
    assert torch.equal(whole.composite(grey)[outside], grey.expand(int(outside.sum()), 3))


def test_views_keep_what_they_have_read(changed):
    views = read(changed).cached_views(BOX)
    assert isinstance(views, ViewCache)
    before = views[0]
    (changed / "ingest" / "frames" / "000000.png").unlink()
    assert torch.equal(views[0].color, before.color)


def test_a_mask_of_another_size_is_refused(changed):
    write_mask(changed / "ingest" / "masks", 1, np.zeros((HEIGHT, WIDTH + 1), np.uint8))
    with pytest.raises(UserError, match="frame, mask and camera 1 differ in size"):
        read(changed).view(1)


def test_a_frame_without_a_clock_has_no_time(changed):
    footage = read_footage(changed / "ingest" / "footage.json")
    write_footage(
        changed / "ingest" / "footage.json", dataclasses.replace(footage, seconds=footage.seconds[:2])
    )
    assert [*read(changed).seconds] == [0, 1]


def test_footage_and_keypoints_are_read_only_when_asked_for(changed):
    (changed / "ingest" / "footage.json").unlink()
    clip = read(changed)
    assert clip.spread(1) == (0,)
    with pytest.raises(UserError, match="keypoints"):
        _ = clip.keypoints
    write_keypoints(changed / "ingest" / "keypoints.parquet", empty_keypoints(np.arange(FRAMES)))
    assert len(clip.keypoints.frames) == FRAMES
    with pytest.raises(UserError, match="footage"):
        _ = clip.seconds


def test_a_split_frame_needs_a_pose(changed):
    write_split(changed / "ingest" / "split.json", Split((0, 1), (FRAMES,)))
    with pytest.raises(UserError, match=f"no pose for frame {FRAMES}; run the fit stage again"):
        read(changed)


def test_a_pose_needs_a_camera(changed):
    path = changed / "ingest" / "cameras.parquet"
    cameras = read_cameras(path)
    del cameras[3]
    write_cameras(path, cameras)
    with pytest.raises(UserError, match="no camera for frame 3; run the ingest stage again"):
        read(changed)


def test_frame_numbers_have_to_increase(changed):
    path = changed / "fit" / "poses.parquet"
    write_poses(path, dataclasses.replace(read_poses(path), frames=(0, 1, 3, 2, 4, 5)))
    with pytest.raises(UserError, match="do not increase; run the fit stage again"):
        read(changed)


@pytest.mark.parametrize("name", ["rotation", "expression", "transl"])
def test_poses_have_to_be_finite(changed, monkeypatch, name):
    poses = moving_poses()
    getattr(poses, name)[2] = float("nan")
    monkeypatch.setattr("pipeline.clip.fitted_clip.read_poses", lambda path: poses)
    with pytest.raises(UserError, match=f"{name} is not finite everywhere; run the fit stage again"):
        read(changed)


def test_the_body_is_given_or_read(subject, body):
    assert read(subject, body).body is body
    assert read(subject, BODY_FILE).body.digest == body.digest
