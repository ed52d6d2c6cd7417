"""What a registration's effort buys: error against seconds, for several numbers of steps."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.artifact import RUN
from pipeline.config.request import parse_request
from pipeline.curves import read_curve
from pipeline.errors import UserError
from pipeline.job import open_job
from pipeline.study import made
from pipeline.tables import read_table, vectors

FACTORS = (0.1, 0.25, 0.5, 1.0, 2.0)  # of the study's own number of steps
SEEN = 2  # the state of a true point that the camera sees (stages/ingest/mannequin/truth.py)
TRUTH = pa.schema(
    [("frame", pa.int32()), ("joints", vectors(55 * 3)), ("joint_state", vectors(55, pa.int32()))]
)
ANCHOR = "neck"  # in the picture whatever the framing; bodies are aligned there, frame by frame


@dataclasses.dataclass(frozen=True)
class FitPoint:
    """One registration.

    Attributes:
        steps: ``fit.iterations``.
        seconds: of the registration alone, reading and overlays left out.
        clock: what the seconds are: ``processor`` or ``wall-clock`` (a version from before they were noted).
        pixels: mean distance of trusted keypoints from where they were detected.
        millimetres: mean distance of the joints that the camera sees from the truth, aligned at the neck;
            NaN where no truth is known.
    """

    steps: int
    seconds: float
    clock: str
    pixels: float
    millimetres: float


def fit_steps(own: int) -> tuple[int, ...]:
    """The numbers of steps that are compared, increasing."""
    return tuple(sorted({max(1, round(own * factor)) for factor in FACTORS}))


def fit_point(subject: str, words: Mapping[str, str], steps: int, log: Path) -> FitPoint:
    """Registers with so many steps, unless the store holds it; only ingest and fit are run.

    Raises:
        UserError: a stage stopped.
    """
    job = open_job(subject, parse_request({**words, "fit.iterations": str(steps)}, subject))
    folders = {stage: one.folder for stage, one in made(job, ["fit"], log).items()}
    timings = json.loads((folders["fit"] / RUN).read_text(encoding="utf-8"))["timings"]
    processor = timings.get("registration_cpu_seconds")
    pixels = read_curve(folders["fit"] / "curve.parquet", "run the fit stage again").get("pixels", [])
    return FitPoint(
        steps=steps,
        seconds=processor if processor is not None else timings.get("registration_seconds", math.nan),
        clock="processor" if processor is not None else "wall-clock",
        pixels=pixels[-1][1] if pixels else math.nan,
        millimetres=truth_error(folders["ingest"], folders["fit"], job.workspace.body_file),
    )


def truth_error(ingest: Path, fit: Path, body_file: Path) -> float:
    """Mean distance of the fitted joints from a mannequin's, millimetres; NaN where there is no truth."""
    if not (ingest / "truth_points.parquet").is_file():
        return math.nan
    from pipeline.body import joint_index, load_body, pose_body, read_identity, read_poses

    truth = read_table(ingest / "truth_points.parquet", TRUTH, "run the ingest stage again")
    body, poses = load_body(body_file), read_poses(fit / "poses.parquet")
    identity = read_identity(fit / "identity.safetensors", body)
    _, joints = pose_body(body, identity, poses.rotation, poses.expression, poses.transl)
    rows = {frame: row for row, frame in enumerate(truth["frame"].tolist())}
    order = [rows[frame] for frame in poses.frames if frame in rows]
    if len(order) != len(poses.frames):
        raise UserError(f"{fit / 'poses.parquet'} has frames without truth: run the fit stage again")
    true = truth["joints"].reshape(-1, 55, 3)[order]
    seen = truth["joint_state"][order] == SEEN
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
