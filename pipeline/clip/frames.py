"""Frames of a clip: numbered pictures on disk, video that a browser plays, and an even choice of them.

``<folder>/<number:06d>.png`` where the number is the frame's place in the source clip. Frames are RGB
in the clip's own (gamma-encoded) colours; masks are grey, 255 where the pixel is wholly the person's.

Two rules choose frames, because the frames that each has chosen are in published results. They agree on how
many, and differ at the end: ``spread_from_start`` takes the first of each of ``count`` equal parts, and never
the last item; ``spread_end_to_end`` takes both ends and what lies evenly between.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from pipeline.errors import UserError

Item = TypeVar("Item")

_BT709 = 1  # as primaries and as transfer (ISO/IEC 23091-2)


def frame_path(folder: Path, index: int) -> Path:
    """The file of frame or mask number ``index``."""
    return folder / f"{index:06d}.png"


def read_frame(folder: Path, index: int) -> np.ndarray:
    """Frame number ``index``: [H, W, 3] uint8 RGB.

    Raises:
        UserError: the picture is missing or damaged.
    """
    return np.ascontiguousarray(_read(frame_path(folder, index), cv2.IMREAD_COLOR)[..., ::-1])


def read_mask(folder: Path, index: int) -> np.ndarray:
    """The person's alpha in frame number ``index``: [H, W] uint8.

    Raises:
        UserError: the picture is missing or damaged.
    """
    return _read(frame_path(folder, index), cv2.IMREAD_GRAYSCALE)


def write_frame(folder: Path, index: int, image: np.ndarray) -> None:
    """Write a frame, [H, W, 3] uint8 RGB."""
    _check(image, 3)
    write_png(frame_path(folder, index), image)


def write_mask(folder: Path, index: int, mask: np.ndarray) -> None:
    """Write a mask, [H, W] uint8."""
    _check(mask, 2)
    write_png(frame_path(folder, index), mask)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write [H, W, 3] RGB or [H, W] grey, uint8; OSError where the disk refuses."""
    stored = image[..., ::-1] if image.ndim == 3 else image
    # cv2.imwrite swallows a full disk, so the bytes are written here.
    encoded = cv2.imencode(".png", np.ascontiguousarray(stored), [cv2.IMWRITE_PNG_COMPRESSION, 4])[1]
    path.write_bytes(encoded.tobytes())


def write_video(path: Path, images: Iterable[np.ndarray], fps: float) -> None:
    """Write H.264 in MP4, yuv420p, which every browser plays. Equal input gives equal bytes.

    Colours are converted by BT.709's matrix to limited range, and tagged so: without tags players guess.

    Args:
        path: the .mp4 file.
        images: [H, W, 3] uint8 RGB, all of one size; an odd side is padded by one pixel.
        fps: frames a second.

    Raises:
        ValueError: there are no images, or their sizes differ.
    """
    import av  # loads FFmpeg, which readers of stills do without
    from av.video.reformatter import ColorRange, Colorspace

    rate = Fraction(fps).limit_denominator(1001)
    size: tuple[int, ...] = ()
    with av.open(str(path), "w", options={"movflags": "+faststart", "fflags": "+bitexact"}) as container:
        # A fixed thread count: x264 cuts the work, and with it the bytes, by the number of threads. No
        # macroblock tree: x264's AVX-512 code for it reads memory that nobody has written, and equal pictures
        # then give other bytes now and then.
        encoding = {"crf": "18", "preset": "fast", "threads": "2", "x264-params": "mbtree=0"}
        stream = container.add_stream("libx264", rate, options=encoding)
        for image in images:
            if not size:
                size = image.shape
                stream.height, stream.width = size[0] + size[0] % 2, size[1] + size[1] % 2
                stream.pix_fmt = "yuv420p"
                context = stream.codec_context
                context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
                context.color_primaries = context.color_trc = _BT709
            if image.shape != size:
                raise ValueError(f"frames of {size} and {image.shape} cannot share a video")
            even = np.pad(image, ((0, size[0] % 2), (0, size[1] % 2), (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            frame.color_primaries = frame.color_trc = _BT709
            container.mux(stream.encode(frame))
        if not size:
            raise ValueError(f"{path.name}: no frames to write")
        container.mux(stream.encode())


def _read(path: Path, flags: int) -> np.ndarray:
    if not path.is_file():
        raise UserError(f"{path} is missing: run the ingest stage again")
    image = cv2.imdecode(np.fromfile(path, np.uint8), flags) if path.stat().st_size else None
    if image is None:
        raise UserError(f"{path} is not a readable picture: run the ingest stage again")
    return image


def _check(image: np.ndarray, dimensions: int) -> None:
    if image.dtype != np.uint8 or image.ndim != dimensions:
        raise ValueError(f"expected uint8 with {dimensions} dimensions, not {image.dtype} {image.shape}")


def spread_from_start(items: Sequence[Item], count: int) -> tuple[Item, ...]:
    """At most ``count`` of the items, the first of each of as many equal parts; all if there are no more.

    >>> spread_from_start(range(10), 4)
    (0, 2, 5, 7)
    """
    if len(items) <= count:
        return tuple(items)
    return tuple(items[place * len(items) // count] for place in range(count))


def spread_end_to_end(items: Sequence[Item], count: int) -> list[Item]:
    """At most ``count`` of the items, evenly spaced, first and last included; the middle one if count is 1.

    >>> spread_end_to_end(range(10), 4)
    [0, 3, 6, 9]
    """
    if count >= len(items):
        return list(items)
    if count == 1:
        return [items[len(items) // 2]]
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]
