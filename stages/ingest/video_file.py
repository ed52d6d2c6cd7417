"""A video file's frames: of the right stream, whole, upright, with square pixels, in sRGB."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Generator, Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline.errors import UserError
from stages.ingest.deinterlacing import LOOKED_AT, deinterlaced, find_parity
from stages.ingest.display_matrix import Orientation, orientation_of
from stages.ingest.tone_mapping import mapping_note, to_srgb
from stages.ingest.video_container import (
    VIDEO_REMEDY,
    StreamContent,
    footage_stream,
    open_container,
    stream_note,
    survey_stream,
)


@dataclasses.dataclass(frozen=True)
class VideoFile:
    """How a video file is read.

    Attributes:
        path: the file.
        stream: the index of the stream that is the footage.
        width, height: pixels, upright and square.
        fps: frames a second on average; 0 where there is no clock.
        expected: how many frames the container states; 0 where it does not say.
        content: what was counted of the stream.
        orientation: the turn and the mirror of its display matrix.
        parity: of interlaced footage, see ``deinterlacing``; empty where frames are whole.
        ratio: a stored pixel's width over its height; None where nothing says so.
        notes: what is done with the frames, a line each.
    """

    path: Path
    stream: int
    width: int
    height: int
    fps: float
    expected: int
    content: StreamContent
    orientation: Orientation
    parity: str
    ratio: Fraction | None
    notes: tuple[str, ...]


def open_video(path: Path) -> VideoFile:
    """Look at a file's streams, count its frames, and see by the first ones how they are to be read.

    Raises:
        UserError: no video, no video stream, or not one frame that can be read.
    """
    with open_container(path) as container:
        stream = footage_stream(path, container)
        index, other = stream.index, stream_note(container, stream)
        ratio, fps = stream.sample_aspect_ratio, float(stream.average_rate or stream.guessed_rate or 0)
        seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        expected = stream.frames or round(seconds * fps)
        content = survey_stream(path, container, stream)
    with contextlib.closing(_decode(path, index)) as decoded:
        frames = (frame for _, frame in itertools.islice(decoded, LOOKED_AT) if frame is not None)
        first = next(frames, None)
        if first is None:
            raise UserError(f"{path} has a video stream without a single frame: {VIDEO_REMEDY}")
        parity, woven = find_parity(itertools.chain([first], frames))
    orientation = orientation_of(first)
    height, width = _upright(first, ratio, orientation).shape[:2]
    notes = [note for note in (other, woven, orientation.note, mapping_note(path, first)) if note]
    if content.cut_off:
        expected = content.stated
        notes.append(cut_note(content))
    return VideoFile(
        path, index, width, height, fps, expected, content, orientation, parity, ratio, tuple(notes)
    )


def cut_note(content: StreamContent) -> str:
    """What is missing of a file, to be read after its name."""
    return f"is cut off: {content.held} of {content.stated} frames are there"


def read_video(video: VideoFile, stride: int = 1) -> Iterator[tuple[int, float, np.ndarray | None]]:
    """Every ``stride``-th frame: its place in the order of showing, its time from the first one, its picture.

    Pictures are [H, W, 3] uint8 RGB; None where a frame is damaged, or shows what a damaged one left behind.
    """
    start: float | None = None
    whole = _whole_frames(video)
    if video.parity:
        whole = deinterlaced(whole, video.parity)
    after = 0
    seconds = 0.0
    for place, frame in whole:
        while after < place:
            if after % stride == 0:
                yield after, seconds, None
            after += 1
        time = frame.time if frame.time is not None else place / (video.fps or 1.0)
        start = time if start is None else start
        seconds = time - start
        if place % stride == 0:
            yield place, seconds, _upright(frame, video.ratio, video.orientation)
        after = place + 1
    for place in range(after, video.content.held):
        if place % stride == 0:
            yield place, seconds, None


def _whole_frames(video: VideoFile) -> Iterator[tuple[int, av.VideoFrame]]:
    """The frames that were read without an error, each with its place."""
    places = {stamp: place for place, stamp in enumerate(video.content.stamps)}
    trusted, complete, following = True, True, 0
    for lost, frame in _decode(video.path, video.stream):
        # What follows a damaged frame is drawn with its remains, up to the next key frame.
        if lost or frame is None or frame.is_corrupt:
            trusted = False
        elif frame.key_frame:
            trusted = True
        if frame is None:
            complete = False
            continue
        # Frames are counted; once one was lost, their time stamps say which they are.
        place = following if complete or frame.pts is None else places.get(frame.pts, following)
        if trusted and place >= following:
            yield place, frame
        following = max(following, place + 1)


def _decode(path: Path, index: int) -> Generator[tuple[bool, av.VideoFrame | None]]:
    """The stream's frames in order of showing, each with whether its data are damaged; None for a lost one.

    One thread decodes: those that take a frame each lose good frames with bad ones, and those that take a
    slice each hide errors.
    """
    with open_container(path) as container:
        stream = container.streams[index]
        assert isinstance(stream, av.VideoStream)
        stream.thread_type = "NONE"
        if stream.codec_context.name == "mjpeg":  # whose decoder marks nothing
            stream.codec_context.options = {"err_detect": "explode"}
        for packet in _packets(container, stream):
            try:
                frames = packet.decode()
            except (av.FFmpegError, OSError):
                yield True, None
                continue
            for frame in frames:
                yield packet.is_corrupt, frame


def _packets(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.Packet]:
    try:
        yield from container.demux(stream)
    except (av.FFmpegError, OSError):
        return  # the file ends early; what it states was counted before


def _upright(frame: av.VideoFrame, ratio: Fraction | None, orientation: Orientation) -> np.ndarray:
    """The frame in sRGB with square pixels, turned and mirrored as it is shown: [H, W, 3] uint8."""
    image = to_srgb(frame)
    stretch = float(ratio) if ratio else 1.0
    if stretch > 0 and abs(stretch - 1) > 1e-3:
        size = (max(1, round(image.shape[1] * stretch)), image.shape[0])
        image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    return orientation.apply(image)
