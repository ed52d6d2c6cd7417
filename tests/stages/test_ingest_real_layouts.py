"""Layouts on real recordings: four calibrated cameras of a room, a TalkShow clip without SHOW's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.clip.keypoints import read_keypoints
from pipeline.clip.records import SHOT_STEP, read_cameras, read_footage, read_split
from pipeline.config.request import parse_request
from pipeline.pose_files import INITIAL_POSES
from pipeline.run.job import open_job
from stages.ingest.run import run
from tests.made.videos import ingest_context

JOINTS = (11, 12, 13, 14, 23, 24, 25, 26, 27, 28)
HIP, KNEE = (JOINTS.index(23), JOINTS.index(24)), (JOINTS.index(25), JOINTS.index(26))
FRAMES = (0, 30, 60)


def assets_of(folder: Path, *names: str) -> dict[str, Path]:
    missing = [name for name in names if not (folder / name).is_dir()]
    if missing:
        pytest.skip(f"{missing[0]} is not in {folder}: doit run assets:{missing[0]}")
    return {name: folder / name for name in names}


def triangulate(projections: list[np.ndarray], pixels: np.ndarray) -> np.ndarray:
    """The point [3] whose projections lie nearest to pixels [N, 2], algebraically."""
    rows = [
        row
        for p, (x, y) in zip(projections, pixels, strict=True)
        for row in (x * p[2] - p[0], y * p[2] - p[1])
    ]
    rows = [row / np.linalg.norm(row[:3]) for row in rows]
    point = np.linalg.svd(np.stack(rows))[2][-1]
    return point[:3] / point[3]


@pytest.mark.slow
@pytest.mark.assets
def test_four_calibrated_cameras_see_one_person(tmp_path, assets_folder):
    assets = assets_of(assets_folder, "mediapipe", "balance")
    context = ingest_context(
        tmp_path, assets["balance"], {"mediapipe": assets["mediapipe"]}, test_cameras=("others",),
        stride=30, max_frames=len(FRAMES), background=False, mask_steadiness=0,
    )  # fmt: skip
    run(context)
    output = context.output
    split = read_split(output / "split.json")
    assert split.train == FRAMES
    assert split.test == tuple(camera * SHOT_STEP + frame for camera in (1, 2, 3) for frame in FRAMES)
    assert read_footage(output / "footage.json").camera["source"] == "Qualisys"
    cameras = read_cameras(output / "cameras.parquet", torch.float64)
    keypoints = read_keypoints(output / "keypoints.parquet")
    projections = [
        (c.intrinsics @ torch.cat([c.rotation, c.translation[:, None]], dim=1)).numpy()
        for c in (cameras[camera * SHOT_STEP] for camera in range(4))
    ]
    points, errors = [], []
    for frame in FRAMES:
        rows = [keypoints.index(camera * SHOT_STEP + frame) for camera in range(4)]
        seen = keypoints.pose_image[rows][:, list(JOINTS), :2].astype(np.float64)
        points.append([triangulate(projections, seen[:, joint]) for joint in range(len(JOINTS))])
        for projection, pixels in zip(projections, seen, strict=True):
            there = np.c_[np.array(points[-1]), np.ones(len(JOINTS))] @ projection.T
            errors.append(np.linalg.norm(there[:, :2] / there[:, 2:] - pixels, axis=1))
    # The detector alone errs by 8 to 18 of the 1,920 pixels, which are 2 to 5 of the stored 512.
    assert np.median(errors) < 7
    places = np.array(points)
    thighs = np.linalg.norm(places[:, HIP] - places[:, KNEE], axis=-1)
    assert 0.33 < np.median(thighs) < 0.50  # metres
    up = places[:, HIP].mean((0, 1)) - places[:, [JOINTS.index(27), JOINTS.index(28)]].mean((0, 1))
    assert up[1] > 0.9 * np.linalg.norm(up)  # the world's Y axis points up


@pytest.mark.slow
@pytest.mark.assets
@pytest.mark.shared
def test_oliver_is_a_talkshow_clip_without_shows_file(tmp_path, assets_folder, shared_folder):
    assets = assets_of(assets_folder, "mediapipe")
    clip = shared_folder / "data" / "oliver" / "video.mp4"
    if not clip.is_file():
        pytest.skip("the clip is not there")
    job = open_job(
        "oliver",
        parse_request({"source": str(clip), "ingest.max_frames": "40", "ingest.long_side": "256"}, "oliver"),
    )
    settings = job.settings["ingest"]
    assert settings.layout == "talkshow" and settings.test_frames == 30  # from the dataset's file
    fields = {name: getattr(settings, name) for name in settings.__dataclass_fields__}
    context = ingest_context(tmp_path, clip, assets, **fields)
    run(context)
    split = read_split(context.output / "split.json")
    assert len(split.test) == 30 and max(split.train) < min(split.test)
    assert not (context.output / INITIAL_POSES).exists()
    assert read_footage(context.output / "footage.json").sources["masks"] == "mediapipe"
