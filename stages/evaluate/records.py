"""What the report shows of the upstream stages' own records."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.artifact import MANIFEST, RUN
from pipeline.errors import UserError
from pipeline.records import read_json
from pipeline.tables import read_table

VISIBILITY = pa.schema([("kept", pa.bool_())])
"""The one column of train's visibility.parquet that is read: whether a body vertex carries a Gaussian."""


@dataclasses.dataclass(frozen=True)
class StageRecord:
    """What a stage says of the run that made its result.

    Attributes:
        name: the stage's.
        settings: as it ran.
        seconds: wall clock; None where the run was not recorded.
    """

    name: str
    settings: Mapping[str, Any]
    seconds: float | None


@dataclasses.dataclass(frozen=True)
class Gate:
    """How much of the body is modelled.

    Attributes:
        kept: body vertices that carry Gaussians.
        vertices: body vertices in all.
    """

    kept: int
    vertices: int


def stage_records(inputs: Mapping[str, Path]) -> list[StageRecord]:
    """The upstream stages' settings and times, from the records beside what they published.

    These are for display only: where one is missing or damaged the report says so and goes on.
    """
    records = []
    for name, folder in inputs.items():
        settings = _read(folder / MANIFEST).get("settings")
        seconds = _read(folder / RUN).get("seconds")
        record = StageRecord(
            name=name,
            settings=settings if isinstance(settings, dict) else {},
            seconds=float(seconds) if isinstance(seconds, int | float) else None,
        )
        records.append(record)
    return records


def fit_seconds(fit: Path) -> dict[int, float]:
    """Seconds since the registration began at the iterations of fit's curve; empty where not recorded."""
    timings = _read(fit / RUN).get("timings")
    recorded = timings.get("curve_seconds") if isinstance(timings, dict) else None
    rows = recorded if isinstance(recorded, list) else []
    pairs = [row for row in rows if isinstance(row, list) and len(row) == 2]
    return {step: float(at) for step, at in pairs if isinstance(step, int) and isinstance(at, int | float)}


def read_gate(path: Path) -> Gate:
    """How many of the body's vertices train's ``visibility.parquet`` kept.

    Raises:
        UserError: the file is missing or damaged.
    """
    kept = read_table(path, VISIBILITY, "run the train stage again")["kept"]
    return Gate(int(kept.sum()), len(kept))


def _read(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path, "")
    except UserError:
        return {}
    return content if isinstance(content, dict) else {}
