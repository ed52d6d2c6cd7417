"""Footage: any clip becomes upright pictures with square pixels, numbered and timed."""

from __future__ import annotations

import itertools
import wave
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from pipeline.errors import UserError
from stages.ingest.video import open_clip, read_clip
from tests.made.videos import numbered_images, turn_clip, write_clip, write_images


def red_corner(image: np.ndarray) -> str:
    """In which corner the red mark is."""
    height, width = image.shape[:2]
    corners = {
        "top left": image[4, 4],
        "top right": image[4, width - 5],
        "bottom left": image[height - 5, 4],
        "bottom right": image[height - 5, width - 5],
    }
    return max(corners, key=lambda name: int(corners[name][0]) - int(corners[name][1]))


def test_frames_come_in_order_with_their_times(tmp_path: Path) -> None:
    clip = open_clip(write_clip(tmp_path / "clip.mp4", numbered_images(10)))
    pictures = list(read_clip(clip))
    assert (clip.width, clip.height, clip.fps, clip.expected) == (64, 48, 25.0, 10)
    assert [picture.index for picture in pictures] == list(range(10))
    np.testing.assert_allclose([picture.seconds for picture in pictures], np.arange(10) / 25, atol=1e-6)
    for index, picture in enumerate(pictures):
        assert picture.image.dtype == np.uint8
        assert abs(float(picture.image[30:, 30:].mean()) - (10 + 8 * index)) < 4


def test_stride_and_limit(tmp_path: Path) -> None:
    clip = open_clip(write_clip(tmp_path / "clip.mp4", numbered_images(10)))
    assert [picture.index for picture in read_clip(clip, stride=3)] == [0, 3, 6, 9]
    assert [picture.index for picture in read_clip(clip, stride=2, limit=3)] == [0, 2, 4]


def test_reading_is_lazy(tmp_path: Path) -> None:
    """A damaged end does not matter to who stops before it: nothing is read ahead."""
    folder = write_images(tmp_path / "frames", numbered_images(4))
    (folder / "0003.png").write_bytes(b"no picture")
    assert len(list(itertools.islice(read_clip(open_clip(folder)), 3))) == 3


@pytest.mark.parametrize(
    ("degrees", "corner"), [(90, "top right"), (180, "bottom right"), (270, "bottom left")]
)
def test_rotation_flag_is_honoured(tmp_path: Path, degrees: int, corner: str) -> None:
    path = write_clip(tmp_path / "clip.mp4", numbered_images(3))
    turn_clip(path, degrees)
    clip = open_clip(path)
    assert (clip.width, clip.height) == ((64, 48) if degrees == 180 else (48, 64))
    assert {red_corner(picture.image) for picture in read_clip(clip)} == {corner}


def test_variable_frame_rate_keeps_every_frame_and_its_time(tmp_path: Path) -> None:
    ticks = [0, 20, 40, 200, 210, 600]
    clip = open_clip(write_clip(tmp_path / "clip.mp4", numbered_images(6), ticks=ticks))
    pictures = list(read_clip(clip))
    assert [picture.index for picture in pictures] == list(range(6))
    np.testing.assert_allclose([picture.seconds for picture in pictures], np.array(ticks) / 1000, atol=2e-3)


def test_pixels_become_square(tmp_path: Path) -> None:
    clip = open_clip(write_clip(tmp_path / "clip.mp4", numbered_images(2), ratio=Fraction(3, 2)))
    assert (clip.width, clip.height) == (96, 48)
    assert next(read_clip(clip)).image.shape == (48, 96, 3)


def test_pictures_named_by_numbers_keep_them(tmp_path: Path) -> None:
    names = ["7.png", "12.png", "100.jpg"]
    clip = open_clip(write_images(tmp_path / "frames", numbered_images(3), names))
    assert [picture.index for picture in read_clip(clip)] == [7, 12, 100]
    assert clip.fps == 0


def test_pictures_with_other_names_are_counted(tmp_path: Path) -> None:
    clip = open_clip(write_images(tmp_path / "frames", numbered_images(3), ["b.png", "a1.png", "c.png"]))
    pictures = list(read_clip(clip))
    assert [picture.index for picture in pictures] == [0, 1, 2]
    assert pictures[0].image[40, 40, 0] == 18  # a1.png comes first


def silent_sound(path: Path) -> Path:
    with wave.open(str(path), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(1600))
    return path


def clip_without_frames(path: Path) -> Path:
    with av.open(str(path), "w", format="avi") as container:
        stream = container.add_stream("mpeg4", 25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.start_encoding()
    return path


def test_no_video_stream(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"sound\.wav has no video stream: give a video"):
        open_clip(silent_sound(tmp_path / "sound.wav"))


def test_not_a_video(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(bytes(range(256)) * 8)
    with pytest.raises(UserError, match=r"clip\.mp4 is not a video .*give a video"):
        open_clip(tmp_path / "clip.mp4")


def test_empty_file(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").touch()
    with pytest.raises(UserError, match=r"clip\.mp4 is not a video"):
        open_clip(tmp_path / "clip.mp4")


def test_zero_frames(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"empty\.avi (has a video stream without a single|is not a video)"):
        open_clip(clip_without_frames(tmp_path / "empty.avi"))


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere\.mp4 does not exist"):
        open_clip(tmp_path / "nowhere.mp4")


def test_folder_without_pictures(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no pictures"):
        open_clip(tmp_path)


def test_unreadable_picture(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "frames", numbered_images(3))
    data = (folder / "0001.png").read_bytes()
    (folder / "0001.png").write_bytes(data[: len(data) // 3])
    with pytest.raises(UserError, match=r"0001\.png is not a readable picture: replace it"):
        list(read_clip(open_clip(folder)))


def test_sizes_differ(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "frames", numbered_images(2))
    cv2.imwrite(str(folder / "0002.png"), np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(UserError, match=r"0002\.png is 20x20, the first frame 64x48"):
        list(read_clip(open_clip(folder)))
