"""MediaPipe's person detector: everybody in a picture, however small they stand in it.

The detector sees 224 pixels, so that it overlooks whoever is small in the picture and sets one person between
two. It is therefore shown the whole picture and squares of it that overlap by half.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.detection.mediapipe import BLANK, load_mediapipe, native_errors_to

_GRAPH = """
input_stream: "image"
output_stream: "detections"
node { calculator: "PoseDetectionCpu" input_stream: "IMAGE:image" output_stream: "DETECTIONS:detections" }
"""
SEEN_SIDE = 448  # pixels; a larger picture shows the detector no more
_ONE = 0.35  # detections nearer than this, in the larger one's radius, are one person
_CUT = 0.35  # of the radius: torsos nearer than this to a square's edge are cut
_BINS, _LEAST_PIXELS = 16, 12  # of a colour histogram: bins of lightness; pixels across a torso


@dataclasses.dataclass(frozen=True)
class Person:
    """One detection, in pixels.

    Attributes:
        hips: [2], the middle of the hips; may lie outside the picture.
        shoulders: [2], the middle of the shoulders.
        radius: of the circle about the hips that holds the whole body.
        score: in [0, 1].
        colors: [K] histogram of the torso's colours, adds up to 1; None where it is not in the picture.
        change: how much this part of the picture changed since the frame that was searched before, grey
            levels, beyond moving as a whole; None where nobody looked.
    """

    hips: np.ndarray
    shoulders: np.ndarray
    radius: float
    score: float
    colors: np.ndarray | None = None
    change: float | None = None


class PersonDetector:
    """Finds every person in a picture and follows nobody."""

    def __init__(self, asset: Path, native_log: Path) -> None:
        """Load it; arguments and errors as those of :class:`pipeline.detection.mediapipe.Estimator`."""
        load_mediapipe(asset)
        self._native_log = native_log
        from google.protobuf import text_format

        base = importlib.import_module("mediapipe.python.solution_base")
        messages = importlib.import_module("mediapipe.framework.calculator_pb2")
        graph = text_format.Parse(_GRAPH, messages.CalculatorGraphConfig())
        with native_errors_to(native_log):
            self._graph = base.SolutionBase(graph_config=graph, outputs=["detections"])
            self._graph.process(BLANK)

    def detect(self, image: np.ndarray) -> list[Person]:
        """The people in ``image`` [H, W, 3] uint8 RGB; coordinates in its pixels."""
        found = []
        for left, top, side in [(0, 0, max(image.shape[:2])), *squares(*image.shape[1::-1])]:
            part = np.ascontiguousarray(image[top : top + side, left : left + side])
            scale = min(1.0, SEEN_SIDE / max(part.shape[:2]))
            small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            inside = self._detect(small, np.array([left, top]), 1 / scale)
            edges = inner_edges((left, top, side), *image.shape[1::-1])
            found += [one for one in inside if not is_cut(one, edges)]
        return [dataclasses.replace(one, colors=torso_colors(image, one)) for one in distinct(found)]

    def _detect(self, image: np.ndarray, corner: np.ndarray, scale: float) -> list[Person]:
        height, width = image.shape[:2]
        with native_errors_to(self._native_log):
            found = self._graph.process(image).detections or []
        people = []
        for detection in found:
            points = [(p.x * width, p.y * height) for p in detection.location_data.relative_keypoints]
            hips, rim, shoulders = (corner + scale * np.array(point) for point in points[:3])
            radius = float(np.linalg.norm(rim - hips))
            people.append(Person(hips, shoulders, radius, float(detection.score[0])))
        return people


def squares(width: int, height: int) -> list[tuple[int, int, int]]:
    """Left, top and side of squares that cover an oblong picture, overlapping by half; else none."""
    side, length = min(width, height), max(width, height)
    if length < 1.2 * side:
        return []
    starts = np.linspace(0, length - side, 1 + int(np.ceil((length - side) / (side / 2)))).astype(int)
    return [(int(at), 0, side) if width > height else (0, int(at), side) for at in starts]


def inner_edges(square: tuple[int, int, int], width: int, height: int) -> np.ndarray:
    """Where a square (left, top, side) cuts the picture: least x and y, greatest x and y, [2, 2].

    Infinite where its edge is the picture's own, or lies outside.
    """
    left, top, side = square
    low = [left if left > 0 else -np.inf, top if top > 0 else -np.inf]
    high = [left + side if left + side < width else np.inf, top + side if top + side < height else np.inf]
    return np.array([low, high])


def is_cut(person: Person, edges: np.ndarray) -> bool:
    """Whether hips or shoulders lie so near an edge of ``inner_edges`` that the square shows half a body.

    Of somebody's arm at such an edge the detector makes a person, who stands on the head. The squares overlap
    by half, so that another, or the whole picture, shows whoever is cut.
    """
    points = np.stack([person.hips, person.shoulders])
    return bool((np.minimum(points - edges[0], edges[1] - points) < _CUT * person.radius).any())


def distinct(found: Sequence[Person]) -> list[Person]:
    """Detections of one person each, the best scored first."""
    kept: list[Person] = []
    for one in sorted(found, key=lambda person: -person.score):
        apart = [np.linalg.norm(one.shoulders - k.shoulders) / max(one.radius, k.radius) for k in kept]
        if all(distance > _ONE for distance in apart):
            kept.append(one)
    return kept


def torso_colors(image: np.ndarray, person: Person) -> np.ndarray | None:
    """The histogram of the colours between shoulders and hips; None where too little is in the picture.

    Lightness counts in its own bins beside those of the two colour axes, so that light and shade change
    less of it. Halves of one track overlap by 0.87 to 0.97, a woman and a man in the same light by 0.54.
    """
    middle, half = (person.shoulders + person.hips) / 2, 0.1 * person.radius
    reach = max(half, 0.4 * float(np.linalg.norm(person.hips - person.shoulders)))
    low = np.clip(np.round(middle - [half, reach]), 0, image.shape[1::-1]).astype(int)
    high = np.clip(np.round(middle + [half, reach]), 0, image.shape[1::-1]).astype(int)
    if (high - low < _LEAST_PIXELS).any():
        return None
    patch = cv2.cvtColor(image[low[1] : high[1], low[0] : high[0]], cv2.COLOR_RGB2LAB).reshape(-1, 3)
    light = np.histogram(patch[:, 0], _BINS, (0, 256))[0]
    chroma = np.histogram2d(patch[:, 1], patch[:, 2], 2 * _BINS, ((64, 192), (64, 192)))[0].ravel()
    counts = np.concatenate([light, chroma]).astype(np.float64)
    return counts / max(counts.sum(), 1)


def change_since(before: np.ndarray, now: np.ndarray, person: Person) -> float | None:
    """How much a person's part of the picture changed, beyond moving as a whole, grey levels.

    Args:
        before, now: pictures of one size, [H, W] uint8.
        person: in the later one.

    Returns:
        The mean absolute difference after the shift that aligns them best; None outside the picture.
    """
    size = np.array(now.shape[::-1])
    centre, half = (person.shoulders + person.hips) / 2, 0.8 * person.radius
    low = np.clip(np.round(centre - half), 0, size).astype(int)
    high = np.clip(np.round(centre + half), 0, size).astype(int)
    if (high - low < _LEAST_PIXELS).any():
        return None
    parts = [
        cv2.resize(one[low[1] : high[1], low[0] : high[0]], (64, 64), interpolation=cv2.INTER_AREA)
        for one in (before, now)
    ]
    first, second = (part.astype(np.float32) for part in parts)
    (x, y), _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow((64, 64), cv2.CV_32F))
    if max(abs(x), abs(y)) > 12:  # no such shift between two looks at one thing
        x = y = 0.0
    rows, columns = np.mgrid[0:64, 0:64].astype(np.float32)
    where = (columns - np.float32(x), rows - np.float32(y))
    moved = cv2.remap(first, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inner = slice(12, 52)
    return float(np.abs(moved - second)[inner, inner].mean())
