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
    [("frame", pa.int32()), ("group", pa.string()), ("point", pa.int32()), ("pixels", pa.float32())]
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
    """Write ``residuals.parquet``, a row a keypoint that was trusted in a frame.

    Columns: ``frame``; ``group`` and ``point``, the keypoint as the number that its source gives it within
    the group; ``pixels``, its reprojection error. Masked keypoints have no row.

    Args:
        path: the file.
        error: [T, N], pixels, NaN where masked.
        observations: whose points they are.
    """
    group = observations.group.numpy()
    within = np.zeros(len(group), np.int32)
    for number in range(len(GROUPS)):
        within[group == number] = np.arange((group == number).sum())
    rows, points = np.nonzero(~np.isnan(error.numpy()))
    columns = {
        "frame": observations.frames.numpy()[rows].astype(np.int32),
        "group": np.array(GROUPS, dtype=object)[group[points]],
        "point": within[points],
        "pixels": error.numpy()[rows, points],
    }
    write_table(path, SCHEMA, columns)
