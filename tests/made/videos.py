"""Small real inputs for the ingest tests, made when they run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from stages.ingest.settings import IngestSettings
from tests.made.context import RecordedContext, stage_context


def numbered_images(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """Pictures that a lossy codec leaves recognisable: frame i is grey 10 + 8 i, its top-left corner red."""
    images = []
    for index in range(count):
        image = np.full((height, width, 3), 10 + 8 * index, np.uint8)
        image[: height // 4, : width // 4] = (230, 20, 20)
        images.append(image)
    return images


def write_clip(
    path: Path,
    images: Sequence[np.ndarray],
    ticks: Sequence[int] | None = None,
    ratio: Fraction | None = None,
) -> Path:
    """An H.264 clip of 25 frames a second, or with one time stamp a frame in milliseconds."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", 25, options={"crf": "10", "bf": "0"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        if ticks is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        if ratio is not None:
            stream.codec_context.sample_aspect_ratio = ratio
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            if ticks is not None:
                frame.pts, frame.time_base = ticks[index], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def turn_clip(path: Path, degrees: int) -> None:
    """Write the rotation flag of a phone held sideways: players turn the clip clockwise by ``degrees``."""
    cosine, sine = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    matrix = [cosine, sine, 0, -sine, cosine, 0, 0, 0, 1]
    fixed = [round(value * (1 << 30 if place % 3 == 2 else 1 << 16)) for place, value in enumerate(matrix)]
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4
    assert data[at] == 0, "the track header's long form is not handled here"
    data[at + 40 : at + 76] = b"".join(value.to_bytes(4, "big", signed=True) for value in fixed)
    path.write_bytes(bytes(data))


def write_images(folder: Path, images: Sequence[np.ndarray], names: Sequence[str] | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for index, image in enumerate(images):
        name = names[index] if names else f"{index:04d}.png"
        assert cv2.imwrite(str(folder / name), image[..., ::-1] if image.ndim == 3 else image)
    return folder


def walking_blob(count: int, height: int = 96, width: int = 128) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A textured ellipse crossing a textured wall: frames, and its true masks."""
    rng = np.random.default_rng(3)
    wall = cv2.GaussianBlur(rng.integers(0, 120, (height, width, 3)).astype(np.uint8), (5, 5), 0)
    frames, masks = [], []
    for index in range(count):
        mask = np.zeros((height, width), np.uint8)
        centre = (width // 3 + 3 * index, height // 2)
        cv2.ellipse(mask, centre, (width // 8, height // 3), 0, 0, 360, 255, -1)
        frame = wall.copy()
        frame[mask > 0] = (210, 160, 90)
        frames.append(frame)
        masks.append(mask)
    return frames, masks


def body_points(x: float, y: float, score: float = 0.9) -> list[list[float]]:
    """133 points about (x, y)."""
    return [[x + index % 7, y + index % 5, score] for index in range(133)]


def write_points(folder: Path, numbers: Sequence[int], score: float = 0.9, name: str = "{}.json") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        (folder / name.format(number)).write_text(json.dumps(body_points(40.0 + 3 * number, 44.0, score)))
    return folder


def ingest_context(
    folder: Path, source: Path | None, assets: dict[str, Path] | None = None, **settings: object
) -> RecordedContext:
    """The ingest stage's context with empty scratch folders under ``folder``."""
    wanted = IngestSettings(**settings)  # type: ignore[arg-type]
    output, work = folder / "output", folder / "work"
    return stage_context("ingest", wanted, output, work=work, assets=assets or {}, source=source)
