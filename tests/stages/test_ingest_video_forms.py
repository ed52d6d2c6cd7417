"""Videos as cameras, editors and bad copies leave them: mirrored, damaged, with covers, interlaced."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from pipeline.errors import UserError
from stages.ingest.datasets import open_recording
from stages.ingest.detect import detect
from stages.ingest.display_matrix import from_matrix
from stages.ingest.external_detections import open_sources
from stages.ingest.settings import IngestSettings
from stages.ingest.video import missing_frames, open_clip, read_clip
from tests.made.videos import (
    ingest_context,
    numbered_images,
    walking_blob,
    write_clip,
    write_images,
    write_points,
)

H264 = {"crf": "10", "bf": "0"}


def encode(
    path: Path, images: list[np.ndarray], codec: str = "libx264", form: str = "yuv420p", **options
) -> Path:
    """A clip of 25 frames a second."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, 25, options={key: str(value) for key, value in options.items()})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = form
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return path


def read_all(path: Path, damaged: str = "refuse") -> list[np.ndarray]:
    return [frame.image for frame in read_clip(open_clip(path), damaged=damaged)]


def textured(count: int, height: int = 96, width: int = 128, step: int = 4) -> list[np.ndarray]:
    """A texture that moves to the left by ``step`` pixels a frame."""
    noise = np.random.default_rng(0).integers(0, 255, (height, width + step * count), np.uint8)
    wide = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)
    return [np.repeat(wide[:, step * i : step * i + width, None], 3, 2) for i in range(count)]


# --- the display matrix


def set_matrix(path: Path, a: float, b: float, c: float, d: float) -> Path:
    """Write the matrix of an MP4 track: x' = a x + c y, y' = b x + d y."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4
    values = [round(value * 65536) for value in (a, b, 0, c, d, 0, 0, 0)]
    data[at + 40 : at + 76] = struct.pack(">9i", *values, 1 << 30)
    path.write_bytes(bytes(data))
    return path


def shown_as(image: np.ndarray, a: int, b: int, c: int, d: int) -> np.ndarray:
    """The picture whose pixels the matrix moves one by one."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    column, row = a * x + c * y, b * x + d * y
    shown = np.zeros((int(np.ptp(row)) + 1, int(np.ptp(column)) + 1, 3), np.uint8)
    shown[row - row.min(), column - column.min()] = image
    return shown


MATRICES = [(1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0),
            (-1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, -1, -1, 0)]  # fmt: skip


@pytest.mark.parametrize("matrix", MATRICES)
def test_frames_are_turned_and_mirrored_as_the_display_matrix_says(tmp_path: Path, matrix: tuple) -> None:
    plain = write_clip(tmp_path / "plain.mp4", textured(2))
    stored = read_all(plain)[0]
    path = set_matrix(write_clip(tmp_path / "clip.mp4", textured(2)), *matrix)
    clip = open_clip(path)
    expected = shown_as(stored, *matrix)
    assert (clip.height, clip.width) == expected.shape[:2]
    np.testing.assert_array_equal(next(read_clip(clip)).image, expected)
    assert any("display matrix" in note for note in clip.notes) == (matrix != (1, 0, 0, 1))


@pytest.mark.parametrize("matrix", MATRICES)
def test_a_matrix_of_any_scale_is_its_nearest_quarter_turn(matrix: tuple) -> None:
    a, b, c, d = (2.5 * value for value in matrix)
    cos, sin = np.cos(0.1), np.sin(0.1)
    tilted = (a * cos - b * sin, a * sin + b * cos, c * cos - d * sin, c * sin + d * cos)
    exact, near = from_matrix(*matrix), from_matrix(*tilted)
    assert (near.turns, near.mirrored) == (exact.turns, exact.mirrored)
    assert abs(abs(near.askew) - np.degrees(0.1)) < 1e-6


def test_a_matrix_of_zeros_leaves_frames_as_they_are() -> None:
    assert from_matrix(0, 0, 0, 0) == from_matrix(1, 0, 0, 1)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
