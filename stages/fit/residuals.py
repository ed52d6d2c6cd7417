"""How far the fitted landmarks are from their detections, and the table that says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from pipeline.tables import write_table
from stages.fit.observations import GROUPS, Observations

SCHEMA = pa.schema(
    [("frame", pa.int32()), ("group", pa.string()), ("pixels", pa.float32()), ("points", pa.int32())]
)


def group_means(error: Tensor, observations: Observations) -> dict[str, float]:
    """Mean error over the clip of each group that was seen, pixels.

    Args:
        error: [T, N], pixels, NaN where masked.
        observations: whose points they are.
    """
    means = {name: error[:, observations.of(name)].nanmean() for name in GROUPS}
    return {name: float(mean) for name, mean in means.items() if torch.isfinite(mean)}


def write_residuals(path: Path, error: Tensor, observations: Observations) -> None:
    """Write ``residuals.parquet``: frame, group, mean pixels, number of points; unseen groups have no row.

    Args:
        path: the file.
        error: [T, N], pixels, NaN where masked.
        observations: whose points they are.
    """
    frames, groups, pixels, points = [], [], [], []
    for row, frame in enumerate(observations.frames.tolist()):
        for name in GROUPS:
            seen = error[row, observations.of(name)]
            seen = seen[~seen.isnan()]
            if len(seen):
                frames.append(frame)
                groups.append(name)
                pixels.append(float(seen.mean()))
                points.append(len(seen))
    columns = {"frame": np.array(frames, np.int32), "group": np.array(groups, dtype=object)}
    columns |= {"pixels": np.array(pixels, np.float32), "points": np.array(points, np.int32)}
    write_table(path, SCHEMA, columns)
