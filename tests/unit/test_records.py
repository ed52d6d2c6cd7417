"""Cameras, split and footage: round trips, and one line for each way to be malformed."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from pipeline.clip.camera import Camera, facing_camera
from pipeline.clip.records import (
    Footage,
    Split,
    read_cameras,
    read_footage,
    read_split,
    write_cameras,
    write_footage,
    write_split,
)
from pipeline.errors import UserError

FOOTAGE = Footage(
    name="clip.mp4", width=1280, height=720, fps=29.97, scale=0.4, read=10, kept=2,
    dropped={"no person found": 8}, people=1, seconds=(0.0, 0.033), sources={"keypoints": "mediapipe"},
)  # fmt: skip


def turned_camera() -> Camera:
    angle = torch.tensor(0.3, dtype=torch.float64)
    rotation = torch.eye(3, dtype=torch.float64)
    rotation[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    intrinsics = torch.tensor([[500.0, 0, 31.5], [0, 510.0, 24.25], [0, 0, 1]], dtype=torch.float64)
    return Camera(64, 48, intrinsics, rotation, torch.tensor([0.1, -0.2, 3.0], dtype=torch.float64))


def test_cameras_round_trip_in_double_precision(tmp_path: Path) -> None:
    written = {7: turned_camera(), 2: facing_camera(64, 48, 76.8)}
    write_cameras(tmp_path / "cameras.parquet", written)
    read = read_cameras(tmp_path / "cameras.parquet", torch.float64)
    assert list(read) == [2, 7]
    for name in ("intrinsics", "rotation", "translation"):
        assert torch.equal(getattr(read[7], name), getattr(written[7], name))
    assert (read[7].width, read[7].height) == (64, 48)
    assert read_cameras(tmp_path / "cameras.parquet")[2].rotation.dtype == torch.float32


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": 2 * torch.eye(3)}, "frame 0 has no proper rotation"),
        ({"rotation": torch.diag(torch.tensor([1.0, 1.0, -1.0]))}, "frame 0 has no proper rotation"),
        ({"intrinsics": torch.zeros(3, 3)}, "frame 0 is empty"),
        ({"width": 0}, "frame 0 is empty"),
    ],
)
def test_impossible_cameras_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    camera = dataclasses.replace(facing_camera(64, 48, 76.8), **change)
    write_cameras(tmp_path / "cameras.parquet", {0: camera})
    with pytest.raises(UserError, match=rf"cameras\.parquet.*{message}"):
        read_cameras(tmp_path / "cameras.parquet")


def test_cameras_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    camera = dataclasses.replace(facing_camera(64, 48, 76.8), translation=torch.tensor([0, 0, torch.nan]))
    with pytest.raises(ValueError, match="not finite"):
        write_cameras(tmp_path / "cameras.parquet", {0: camera})


def test_split_round_trip(tmp_path: Path) -> None:
    write_split(tmp_path / "split.json", Split((0, 1, 2), (3, 4)))
    assert read_split(tmp_path / "split.json") == Split((0, 1, 2), (3, 4))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"train": [0, 1]}, "'test' must be a list"),
        ({"train": [0, 1.5], "test": []}, "'train' must be a list of frame numbers"),
        ({"train": [True], "test": []}, "'train' must be a list of frame numbers"),
        ({"train": [-1], "test": []}, "'train' must be a list of frame numbers"),
        ([1, 2], "'train' must be a list"),
        ({"train": [], "test": [1]}, "train is empty"),
        ({"train": [1, 2], "test": [2]}, "a frame stands twice"),
    ],
)
def test_malformed_split_is_refused(tmp_path: Path, value: object, message: str) -> None:
    (tmp_path / "split.json").write_text(json.dumps(value))
    with pytest.raises(UserError, match=rf"split\.json.*{message}"):
        read_split(tmp_path / "split.json")


def test_footage_round_trip(tmp_path: Path) -> None:
    write_footage(tmp_path / "footage.json", FOOTAGE)
    assert read_footage(tmp_path / "footage.json") == FOOTAGE


def test_footage_with_a_missing_field_is_refused(tmp_path: Path) -> None:
    (tmp_path / "footage.json").write_text('{"name": "x"}')
    with pytest.raises(UserError, match=r"footage\.json: its fields are not"):
        read_footage(tmp_path / "footage.json")
