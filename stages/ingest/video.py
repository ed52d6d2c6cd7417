"""Footage of any kind as a stream of upright RGB pictures with square pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline.clip.frame_files import ClipFrames, visible_files
from pipeline.errors import UserError
from pipeline.untrusted import check_picture

VIDEOS = (".mp4", ".mov", ".mkv", ".webm", ".avi")
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
_VIDEO_REMEDY = "give a video that FFmpeg can play, or a folder of pictures"


@dataclasses.dataclass(frozen=True)
class Clip:
    """A video file or a folder of pictures.

    Attributes:
        path: the file or the folder.
        width, height: pixels, after the rotation flag and with square pixels.
        fps: frames a second on average; 0 where there is no clock.
        expected: how many frames the source says it has; 0 where it does not say.
        pictures: frame number -> file, for a folder; empty for a video.
        turns: by how many quarters, counter-clockwise, the rotation flag turns a video's frames.
        first: the number of a video's first frame.
    """

    path: Path
    width: int
    height: int
    fps: float
    expected: int
    pictures: dict[int, Path] = dataclasses.field(default_factory=dict)
    turns: int = 0
    first: int = 0


@dataclasses.dataclass(frozen=True)
class SourceFrame:
    """One frame of a clip.

    Attributes:
        index: the frame's number: its place in decoding order, or the number that names a picture.
        seconds: its time from the clip's first frame; with no clock, its place.
        image: [H, W, 3] uint8 RGB, upright.
    """

    index: int
    seconds: float
    image: np.ndarray


def open_clip(path: Path) -> Clip:
    """Look at the first frame of a source.

    Raises:
        UserError: nothing there, no video stream, no frame, or no readable picture.
    """
    if not path.exists():
        raise UserError(f"{path} does not exist: give a video file or a folder of pictures")
    if path.is_dir():
        return _open_folder(path)
    with _open(path) as container:
        stream = container.streams.video[0]
        first = next(_decode(path, container), None)
        if first is None:
            raise UserError(f"{path} has a video stream without a single frame: {_VIDEO_REMEDY}")
        height, width = _upright(first, stream.sample_aspect_ratio).shape[:2]
        fps = float(stream.average_rate or stream.guessed_rate or 0)
        seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        expected = stream.frames or round(seconds * fps)
        return Clip(path, width, height, fps, expected, turns=_turns(first))


def read_clip(clip: Clip, stride: int = 1, limit: int = 0) -> Iterator[SourceFrame]:
    """Every ``stride``-th frame in order, at most ``limit`` of them (0: all), one in memory at a time.

    Times are a video's own time stamps, so a variable frame rate needs no resampling.

    Raises:
        UserError: a frame is damaged, or its size differs from the first one's.
    """
    frames = _read_folder(clip, stride) if clip.pictures else _read_video(clip, stride)
    for count, picture in enumerate(frames):
        if limit and count == limit:
            return
        if picture.image.shape[:2] != (clip.height, clip.width):
            height, width = picture.image.shape[:2]
            place = clip.pictures.get(picture.index, f"{clip.path}, frame {picture.index},")
            raise UserError(
                f"{place} is {width}x{height}, the first frame {clip.width}x{clip.height}: make all one size"
            )
        yield picture


def _open(path: Path) -> av.container.InputContainer:
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError) as error:
        raise UserError(f"{path} is not a video ({error.strerror}): {_VIDEO_REMEDY}") from None
    if not container.streams.video:
        container.close()
        raise UserError(f"{path} has no video stream: {_VIDEO_REMEDY}")
    return container


def _decode(path: Path, container: av.container.InputContainer) -> Iterator[av.VideoFrame]:
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    count = 0
    try:
        for frame in container.decode(stream):
            yield frame
            count += 1
    except (av.FFmpegError, OSError) as error:
        remedy = f"cut it there, or set ingest.max_frames={count}" if count else _VIDEO_REMEDY
        raise UserError(f"{path} is damaged after {count} frames ({error.strerror}): {remedy}") from None


def _read_video(clip: Clip, stride: int) -> Iterator[SourceFrame]:
    start = 0.0
    with _open(clip.path) as container:
        ratio = container.streams.video[0].sample_aspect_ratio
        for index, frame in enumerate(_decode(clip.path, container)):
            time = frame.time if frame.time is not None else index / (clip.fps or 1.0)
            start = time if index == 0 else start
            if index % stride == 0:
                yield SourceFrame(clip.first + index, time - start, _upright(frame, ratio))


def _upright(frame: av.VideoFrame, ratio: Fraction | None) -> np.ndarray:
    """The frame with square pixels, turned by its rotation flag: [H, W, 3] uint8 RGB."""
    image: np.ndarray = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
    stretch = float(ratio) if ratio else 1.0
    if stretch > 0 and abs(stretch - 1) > 1e-3:
        size = (max(1, round(image.shape[1] * stretch)), image.shape[0])
        image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    turns = _turns(frame)
    return np.ascontiguousarray(np.rot90(image, turns)) if turns else image


def _turns(frame: av.VideoFrame) -> int:
    """The rotation flag in quarters of a turn, counter-clockwise."""
    return round(frame.rotation / 90) % 4


def _open_folder(path: Path) -> Clip:
    files = visible_files(path, PICTURES)
    if not files:
        raise UserError(f"{path} holds no pictures ({', '.join(PICTURES)}): give a folder of frames")
    # A frame's number is its whole name, or else the place in the natural order of names.
    stems = [file.stem for file in files]
    numbered = all(stem.isascii() and stem.isdigit() for stem in stems)
    pictures: dict[int, Path] = {}
    names: dict[str | int, Path] = {}
    for place, file in enumerate(files):
        name = int(file.stem) if numbered else file.stem
        if name in names:
            raise UserError(f"{file} and {names[name].name} have one name: keep one of them")
        names[name] = file
        pictures[int(name) if numbered else place] = file
    return folder_clip(path, pictures)


def folder_clip(path: Path, pictures: Mapping[int, Path], fps: float = 0.0) -> Clip:
    """The clip of some pictures of a folder, frame number -> file.

    Raises:
        UserError: there are none, or the first is damaged.
    """
    if not pictures:
        raise UserError(f"{path} holds no pictures ({', '.join(PICTURES)}): unpack the dataset there")
    ordered = dict(sorted(pictures.items()))
    height, width = read_picture(next(iter(ordered.values()))).shape[:2]
    return Clip(path, width, height, fps, len(ordered), ordered)


def clip_frames(clip: Clip) -> ClipFrames:
    """The frames of a clip, and what they are called where they are pictures."""
    if clip.pictures:
        return ClipFrames(tuple(clip.pictures), {frame: file.name for frame, file in clip.pictures.items()})
    return ClipFrames(range(clip.first, clip.first + clip.expected))


def read_picture(path: Path) -> np.ndarray:
    """A picture file, [H, W, 3] uint8 RGB, upright after its EXIF flag; UserError if it is damaged."""
    data, remedy = np.fromfile(path, np.uint8), "replace it or take it out of the folder"
    check_picture(path, remedy, data.tobytes())
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{path} is not a readable picture: {remedy}")
    return np.ascontiguousarray(image[..., ::-1])


def _read_folder(clip: Clip, stride: int) -> Iterator[SourceFrame]:
    begin = next(iter(clip.pictures))
    for place, (index, file) in enumerate(clip.pictures.items()):
        if place % stride == 0:
            seconds = (index - begin) / clip.fps if clip.fps else float(place)
            yield SourceFrame(index, seconds, read_picture(file))
