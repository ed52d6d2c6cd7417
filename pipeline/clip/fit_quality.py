"""The quality of a fit, frame by frame: how far the fitted body lies from the person that was filmed.

Three numbers a frame, none of which depends on the picture's size:

- **reprojection**: the mean error of the trusted keypoints over the person's size, which is the side of a
  square of the mask's area;
- **covered**: the share of the mask that the fitted body covers;
- **outside**: the share of the body's picture that lies outside the mask, of the parts that a keypoint
  was trusted of (legs behind a desk count for nothing).

``fit_quality.parquet`` has one row a frame of the fit: ``frame`` and ``points``, how many keypoints were
trusted (int32), ``size`` and ``error`` in pixels, ``covered`` and ``outside`` (float32), and ``accepted``
(bool). Whoever reads a fitted clip gets its accepted frames only.

Measured on 2026-11-30, on seven subjects whose fits look right: reprojection at most 0.040, covered at least
0.79, outside at most 0.11. A head upside down has 0.22 and covers nothing; a body laid over two hands covers
0.37 to 0.53.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.errors import UserError
from pipeline.files.tables import read_table, write_table

FIT_QUALITY = "fit_quality.parquet"
MOST_REPROJECTION = 0.12  # of the person's size
LEAST_COVERED = 0.55  # of the mask: a wide coat hides a third of what it covers
MOST_OUTSIDE = 0.5  # of the body

SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("points", pa.int32()),
        ("size", pa.float32()),
        ("error", pa.float32()),
        ("covered", pa.float32()),
        ("outside", pa.float32()),
        ("accepted", pa.bool_()),
    ]
)
_REMEDY = "run the fit stage again"


@dataclasses.dataclass(frozen=True)
class FitQuality:
    """The quality of T frames of a fit.

    Attributes:
        frames: [T] int64, frame numbers, increasing.
        points: [T], how many keypoints were trusted.
        size: [T], the square root of the mask's area, pixels; 0 where the mask is empty.
        error: [T], mean reprojection error of the trusted keypoints, pixels; 0 where there are none.
        covered, outside: [T], shares; see the module's docstring.
        accepted: [T] bool, which frames are learnt from and compared with.
    """

    frames: np.ndarray
    points: np.ndarray
    size: np.ndarray
    error: np.ndarray
    covered: np.ndarray
    outside: np.ndarray
    accepted: np.ndarray

    @property
    def reprojection(self) -> np.ndarray:
        """[T], the error over the person's size; 0 where no keypoint was trusted or no mask is."""
        return np.where(self.size > 0, self.error / np.maximum(self.size, 1e-6), 0.0)

    @property
    def passed(self) -> np.ndarray:
        """[T] bool, frames that are within all three limits."""
        near = self.reprojection <= MOST_REPROJECTION
        return near & (self.covered >= LEAST_COVERED) & (self.outside <= MOST_OUTSIDE)

    def of(self, frames: Sequence[int] | np.ndarray) -> FitQuality:
        """The rows of some frames; frames that have none are left out."""
        rows = np.isin(self.frames, np.asarray(frames, np.int64))
        return FitQuality(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    def figures(self) -> str:
        """The three numbers of the median frame, for people."""
        if not len(self.frames):
            return "no frame was fitted"
        middle = [100 * float(np.median(one)) for one in (self.reprojection, self.covered, self.outside)]
        return (
            f"points off by {middle[0]:.1f}% of the size of the person, {middle[1]:.0f}% of the mask "
            f"covered, {middle[2]:.0f}% of the body outside it"
        )


def write_fit_quality(folder: Path, quality: FitQuality) -> None:
    """Write ``fit_quality.parquet`` into the fit's folder."""
    columns = {
        "frame": quality.frames.astype(np.int32),
        "points": quality.points.astype(np.int32),
        "accepted": quality.accepted.astype(bool),
        **{
            name: getattr(quality, name).astype(np.float32)
            for name in ("size", "error", "covered", "outside")
        },
    }
    write_table(folder / FIT_QUALITY, SCHEMA, columns)


def read_fit_quality(folder: Path) -> FitQuality:
    """Read ``fit_quality.parquet`` from the fit's folder.

    Raises:
        UserError: it is missing or malformed, frame numbers do not increase, or no frame is accepted.
    """
    path = folder / FIT_QUALITY
    columns = read_table(path, SCHEMA, _REMEDY)
    frames = columns.pop("frame").astype(np.int64)
    if (np.diff(frames) <= 0).any() or (frames < 0).any():
        raise UserError(f"{path}: its frame numbers do not increase: {_REMEDY}")
    if len(frames) and not columns["accepted"].any():
        raise UserError(f"{path} accepts no frame: {_REMEDY}")
    return FitQuality(frames, **columns)
