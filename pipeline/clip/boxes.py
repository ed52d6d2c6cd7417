"""Rectangles of pixels: the person's box in some masks, and that of a clip's training frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipeline.clip.frames import read_mask
from pipeline.errors import UserError

FAINTEST = 8  # of 255: alpha under this is taken for noise when a clip's box is sought
SMALLEST = 11  # pixels along a side of a clip's box: the window of SSIM, which it is compared with
MARGIN = 8  # pixels around the person


@dataclasses.dataclass(frozen=True)
class Box:
    """A rectangle of pixels: columns left to right - 1, rows top to bottom - 1."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def whole(cls, picture: np.ndarray) -> Box:
        """The box of all pixels of a picture [H, W, ...]."""
        return cls(0, 0, picture.shape[1], picture.shape[0])

    @property
    def width(self) -> int:
        """Pixels."""
        return self.right - self.left

    @property
    def height(self) -> int:
        """Pixels."""
        return self.bottom - self.top

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns, for a picture [H, W, ...]; the box must lie inside."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def widened(self, room: int) -> Box:
        """The box with some pixels more on every side; it may reach out of the picture."""
        return Box(self.left - room, self.top - room, self.right + room, self.bottom + room)

    def clipped(self, width: int, height: int) -> Box:
        """The part of it that lies in a picture."""
        return Box(max(0, self.left), max(0, self.top), min(width, self.right), min(height, self.bottom))


def person_box(
    masks: Iterable[np.ndarray], margin: int = 16, faintest: int = 128, smallest: int = 1
) -> Box | None:
    """The smallest box that holds the person in all of the masks, and a margin; None where nobody is.

    Args:
        masks: [H, W] uint8 each, soft alpha. They may differ in size; the box lies in the largest.
        margin: pixels around the person.
        faintest: the alpha from which a pixel is the person's, of 255.
        smallest: pixels along each side of the box; the picture must have as many.

    >>> mask = np.zeros((100, 80), np.uint8)
    >>> mask[40:60, 30:50] = 255
    >>> person_box([mask], margin=5)
    Box(left=25, top=35, right=55, bottom=65)
    """
    columns, rows = np.zeros(0, bool), np.zeros(0, bool)
    for mask in masks:
        person = np.asarray(mask >= faintest)
        columns, rows = _either(columns, np.any(person, axis=0)), _either(rows, np.any(person, axis=1))
    if not columns.any():
        return None
    left, right = _extent(columns, margin, smallest)
    top, bottom = _extent(rows, margin, smallest)
    return Box(left, top, right, bottom)


def clip_box(folder: Path, frames: tuple[int, ...], margin: int) -> Box:
    """The person's box in all the given frames of a clip: what training looks at.

    Args:
        folder: what ingest published.
        frames: their numbers.
        margin: pixels around the person.

    Raises:
        UserError: no mask shows anybody, or the frames are smaller than SSIM's window.
    """
    masks = (read_mask(folder / "masks", frame) for frame in frames)
    box = person_box(masks, margin, FAINTEST, SMALLEST)
    if box is None:
        raise UserError(f"{folder / 'masks'} shows nobody in the training frames; check the footage")
    if min(box.width, box.height) < SMALLEST:
        raise UserError(f"{folder / 'frames'}: frames must be at least {SMALLEST} pixels wide and high")
    return box


def _either(known: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Marks of frames that may differ in size."""
    if len(known) < len(new):
        known, new = new, known
    return known | np.pad(new, (0, len(known) - len(new)))


def _extent(marks: np.ndarray, margin: int, smallest: int) -> tuple[int, int]:
    inside = np.flatnonzero(marks)
    first, last = max(0, int(inside[0]) - margin), min(len(marks), int(inside[-1]) + 1 + margin)
    if last - first < smallest:
        first = max(0, min(first, len(marks) - smallest))
        last = min(len(marks), first + smallest)
    return first, last
