"""Cameras of one rig whose pictures differ in size: what is drawn and cut of their frames."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
import torch

from pipeline.body import Pose, Poses, load_body, mean_identity
from pipeline.clip.boxes import Box
from pipeline.clip.camera import facing_camera
from pipeline.clip.frames import write_frame, write_mask, write_video
from pipeline.clip.views import ViewCache
from stages.evaluate.report.pictures import compare, comparison_sheet
from stages.fit.overlay import overlays, sheet
from tests.made.body import BODY_FILE

SIZES = {0: (48, 64), 1: (40, 72), 2: (56, 60)}  # frame -> width, height


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    for folder in ("frames", "masks"):
        (tmp_path / folder).mkdir()
    for frame, (width, height) in SIZES.items():
        write_frame(tmp_path / "frames", frame, np.full((height, width, 3), 60 + frame, np.uint8))
        mask = np.zeros((height, width), np.uint8)
        mask[10:50, 10:36] = 255
        write_mask(tmp_path / "masks", frame, mask)
    return tmp_path


def test_the_overlay_and_its_sheet_show_every_camera(clip: Path) -> None:
    body = load_body(BODY_FILE)
    cameras = {frame: facing_camera(*size, 60.0) for frame, size in SIZES.items()}
    still = Pose(
        torch.zeros(55, 3), torch.zeros(body.expression_directions.shape[2]), torch.tensor([0.0, 0, -6])
    )
    poses = Poses.stack(tuple(SIZES), [still] * len(SIZES))
    drawn = list(overlays(body, mean_identity(body), poses, cameras, clip / "frames", 0.5))
    assert {picture.shape for picture in drawn} == {(72, 56, 3)}
    for frame, picture in zip(SIZES, drawn, strict=True):
        width, height = SIZES[frame]
        assert (picture[0, :width] == 60 + frame).all(), "the frame lies in the upper left"
        assert not picture[height:].any() and not picture[:, width:].any()
    write_video(clip / "overlay.mp4", drawn, 25)
    with av.open(str(clip / "overlay.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == len(SIZES)
    assert sheet(clip / "frames", clip / "masks", poses, dict(enumerate(drawn))).shape[0] == 2 * 360


def test_comparisons_of_cameras_stand_below_one_another() -> None:
    pairs = [
        compare(frame, torch.full((height, width, 3), 0.5), torch.zeros(height, width, 3), 4.0, 20.0)
        for frame, (width, height) in SIZES.items()
    ]
    picture = comparison_sheet([pair.cropped(Box(0, 0, 56, 72)) for pair in pairs], 4.0)
    assert picture.shape[1] == 3 * 56 + 2 * 6
    assert picture.shape[0] >= sum(height for _, height in SIZES.values())


def test_a_crop_that_reaches_out_of_a_smaller_picture_ends_with_it(clip: Path) -> None:
    cameras = {frame: facing_camera(*size, 60.0) for frame, size in SIZES.items()}
    views = ViewCache(clip, cameras, Box(8, 4, 52, 70))
    for frame, (width, height) in SIZES.items():
        view = views[frame]
        shape = (min(height, 70) - 4, min(width, 52) - 8)
        assert view.color.shape[:2] == view.alpha.shape == (view.camera.height, view.camera.width) == shape
        whole = cameras[frame].intrinsics
        torch.testing.assert_close(
            view.camera.intrinsics[:2, 2], whole[:2, 2] - torch.tensor([8.0, 4.0]).to(whole)
        )
