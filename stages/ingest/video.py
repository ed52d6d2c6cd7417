"""Footage of any kind as a stream of upright RGB pictures with square pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from pipeline.clip.frame_files import ClipFrames, visible_files
from pipeline.errors import UserError
from pipeline.untrusted import GIGABYTE, bounded_bytes, check_picture
from stages.ingest.display_matrix import Orientation
from stages.ingest.video_file import VideoFile, cut_note, open_video, read_video

SKIP = "ingest.damaged=skip"
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


@dataclasses.dataclass(frozen=True)
class Clip:
    """A video file or a folder of pictures.

    Attributes:
        path: the file or the folder.
        width, height: pixels, upright and with square pixels.
        fps: frames a second on average; 0 where there is no clock.
        expected: how many frames the source says it has; 0 where it does not say.
        pictures: frame number -> file, for a folder; empty for a video.
        orientation: how a video's frames are turned and mirrored before they are shown.
        video: how the file is read, for a video; None for a folder.
        first: the number of a video's first frame.
    """

    path: Path
    width: int
    height: int
    fps: float
    expected: int
    pictures: dict[int, Path] = dataclasses.field(default_factory=dict)
    orientation: Orientation = Orientation()
    video: VideoFile | None = None
    first: int = 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What is done with a video's frames, and what is missing; a line each."""
        return self.video.notes if self.video else ()


@dataclasses.dataclass(frozen=True)
class SourceFrame:
    """One frame of a clip.

    Attributes:
        index: the frame's number: its place in the order in which frames are shown, or the number that names
            a picture.
        seconds: its time from the clip's first frame; with no clock, its place.
        image: [H, W, 3] uint8 RGB, upright; black where the frame is damaged.
        damaged: whether the frame cannot be read, or only with errors.
    """

    index: int
    seconds: float
    image: np.ndarray
    damaged: bool = False


def open_clip(path: Path) -> Clip:
    """Look at the first frames of a source.

    Raises:
        UserError: nothing there, no video stream, no frame, or no readable picture.
    """
    if path.is_dir():
        return _open_folder(path)
    if not path.exists():
        raise UserError(f"{path} does not exist: give a video file or a folder of pictures")
    video = open_video(path)
    size = (video.width, video.height)
    return Clip(path, *size, video.fps, video.expected, orientation=video.orientation, video=video)


def read_clip(
    clip: Clip, stride: int = 1, limit: int = 0, damaged: Literal["refuse", "skip"] = "refuse"
) -> Iterator[SourceFrame]:
    """Every ``stride``-th frame in order, at most ``limit`` of them (0: all), one in memory at a time.

    Times are a video's own time stamps, so a variable frame rate needs no resampling.

    Args:
        damaged: ``refuse`` raises where a frame is damaged, and before the first one where a file is cut off
            and all of it is asked for; ``skip`` yields damaged frames marked as such.

    Raises:
        UserError: a frame is damaged, or its size differs from the first one's.
    """
    content = clip.video.content if clip.video else None
    if content and content.cut_off and damaged == "refuse":
        if not limit or stride * limit > content.held:
            raise UserError(f"{clip.path} {cut_note(content)}; copy it again, or take what is whole: {SKIP}")
    frames = _read_folder(clip, stride, damaged) if clip.pictures else _read_video(clip, stride)
    for count, picture in enumerate(frames):
        if limit and count == limit:
            return
        if picture.damaged and damaged == "refuse":
            place = clip.pictures.get(picture.index, f"{clip.path}: frame {picture.index}")
            raise UserError(f"{place} is damaged: replace it, or leave out what is damaged: {SKIP}")
        if picture.image.shape[:2] != (clip.height, clip.width):
            height, width = picture.image.shape[:2]
            place = clip.pictures.get(picture.index, f"{clip.path}, frame {picture.index},")
            raise UserError(
                f"{place} is {width}x{height}, the first frame {clip.width}x{clip.height}: make all one size"
            )
        yield picture


def missing_frames(clip: Clip, stride: int = 1) -> set[int]:
    """The numbers of the frames that a video's container states and that are missing, every ``stride``-th."""
    content = clip.video.content if clip.video else None
    places = range(content.held, content.stated) if content else ()
    return {clip.first + place for place in places if place % stride == 0}


def _read_video(clip: Clip, stride: int) -> Iterator[SourceFrame]:
    assert clip.video is not None
    nothing = np.zeros((clip.height, clip.width, 3), np.uint8)
    for place, seconds, image in read_video(clip.video, stride):
        yield SourceFrame(clip.first + place, seconds, nothing if image is None else image, image is None)


def _open_folder(path: Path) -> Clip:
    files = visible_files(path, PICTURES)
    if not files:
        below = [one.name for one in sorted(path.iterdir()) if one.is_dir() and visible_files(one, PICTURES)]
        remedy = f"give a folder of frames, such as its {below[0]}/" if below else "give a folder of frames"
        raise UserError(f"{path} holds no pictures ({', '.join(PICTURES)}): {remedy}")
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
    remedy = f"replace it, take it out of the folder, or leave it out: {SKIP}"
    data = np.frombuffer(bounded_bytes(path, GIGABYTE, remedy), np.uint8)
    check_picture(path, remedy, data.tobytes())
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{path} is not a readable picture: {remedy}")
    return np.ascontiguousarray(image[..., ::-1])


def _read_folder(clip: Clip, stride: int, damaged: str) -> Iterator[SourceFrame]:
    begin = next(iter(clip.pictures))
    for place, (index, file) in enumerate(clip.pictures.items()):
        if place % stride == 0:
            seconds = (index - begin) / clip.fps if clip.fps else float(place)
            try:
                picture = read_picture(file)
            except UserError:
                if damaged == "refuse":
                    raise
                nothing = np.zeros((clip.height, clip.width, 3), np.uint8)
                yield SourceFrame(index, seconds, nothing, damaged=True)
                continue
            yield SourceFrame(index, seconds, picture)
