"""Curves of an optimisation: values against iterations, and their Parquet file."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.files.tables import read_table, write_table

SCHEMA = pa.schema([("iteration", pa.int32()), ("name", pa.string()), ("value", pa.float32())])

CurvePoints = list[tuple[int, float]]
"""(iteration, value), in the order of the iterations."""


@dataclasses.dataclass
class Curve:
    """Rows of (iteration, name, value), in the order of their making.

    Names are the loss terms as weighted in the objective, each the mean since the row before, and
    whatever else a stage measures: train's ``gaussians``, ``learning_rate`` and ``psnr`` of some held-out
    frames in dB, fit's ``pixels`` of reprojection error.
    """

    rows: list[tuple[int, str, float]] = dataclasses.field(default_factory=list)
    _sums: dict[str, float] = dataclasses.field(default_factory=dict)
    _count: int = 0

    def count(self, terms: dict[str, float]) -> None:
        """Takes in one iteration's loss terms."""
        self._count += 1
        for name, value in terms.items():
            self._sums[name] = self._sums.get(name, 0.0) + value

    def point(self, iteration: int, further: dict[str, float]) -> None:
        """Closes an interval at ``iteration``: the means of the terms, and further values."""
        means = {name: total / self._count for name, total in self._sums.items()}
        self.rows += [(iteration, name, value) for name, value in {**means, **further}.items()]
        self._sums, self._count = {}, 0

    def state(self) -> dict:
        """All of it as JSON values."""
        return {"rows": self.rows, "sums": self._sums, "count": self._count}

    @classmethod
    def restored(cls, state: dict) -> Curve:
        """The curve that ``state`` was taken of."""
        return cls([tuple(row) for row in state["rows"]], dict(state["sums"]), state["count"])

    def write(self, path: Path) -> None:
        """Writes the curve's Parquet file."""
        columns = {
            "iteration": np.array([row[0] for row in self.rows], np.int32),
            "name": np.array([row[1] for row in self.rows], object),
            "value": np.array([row[2] for row in self.rows], np.float32),
        }
        write_table(path, SCHEMA, columns)


def read_curve(path: Path, remedy: str) -> dict[str, CurvePoints]:
    """Name -> line of a curve's file.

    Raises:
        UserError: the file is missing or damaged; the message ends with ``remedy``.
    """
    columns = read_table(path, SCHEMA, remedy)
    lines: dict[str, CurvePoints] = {}
    rows = zip(*(columns[name].tolist() for name in SCHEMA.names), strict=True)
    for iteration, name, value in rows:
        lines.setdefault(name, []).append((iteration, value))
    return lines
