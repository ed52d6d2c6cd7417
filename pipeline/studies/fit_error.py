"""What a registration's effort buys: error against seconds, for several numbers of steps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from pipeline.body import joint_index, pose_body
from pipeline.clip.curves import read_curve
from pipeline.clip.fitted_clip import read_fitted_clip
from pipeline.errors import UserError
from pipeline.files.tables import read_table, vectors
from pipeline.studies.variants import Result, run_record

FACTORS = (0.1, 0.25, 0.5, 1.0, 2.0)  # of the base's own number of steps
SEEN = 2  # the state of a true point that the camera sees (stages/ingest/mannequin/truth.py)
TRUTH = pa.schema(
    [("frame", pa.int32()), ("joints", vectors(55 * 3)), ("joint_state", vectors(55, pa.int32()))]
)
ANCHOR = "neck"  # in the picture whatever the framing; bodies are aligned there, frame by frame


def fit_numbers(result: Result, body_file: Path) -> dict[str, float]:
    """The time and error of one registration.

    Returns:
        ``seconds``, processor seconds of the registration alone; ``pixels``, the mean distance of trusted
        keypoints from where they were detected; ``millimetres``, the mean distance of the joints that the
        camera sees from the truth, aligned at the neck, NaN where no truth is known.
    """
    ingest, fit = result.folders["ingest"], result.folders["fit"]
    pixels = read_curve(fit / "curve.parquet", "run the fit stage again").get("pixels", [])
    return {
        "seconds": run_record(fit)["timings"]["registration_cpu_seconds"],
        "pixels": pixels[-1][1] if pixels else math.nan,
        "millimetres": truth_error(ingest, fit, body_file),
    }


def truth_error(ingest: Path, fit: Path, body_file: Path) -> float:
    """Mean distance of the fitted joints from a mannequin's, millimetres; NaN where there is no truth."""
    if not (ingest / "truth_points.parquet").is_file():
        return math.nan
    truth = read_table(ingest / "truth_points.parquet", TRUTH, "run the ingest stage again")
    clip = read_fitted_clip(ingest, fit, body_file)
    poses = clip.poses
    _, joints = pose_body(clip.body, clip.identity, poses.rotation, poses.expression, poses.transl)
    rows = pd.Index(truth["frame"]).get_indexer(list(poses.frames))
    if (rows < 0).any():
        raise UserError(f"{fit / 'poses.parquet'} has frames without truth: run the fit stage again")
    seen = truth["joint_state"][rows] == SEEN
    true = truth["joints"].reshape(-1, 55, 3)[rows]
    return 1e3 * aligned_error(joints.numpy(), true, seen, joint_index(ANCHOR))


def aligned_error(joints: np.ndarray, true: np.ndarray, seen: np.ndarray, anchor: int) -> float:
    """The mean distance of seen joints once both bodies have their ``anchor`` in one place.

    Args:
        joints, true: [T, 55, 3], metres.
        seen: [T, 55] bool.
        anchor: a joint's row.

    Returns:
        Metres; NaN where nothing is seen.
    """
    away = (joints - joints[:, anchor, None]) - (true - true[:, anchor, None])
    distances = np.linalg.norm(away, axis=-1)[seen]
    return float(distances.mean()) if len(distances) else math.nan
