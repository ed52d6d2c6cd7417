"""The stream of a video file that is the footage, and how much of it is there.

A container says how many frames it holds, or how long they last, and how many bytes its parts have. A copy or
a recording that was cut off says the same and holds less, and FFmpeg reads it to its end without a word.
"""

from __future__ import annotations

import dataclasses
import os
import struct
from pathlib import Path
from typing import BinaryIO

import av
from av.stream import Disposition
from av.video.stream import VideoStream

from pipeline.errors import UserError

VIDEO_REMEDY = "give a video that FFmpeg can play, or a folder of pictures"
_STILL = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
_STILL_CODECS = ("mjpeg", "png", "bmp", "gif", "tiff", "webp", "apng")
_MISSING = 1.5  # frames that may lack at the end: stated lengths are rounded
_MATROSKA_SEGMENT = b"\x18\x53\x80\x67"


@dataclasses.dataclass(frozen=True)
class StreamContent:
    """The frames that a stream states and those that lie in the file.

    Attributes:
        stamps: the presentation time stamps of the frames that are shown, sorted; the stream's time base.
            Empty where the container has none.
        held: how many frames lie in the file, whole or not.
        stated: how many the container says there are; ``held`` where it does not say or nothing is missing.
    """

    stamps: tuple[int, ...]
    held: int
    stated: int

    @property
    def cut_off(self) -> bool:
        return self.stated > self.held


def open_container(path: Path) -> av.container.InputContainer:
    """The file as FFmpeg's container; UserError where it is none, or has no video stream."""
    if not path.is_file():
        raise UserError(f"{path} is no file but a pipe or a device: {VIDEO_REMEDY}")
    try:
        container = av.open(str(path), metadata_errors="replace")
    except (av.FFmpegError, OSError) as error:
        if _lacks_index(path):
            raise UserError(
                f"{path} is cut off: its index, which the recorder writes last, is missing; copy it again, "
                "or mend it with a program that rebuilds the index"
            ) from None
        raise UserError(f"{path} is not a video ({error.strerror}): {VIDEO_REMEDY}") from None
    if not container.streams.video:
        container.close()
        raise UserError(f"{path} has no video stream: {VIDEO_REMEDY}")
    return container


def footage_stream(path: Path, container: av.container.InputContainer) -> VideoStream:
    """The video stream that is the footage: no cover picture or thumbnail, and FFmpeg's choice of the rest.

    Raises:
        UserError: the file has pictures alone, as a song with a cover has.
    """
    # A damaged header may name a codec that nobody knows.
    known = [one for one in container.streams.video if one.codec_context is not None]
    if not known:
        raise UserError(f"{path} has video of an unknown codec, or a damaged header: {VIDEO_REMEDY}")
    moving = [one for one in known if not one.disposition & _STILL]
    if not moving:
        raise UserError(f"{path} has a cover picture and no video: {VIDEO_REMEDY}")
    # A cover that nobody marked is a picture's codec beside a video's, or one frame beside many.
    filmed = [one for one in moving if one.codec_context.name not in _STILL_CODECS] or moving
    several = [one for one in filmed if one.frames != 1] or filmed
    best = container.streams.best("video")
    return next((one for one in several if best is not None and one.index == best.index), several[0])


def stream_note(container: av.container.InputContainer, stream: VideoStream) -> str:
    """The line on the streams that were left alone; empty where there are none."""
    others = [one for one in container.streams.video if one.index != stream.index]
    if not others:
        return ""
    covers = sum(bool(one.disposition & _STILL) or one.frames == 1 for one in others)
    kinds = f"{len(others)} other video stream(s)" + (f", {covers} of them cover pictures" if covers else "")
    return f"stream {stream.index} ({stream.codec_context.name}) is read; {kinds}, left alone"


def survey_stream(path: Path, container: av.container.InputContainer, stream: VideoStream) -> StreamContent:
    """Counts a stream's frames without decoding them. The container is read to its end."""
    stamps, ends, held = [], [0.0], 0
    base = float(stream.time_base or 0)
    start = float(stream.start_time or 0) * base
    try:
        for packet in container.demux(stream):
            if packet.size == 0 or packet.is_discard:  # the end, or outside of what an edit list shows
                continue
            held += not packet.is_corrupt
            stamp = packet.pts if packet.pts is not None else packet.dts
            if stamp is not None:
                ends.append((stamp + (packet.duration or 0)) * base - start)
            if packet.pts is not None:
                stamps.append(packet.pts)
    except (av.FFmpegError, OSError):
        pass  # where reading ends early; decoding says what is there
    stated = _stated_frames(path, container, stream, held, max(ends))
    return StreamContent(tuple(sorted(stamps)) if len(stamps) >= held else (), held, max(stated, held))


