"""Frames, masks and video on disk."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

from pipeline.clip.frames import frame_path, read_frame, read_mask, write_frame, write_mask, write_video
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)


def test_frame_round_trip_keeps_the_order_of_colours(tmp_path: Path) -> None:
    image = noise(17, 23, 3)
    write_frame(tmp_path, 42, image)
    assert frame_path(tmp_path, 42).name == "000042.png"
    np.testing.assert_array_equal(read_frame(tmp_path, 42), image)


def test_mask_round_trip(tmp_path: Path) -> None:
    mask = noise(17, 23)
    write_mask(tmp_path, 0, mask)
    np.testing.assert_array_equal(read_mask(tmp_path, 0), mask)


def test_a_frame_is_stored_as_rgb(tmp_path: Path) -> None:
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 255
    write_frame(tmp_path, 0, red)
    with av.open(str(frame_path(tmp_path, 0))) as container:
        other = next(container.decode(video=0)).to_ndarray(format="rgb24")
    np.testing.assert_array_equal(other, red)


@pytest.mark.parametrize("image", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8)])
def test_only_8_bit_rgb_is_a_frame(tmp_path: Path, image: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected uint8 with 3 dimensions"):
        write_frame(tmp_path, 0, image)


def test_missing_frame_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"000003\.png is missing: run the ingest stage again"):
        read_frame(tmp_path, 3)


@pytest.mark.parametrize("content", [b"", b"not a picture"])
def test_damaged_mask_is_named(tmp_path: Path, content: bytes) -> None:
    frame_path(tmp_path, 3).write_bytes(content)
    with pytest.raises(UserError, match=r"000003\.png is not a readable picture"):
        read_mask(tmp_path, 3)


def test_video_is_h264_that_a_browser_plays(tmp_path: Path) -> None:
    images = [np.full((31, 45, 3), 12 * index, np.uint8) for index in range(12)]
    write_video(tmp_path / "clip.mp4", iter(images), 30000 / 1001)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    assert (stream.width, stream.height, len(frames)) == (46, 32, 12)
    assert float(stream.average_rate) == pytest.approx(30000 / 1001)
    assert np.abs(np.array([frame.mean() for frame in frames]) - 12 * np.arange(12)).max() < 4
    data = (tmp_path / "clip.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "playing should start before the whole file is there"


def test_equal_images_give_equal_video(tmp_path: Path) -> None:
    images = [noise(32, 48, 3) for _ in range(6)]
    for name in ("a.mp4", "b.mp4"):
        write_video(tmp_path / name, images, 25)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


ENCODE = """
import hashlib, sys
import numpy as np
from pipeline.clip.frames import write_video
rows, columns = np.mgrid[:50, :38] / 50
for turn in range(3):
    images = []
    for frame in range(8):
        blob = np.exp(-20 * ((columns - 0.4 - 0.2 * np.sin(frame)) ** 2 + (rows - 0.5) ** 2))
        grain = 8 * np.random.default_rng(frame).random((50, 38, 1))
        images.append((np.stack([blob, blob * columns, blob * rows], -1) * 200 + grain).astype(np.uint8))
    write_video(sys.argv[1], images, 30)
    print(hashlib.sha256(open(sys.argv[1], "rb").read()).hexdigest())
"""


def test_video_does_not_depend_on_what_memory_held_before(tmp_path: Path) -> None:
    found = set()
    for fill in (
        "0",
        "85",
        "170",
    ):  # glibc fills memory that it gives out; elsewhere this is one more encoding
        run = subprocess.run(
            [sys.executable, "-c", ENCODE, str(tmp_path / "a.mp4")], cwd=REPOSITORY, check=True, text=True,
            capture_output=True, env={**os.environ, "MALLOC_PERTURB_": fill},
        )  # fmt: skip
        found.update(run.stdout.split())
    assert len(found) == 1


def test_video_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no frames"):
        write_video(tmp_path / "clip.mp4", [], 25)


def test_video_of_different_sizes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot share a video"):
        write_video(tmp_path / "clip.mp4", [noise(16, 16, 3), noise(16, 18, 3)], 25)
