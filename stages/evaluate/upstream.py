"""The upstream stages' own records, as the report shows them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.errors import UserError
from pipeline.files.tables import read_table
from pipeline.store.artifact import MANIFEST, RUN
from pipeline.untrusted import parse_json

VISIBILITY = pa.schema([("captured", pa.float32()), ("kept", pa.bool_())])
"""The columns of train's visibility.parquet that are read: each body vertex's score, and whether it carries
a Gaussian."""


RESIDUALS = pa.schema([("pixels", pa.float32())])
"""The column of fit's residuals.parquet that is read."""


@dataclasses.dataclass(frozen=True)
class StageRecord:
    """A stage's record of the run that made its result.

    Attributes:
        name: the stage's.
        settings: as it ran.
        seconds: wall clock; None where the run was not recorded.
        memory: peak of the process, MiB; None likewise.
        version: of the stage; None where its manifest does not say.
        made: when, and with what: host and Python; empty where not recorded.
    """

    name: str
    settings: Mapping[str, Any]
    seconds: float | None
    memory: float | None = None
    version: int | None = None
    made: str = ""


@dataclasses.dataclass(frozen=True)
class GateRecord:
    """The part of the body that is modelled, as the visibility gate left it.

    Attributes:
        kept: body vertices that carry Gaussians.
        vertices: body vertices in all.
        scores: [V], how often each of them is in a captured frame.
        tau: the threshold of their score under which the gate takes them; 0 where it is open.
        why: the gate's own sentence.
        definition: what counted as seen; None where nothing was counted.
    """

    kept: int
    vertices: int
    scores: np.ndarray
    tau: float
    why: str
    definition: str | None


def stage_records(inputs: Mapping[str, Path]) -> list[StageRecord]:
    """The upstream stages' settings and times, from the records beside what they published.

    These are for display only: where one is missing or damaged the report says so and goes on.
    """
    records = []
    for name, folder in inputs.items():
        manifest, run = _read(folder / MANIFEST), _read(folder / RUN)
        settings, version = manifest.get("settings"), manifest.get("version")
        record = StageRecord(
            name=name,
            settings=settings if isinstance(settings, dict) else {},
            seconds=_number(run.get("seconds")),
            memory=_number(run.get("peak_memory_mib")),
            version=version if isinstance(version, int) else None,
            made=", ".join(str(run[key]) for key in ("finished", "host") if isinstance(run.get(key), str)),
        )
        records.append(record)
    return records


def trained_representation(records: Sequence[StageRecord]) -> str | None:
    """The representation that train was asked for, ``triplane`` or ``bases``; None where not recorded."""
    named = [record.settings.get("representation") for record in records if record.name == "train"]
    return named[0] if named and isinstance(named[0], str) else None


def fit_seconds(fit: Path) -> dict[int, float]:
    """Seconds since the registration began at the iterations of fit's curve; empty where not recorded."""
    timings = _read(fit / RUN).get("timings")
    recorded = timings.get("curve_seconds") if isinstance(timings, dict) else None
    rows = recorded if isinstance(recorded, list) else []
    pairs = [row for row in rows if isinstance(row, list) and len(row) == 2]
    return {step: float(at) for step, at in pairs if isinstance(step, int) and isinstance(at, int | float)}


def read_gate(train: Path) -> GateRecord:
    """Reads train's ``visibility.parquet`` and ``gate.json``.

    Raises:
        UserError: a file is missing or damaged.
    """
    remedy = "run the train stage again"
    table = read_table(train / "visibility.parquet", VISIBILITY, remedy)
    found = parse_json(train / "gate.json", remedy)
    if not isinstance(found, dict) or not {"tau", "why", "definition"} <= set(found):
        raise UserError(f"{train / 'gate.json'} has no threshold: {remedy}")
    kept = table["kept"]
    return GateRecord(
        int(kept.sum()), len(kept), table["captured"], float(found["tau"]), found["why"], found["definition"]
    )


def fit_error(fit: Path) -> float | None:
    """The mean reprojection error of the fit on trusted keypoints, pixels; None where there is none.

    Raises:
        UserError: the table is missing or damaged.
    """
    pixels = read_table(fit / "residuals.parquet", RESIDUALS, "run the fit stage again")["pixels"]
    return float(pixels.mean()) if len(pixels) else None


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _read(path: Path) -> dict[str, Any]:
    try:
        content = parse_json(path, "")
    except UserError:
        return {}
    return content if isinstance(content, dict) else {}
