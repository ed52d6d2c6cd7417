"""Pictures for people: resized, side by side, on a contact sheet with labels. All are uint8 RGB [H, W, 3]."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

PAPER, INK = 255, (40, 40, 40)


def resized(picture: np.ndarray, height: int, enlarge: int = cv2.INTER_CUBIC) -> np.ndarray:
    """The picture at another height, its proportions kept.

    Args:
        picture: [H, W, 3].
        height: pixels.
        enlarge: OpenCV's interpolation where the picture grows; it shrinks by areas.
    """
    width = max(1, round(picture.shape[1] * height / picture.shape[0]))
    shrinks = height < picture.shape[0]
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else enlarge)


def padded(picture: np.ndarray, width: int, height: int, paper: int = 0) -> np.ndarray:
    """The picture [H, W, 3] in the upper left of one of at least ``width`` x ``height`` pixels."""
    below, right = max(0, height - picture.shape[0]), max(0, width - picture.shape[1])
    return np.pad(picture, ((0, below), (0, right), (0, 0)), constant_values=paper)


def shrunk(picture: np.ndarray, longest: int) -> np.ndarray:
    """The picture with its longer side at most ``longest`` pixels, its proportions kept."""
    share = min(1.0, longest / max(picture.shape[:2]))
    size = tuple(max(1, round(side * share)) for side in picture.shape[1::-1])
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if share < 1 else picture


def caption(text: str, width: int, height: int = 26, size: float = 0.5) -> np.ndarray:
    """A band of paper with a line of text on it, made smaller where it would not fit: [height, width, 3].

    Args:
        text: ASCII.
        width, height: pixels.
        size: of the letters, OpenCV's font scale.
    """
    band = np.full((height, width, 3), PAPER, np.uint8)
    (length, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    size *= min(1.0, max(width - 8, 1) / max(length, 1))
    place = (4, height - round(height / 3))
    cv2.putText(band, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)
    return band


def side_by_side(pictures: Sequence[np.ndarray], gap: int = 0) -> np.ndarray:
    """Pictures of one height in a row, with ``gap`` pixels of paper between them."""
    space = np.full((pictures[0].shape[0], gap, 3), PAPER, np.uint8)
    parts = [part for picture in pictures for part in (picture, space)]
    return np.concatenate(parts[:-1], axis=1)


def contact_sheet(
    pictures: Sequence[np.ndarray],
    columns: int,
    labels: Sequence[str] | None = None,
    paper: int = 0,
    gap: int = 0,
) -> np.ndarray:
    """Pictures in rows of ``columns``.

    Args:
        pictures: at least one; where sizes differ, each lies in the upper left of a cell of the largest.
        columns: of the sheet; what is left of the last row is paper.
        labels: a line above each picture; none if None.
        paper: value of the pixels where no picture is.
        gap: pixels to the right of each picture and below it.

    >>> contact_sheet([np.zeros((20, 30, 3), np.uint8)] * 5, columns=3).shape
    (40, 90, 3)
    """
    cells = list(pictures)
    if labels is not None:
        bands = (caption(label, len(cell[0]), 22, 0.42) for label, cell in zip(labels, cells, strict=True))
        cells = [np.concatenate([band, cell]) for band, cell in zip(bands, cells, strict=True)]
    height, width = (max(cell.shape[side] for cell in cells) + gap for side in (0, 1))
    sheet = np.full((-(-len(cells) // columns) * height, columns * width, 3), paper, np.uint8)
    for place, cell in enumerate(cells):
        top, left = place // columns * height, place % columns * width
        sheet[top : top + cell.shape[0], left : left + cell.shape[1]] = cell
    return sheet