@pytest.mark.parametrize("flag", range(1, 9))
def test_pictures_are_turned_and_mirrored_as_exif_says(tmp_path: Path, suffix: str, flag: int) -> None:
    from PIL import Image, ImageOps

    exif = Image.Exif()
    exif[0x0112] = flag
    file = tmp_path / f"0{suffix}"
    Image.fromarray(textured(1)[0]).save(file, exif=exif.tobytes() if suffix != ".tif" else exif)
    with Image.open(file) as picture:
        expected = np.asarray(ImageOps.exif_transpose(picture))
    shown = next(read_clip(open_clip(tmp_path))).image
    assert shown.shape == expected.shape
    assert np.abs(shown.astype(int) - expected).mean() < 3


# --- cut off and damaged


def moved_to_front(path: Path) -> Path:
    """The file with its index before its frames, as web videos and most copies have it."""
    front = path.with_name(f"front_{path.name}")
    with av.open(str(path)) as source, av.open(str(front), "w", options={"movflags": "faststart"}) as target:
        copied = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = copied
                target.mux(packet)
    return front


def packet_places(path: Path) -> list[tuple[int, int]]:
    """Offset and size of each frame's data."""
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]


def cut_at(path: Path, frame: int) -> Path:
    """The file up to the middle of a frame's data."""
    offset, size = packet_places(path)[frame]
    path.write_bytes(path.read_bytes()[: offset + size // 2])
    return path


CONTAINERS = {"mp4": "libx264", "mov": "mjpeg", "mkv": "libx264", "webm": "libvpx-vp9", "avi": "mpeg4"}


def whole_clip(folder: Path, kind: str) -> Path:
    codec = CONTAINERS[kind]
    options = {"libvpx-vp9": {"cpu-used": 8, "lag-in-frames": 0}, "libx264": H264}.get(codec, {})
    form = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = encode(folder / f"clip.{kind}", textured(12), codec, form, g=4, **options)
    return moved_to_front(path) if kind in ("mp4", "mov") else path


@pytest.mark.parametrize("kind", CONTAINERS)
def test_a_file_that_is_cut_off_is_refused_with_both_counts(tmp_path: Path, kind: str) -> None:
    path = whole_clip(tmp_path, kind)
    assert len(read_all(path)) == 12
    clip = open_clip(cut_at(path, 7))
    with pytest.raises(
        UserError, match=rf"clip\.{kind} is cut off: [78] of 1[0-9] frames .*ingest\.damaged=skip"
    ):
        list(read_clip(clip))
    whole = [frame.index for frame in read_clip(clip, damaged="skip") if not frame.damaged]
    assert whole == list(range(7))
    assert len(missing_frames(clip)) >= 4
    assert [frame.index for frame in read_clip(clip, limit=6)] == list(range(6)), "what is there may be read"


def test_a_file_that_lacks_its_index_says_so(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mp4", textured(6), **H264)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UserError, match=r"clip\.mp4 is cut off: its index"):
        open_clip(path)


def test_frames_that_an_edit_list_hides_are_not_missing(tmp_path: Path) -> None:
    """An editor that trims a clip leaves its frames in the file."""
    path = encode(tmp_path / "clip.mp4", textured(12), g=4, **H264)
    data = bytearray(path.read_bytes())
    at = data.index(b"elst")
    scale = struct.unpack(">I", data[data.index(b"mvhd") + 16 : data.index(b"mvhd") + 20])[0]
    ticks = struct.unpack(">I", data[data.index(b"mdhd") + 16 : data.index(b"mdhd") + 20])[0]
    data[at + 12 : at + 20] = struct.pack(">Ii", round(scale * 4 / 25), round(ticks * 4 / 25))
    path.write_bytes(bytes(data))
    clip = open_clip(path)
    assert not missing_frames(clip)
    assert 3 <= len(list(read_clip(clip))) <= 6


def damage(path: Path, frame: int) -> Path:
    """The file with other bytes within a frame's data.

    VP9's decoder takes any bytes after a frame's header for a picture, so there the header is hit.
    """
    offset, size = packet_places(path)[frame]
    data = bytearray(path.read_bytes())
    start = offset + (8 if path.suffix == ".webm" else size // 3)
    data[start : start + size // 2] = np.random.default_rng(1).integers(0, 256, size // 2, np.uint8).tobytes()
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("kind", ["mp4", "mov", "mkv", "webm", "avi"])
def test_a_damaged_frame_is_refused_or_left_out_with_what_it_spoils(tmp_path: Path, kind: str) -> None:
    path = whole_clip(tmp_path, kind)
    truth = read_all(path)
    clip = open_clip(damage(path, 5))
    with pytest.raises(UserError, match=rf"clip\.{kind}: frame 5 is damaged.*ingest\.damaged=skip"):
        list(read_clip(clip))
    frames = list(read_clip(clip, damaged="skip"))
    assert [frame.index for frame in frames] == list(range(12)), "the others keep their numbers"
    spoilt = {frame.index for frame in frames if frame.damaged}
    assert 5 in spoilt and spoilt <= {5, 6, 7}, "the next key frame is number 8"
    for frame in frames:
        if not frame.damaged:
            np.testing.assert_array_equal(frame.image, truth[frame.index])


def test_a_damaged_picture_of_a_folder_is_refused_or_left_out(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "frames", numbered_images(3))
    file = folder / "0001.png"
    file.write_bytes(file.read_bytes()[:60])
    with pytest.raises(UserError, match=r"0001\.png is not a readable picture.*ingest\.damaged=skip"):
        list(read_clip(open_clip(folder)))
    frames = read_clip(open_clip(folder), damaged="skip")
    assert [(frame.index, frame.damaged) for frame in frames] == [(0, False), (1, True), (2, False)]


@pytest.mark.parametrize("kind", ["folder", "pipe", "dangling link"])
def test_what_is_no_file_among_frames_is_refused_or_left_out(tmp_path: Path, kind: str) -> None:
    folder = write_images(tmp_path / "frames", numbered_images(3))
    odd = folder / "0003.png"
    {"folder": odd.mkdir, "pipe": lambda: os.mkfifo(odd), "dangling link": lambda: odd.symlink_to("nothing")}[
        kind
    ]()
    with pytest.raises(UserError, match=r"0003\.png"):
        list(read_clip(open_clip(folder)))
    assert [frame.index for frame in read_clip(open_clip(folder), damaged="skip") if not frame.damaged] == [
        0,
        1,
        2,
    ]


def test_what_is_left_out_is_counted(tmp_path: Path) -> None:
    images, masks = walking_blob(12)
    path = cut_at(moved_to_front(encode(tmp_path / "clip.mp4", images, g=4, **H264)), 9)
    given = {
        "keypoints": str(write_points(tmp_path / "points", range(12))),
        "masks": str(write_images(tmp_path / "masks", masks)),
    }
    context = ingest_context(tmp_path, path, damaged="skip", **given)
    shot = open_recording(path, context.settings).shots[0]
    for folder in ("frames", "masks"):
        (context.output / folder).mkdir()
    (tmp_path / "raw").mkdir()
    found = detect(context, shot.clip, open_sources(context, shot, "plain", None), tmp_path / "raw")
    assert found.read == 12
    assert found.dropped["cut off"] + found.dropped.get("damaged", 0) == 3
    assert found.keypoints.frames.tolist() == list(range(9))


def test_damaged_is_one_of_two_words() -> None:
    with pytest.raises(ValueError):
        IngestSettings(damaged="perhaps")  # type: ignore[arg-type]


# --- which stream, and cover pictures


@pytest.mark.parametrize(
    ("codec", "kind", "marked"),
    [("mjpeg", "mp4", True), ("png", "mp4", True), ("mjpeg", "mp4", False), ("png", "mov", False),
     ("mjpeg", "mkv", False)],
)  # fmt: skip
def test_a_cover_picture_is_not_the_footage(tmp_path: Path, codec: str, kind: str, marked: bool) -> None:
    path = tmp_path / f"clip.{kind}"
    with av.open(str(path), "w") as container:
        cover = container.add_stream(codec, 25)
        cover.width, cover.height = 32, 32
        cover.pix_fmt = "yuvj420p" if codec == "mjpeg" else "rgb24"
        if marked:
            cover.disposition = 1024
        film = container.add_stream("libx264", 25, options=H264)
        film.height, film.width, film.pix_fmt = 48, 64, "yuv420p"
        container.mux(
            cover.encode(av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24"))
        )
        container.mux(cover.encode())
        for image in numbered_images(6):
            container.mux(film.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(film.encode())
    clip = open_clip(path)
    assert (clip.width, clip.height, len(list(read_clip(clip)))) == (64, 48, 6)
    assert any("1 other video stream" in note for note in clip.notes)


def test_a_song_with_a_cover_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "song.mp4"
    with av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg", 25)
        cover.width, cover.height, cover.pix_fmt = 32, 32, "yuvj420p"
        cover.disposition = 1024
        container.mux(
            cover.encode(av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24"))
        )
        container.mux(cover.encode())
    with pytest.raises(UserError, match=r"song\.mp4 has a cover picture and no video"):
        open_clip(path)


# --- interlaced


def woven(parity: str, fields: list[np.ndarray]) -> list[np.ndarray]:
    """Frames of two fields each."""
    frames = []
    for early, late in zip(fields[::2], fields[1::2], strict=True):
        frame = early.copy()
        frame[(1 if parity == "tff" else 0) :: 2] = late[(1 if parity == "tff" else 0) :: 2]
        frames.append(frame)
    return frames


def combing(image: np.ndarray) -> float:
    """How much more a line differs from its neighbours than from the lines beyond them."""
    grey = image.mean(2)
    near = np.abs(2 * grey[1:-1] - grey[:-2] - grey[2:]).mean()
    return float(near / (np.abs(grey[2:] - grey[:-2]).mean() + 1e-9))


@pytest.mark.parametrize("parity", ["tff", "bff"])
@pytest.mark.parametrize("marked", [True, False])
def test_interlaced_footage_is_made_whole(tmp_path: Path, parity: str, marked: bool) -> None:
    fields = textured(24, step=3)
    options = {"x264-params": "tff=1" if parity == "tff" else "bff=1"} if marked else {}
    path = encode(tmp_path / "clip.mp4", woven(parity, fields), **H264, **options)
    clip = open_clip(path)
    frames = list(read_clip(clip))
    assert any("interlaced" in note for note in clip.notes)
    assert [frame.index for frame in frames] == list(range(12))
    np.testing.assert_allclose([frame.seconds for frame in frames], np.arange(12) / 25, atol=1e-6)
    whole = np.median([combing(image) for image in fields])
    combed = np.median([combing(image) for image in woven(parity, fields)])
    made = np.median([combing(frame.image) for frame in frames[2:-2]])
    assert combed > 3 * whole
    assert made < 1.5 * whole


def test_whole_pictures_that_are_marked_as_interlaced_stay_as_they_are(tmp_path: Path) -> None:
    path = encode(tmp_path / "clip.mp4", textured(16), **H264, **{"x264-params": "tff=1"})
    clip = open_clip(path)
    with av.open(str(path)) as container:
        stored = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    np.testing.assert_array_equal([frame.image for frame in read_clip(clip)], stored)
    assert any("left as they are" in note for note in clip.notes)


@pytest.mark.parametrize("codec", ["libx264", "mjpeg", "mpeg4"])
def test_whole_pictures_are_not_taken_for_interlaced(tmp_path: Path, codec: str) -> None:
    form = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = encode(tmp_path / "clip.mov", textured(40), codec, form)
    assert open_clip(path).notes == ()
