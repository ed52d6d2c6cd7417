"""Where the person is in a clip: the box of all masks, which is what training looks at."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from pipeline.frames import read_mask

FAINTEST = 8  # of 255: alpha under this is taken for noise when the person's box is sought
WINDOW = 11  # pixels: a box is at least as large as SSIM's window
MARGIN = 8  # pixels around the person


@dataclasses.dataclass(frozen=True)
class Box:
    """A rectangle of pixels: columns left to right - 1, rows top to bottom - 1."""

    left: int
    top: int
    right: int
    bottom: int


def person_box(folder: Path, frames: tuple[int, ...], margin: int) -> Box:
    """The smallest box that holds the person in all the given frames, and a margin.

    It is at least as large as SSIM's window.

    Raises:
        UserError: if no mask shows anybody, or the frames are smaller than SSIM's window.
    """
    columns, rows = np.zeros(0, bool), np.zeros(0, bool)
    for frame in frames:
        person = np.asarray(read_mask(folder / "masks", frame) >= FAINTEST)
        columns = _either(columns, np.any(person, axis=0))
        rows = _either(rows, np.any(person, axis=1))
    if not columns.any():
        raise UserError(f"{folder / 'masks'} shows nobody in the training frames; check the footage")
    if min(len(columns), len(rows)) < WINDOW:
        raise UserError(f"{folder / 'frames'}: frames must be at least {WINDOW} pixels wide and high")
    left, right = _extent(columns, margin)
    top, bottom = _extent(rows, margin)
    return Box(left, top, right, bottom)


def _either(known: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Marks of frames that may differ in size."""
    if len(known) < len(new):
        known, new = new, known
    return known | np.pad(new, (0, len(known) - len(new)))


def _extent(marks: np.ndarray, margin: int) -> tuple[int, int]:
    inside = np.flatnonzero(marks)
    first, last = max(0, int(inside[0]) - margin), min(len(marks), int(inside[-1]) + 1 + margin)
    if last - first < WINDOW:
        first = max(0, min(first, len(marks) - WINDOW))
        last = first + WINDOW
    return first, last