def _stated_frames(
    path: Path, container: av.container.InputContainer, stream: VideoStream, held: int, end: float
) -> int:
    """How many frames the container says there are, where some of them are missing; else ``held``."""
    rate = float(stream.average_rate or stream.guessed_rate or 0)
    length = _stated_seconds(container, stream)
    lacks = (length - end) * rate
    # Edit lists show less than a stream holds, and many recorders round lengths: only both together count.
    counted = stream.frames and held < stream.frames
    by_time = bool(counted and lacks > _MISSING)
    if not by_time and not is_cut_off(path):
        return held
    return max(held + 1, stream.frames, held + round(max(lacks, 0)))


def _stated_seconds(container: av.container.InputContainer, stream: VideoStream) -> float:
    """How long the stream is meant to be, seconds; 0 where nothing says so."""
    if container.format.name == "avi" and stream.frames and stream.average_rate:
        return stream.frames / float(stream.average_rate)  # FFmpeg shortens the duration to what is there
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    tag = stream.metadata.get("DURATION", "")
    try:
        hours, minutes, seconds = (float(part) for part in tag.split(":"))
        return 3600 * hours + 60 * minutes + seconds
    except ValueError:
        return (container.duration or 0) / 1e6


def is_cut_off(path: Path) -> bool:
    """True where a part of an MP4, Matroska or AVI file says that it is longer than the file."""
    try:
        size = os.stat(path).st_size
        with path.open("rb") as file:
            start = file.read(16)
            if start[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot"):
                return _boxes_end(file, size) > size
            if start[:4] == b"\x1a\x45\xdf\xa3":
                return _segment_end(file) > size
            if start[:4] == b"RIFF" and start[8:12] == b"AVI ":
                return _riff_end(file, size) > size
    except (OSError, struct.error):
        return False
    return False


def _boxes_end(file: BinaryIO, size: int) -> int:
    """Where the last of the top-level boxes of an MP4 or QuickTime file says that it ends."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        header = file.read(16)
        length = struct.unpack(">I", header[:4])[0]
        if length == 1 and len(header) == 16:
            length = struct.unpack(">Q", header[8:])[0]
        if length < 8:  # 0: to the end of the file; what else is no box
            return size
        at += length
    return at


def _segment_end(file: BinaryIO) -> int:
    """Where a Matroska file's segment says that it ends; 0 where it does not say, as in live recordings."""
    file.seek(0)
    head = file.read(4096)
    at = head.find(_MATROSKA_SEGMENT)
    if at < 0 or at + 5 > len(head):
        return 0
    first = head[at + 4]
    width = 9 - first.bit_length() if first else 9
    length = int.from_bytes(head[at + 4 : at + 4 + width], "big") & ((1 << (7 * width)) - 1)
    unknown = length == (1 << (7 * width)) - 1
    return 0 if width > 8 or unknown else at + 4 + width + length


def _riff_end(file: BinaryIO, size: int) -> int:
    """Where the last RIFF part of an AVI file says that it ends; 0 where its length was never written."""
    at = 0
    while at + 12 <= size:
        file.seek(at)
        name, length = struct.unpack("<4sI", file.read(8))
        if name != b"RIFF" or length in (0, 0xFFFFFFFF):
            return 0 if at == 0 else at
        at += 8 + length + length % 2
    return at


def _lacks_index(path: Path) -> bool:
    """True for an MP4 or QuickTime file without its ``moov`` box."""
    try:
        size = os.stat(path).st_size
        with path.open("rb") as file:
            at, names = 0, []
            while at + 8 <= size:
                file.seek(at)
                header = file.read(16)
                length, name = struct.unpack(">I4s", header[:8])
                if length == 1 and len(header) == 16:
                    length = struct.unpack(">Q", header[8:])[0]
                names.append(name)
                if length < 8:
                    break
                at += length
    except (OSError, struct.error):
        return False
    return bool(names) and names[0] == b"ftyp" and b"moov" not in names
