"""Pictures for people: truth beside render beside error, and the report's cover."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from pipeline.boxes import Box
from pipeline.composite import to_bytes
from pipeline.pictures import caption, side_by_side

CLOSEUP = 160  # pixels
GAP = 6  # pixels between pictures


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One frame as it was and as the avatar shows it.

    Attributes:
        frame: number in the source clip.
        truth: [H, W, 3] uint8 RGB, the person on what is scored.
        render: [H, W, 3] uint8 RGB.
        error: [H, W, 3] uint8 RGB, the absolute difference times the gain.
        psnr: dB, of the whole image.
    """

    frame: int
    truth: np.ndarray
    render: np.ndarray
    error: np.ndarray
    psnr: float

    @property
    def pictures(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Truth, render, error: the order in which they are shown."""
        return self.truth, self.render, self.error

    def cropped(self, box: Box) -> Comparison:
        """The same comparison inside a box."""
        truth, render, error = (picture[box.slices] for picture in self.pictures)
        return dataclasses.replace(self, truth=truth, render=render, error=error)


@dataclasses.dataclass(frozen=True)
class Closeup:
    """A face or a hand of one frame, enlarged.

    Attributes:
        region: ``face`` or ``hands``.
        comparison: truth, render and error of it.
    """

    region: str
    comparison: Comparison


def closeups(whole: Comparison, boxes: Mapping[str, Sequence[Box]]) -> list[Closeup]:
    """The crops of a comparison of whole pictures, each ``CLOSEUP`` pixels high or more.

    Enlarged so that each pixel stays a square: what is blurred is the render, not the page.
    """
    found = []
    for region, each in boxes.items():
        for box in each:
            part = whole.cropped(box)
            factor = max(1, -(-CLOSEUP // part.truth.shape[0]))
            truth, render, error = (
                np.kron(one, np.ones((factor, factor, 1), np.uint8)) for one in part.pictures
            )
            found.append(Closeup(region, dataclasses.replace(part, truth=truth, render=render, error=error)))
    return found


def compare(frame: int, truth: Tensor, render: Tensor, gain: float, psnr: float) -> Comparison:
    """Sets a render beside the truth; both [H, W, 3] float in [0, 1]."""
    error = ((render - truth).abs() * gain).clamp(0, 1)
    return Comparison(frame, to_bytes(truth), to_bytes(render), to_bytes(error), psnr)


def comparison_sheet(comparisons: Sequence[Comparison], gain: float) -> np.ndarray:
    """``comparison.png``: a row a frame; ground truth, render, error. [H, W, 3] uint8 RGB."""
    width = comparisons[0].truth.shape[1]
    titles = ("ground truth", "render", f"error x{gain:g}")
    sheet = [side_by_side([caption(title, width) for title in titles], GAP)]
    for one in comparisons:
        row = side_by_side(one.pictures, GAP)
        sheet += [row, caption(f"frame {one.frame}, {one.psnr:.2f} dB", row.shape[1])]
    return np.concatenate(sheet)
