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


PATCHES = np.array(
    [(195, 130, 120), (128, 128, 128), (30, 40, 60), (200, 200, 190), (255, 0, 0), (0, 255, 0), (0, 0, 255)]
)


def test_video_is_coded_by_bt709_and_says_so(tmp_path: Path) -> None:
    """Luma and chroma by the standard's own matrix, limited range, and the tags that players read."""
    image = np.repeat(np.repeat(PATCHES[None].astype(np.uint8), 32, 0), 32, 1)
    write_video(tmp_path / "clip.mp4", [image] * 3, 25)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        context = container.streams.video[0].codec_context
        tags = (context.colorspace, context.color_primaries, context.color_trc, context.color_range)
        frame = next(container.decode(video=0))
        planes = frame.to_ndarray()  # as they are stored, without a conversion
    assert tuple(map(int, tags)) == (1, 1, 1, 1)
    assert (frame.colorspace, frame.color_range) == (1, 1)
    width = image.shape[1]
    luma = planes[16, 16::32]
    blue, red = (planes[row].reshape(-1)[8 : 8 + width // 2 : 16] for row in (32 + 2, 32 + 8 + 2))
    share = PATCHES / 255
    expected = share @ [0.2126, 0.7152, 0.0722]
    assert np.abs(luma - (16 + 219 * expected)).max() <= 2
    assert np.abs(blue - (128 + 224 * (share[:, 2] - expected) / 1.8556)).max() <= 3
    assert np.abs(red - (128 + 224 * (share[:, 0] - expected) / 1.5748)).max() <= 3
    y, cb, cr = (luma - 16) / 219, (blue - 128.0) / 224, (red - 128.0) / 224
    shown = np.stack([y + 1.5748 * cr, y - 0.187324 * cb - 0.468124 * cr, y + 1.8556 * cb], 1)
    assert np.abs(255 * shown - PATCHES).max() <= 4


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
