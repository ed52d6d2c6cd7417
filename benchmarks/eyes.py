"""The error of fitted lids and gaze against mannequins that blink and look around.

Holds: docs/results.md, "Eyes". Heads and upper bodies are filmed with known truth and fitted as the fit
stage does, its smoothing included. Points come from the simulated detector, whose errors are MediaPipe's as
measured, or with ``--mediapipe`` from MediaPipe itself on the mannequin's pictures.

- opening: the eye's opening over its width, as a share of that of the true eye at rest; the mean absolute
  error over all frames and eyes;
- in blinks: the opening that was fitted where the true eye is shut (under a tenth), a share again;
- gaze: the angle between fitted and true gaze in the head's axes, degrees, where the true eye is half open
  at least. ``still`` is the error of eyes that always look ahead.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from torch import Tensor

from benchmarks import frame
from benchmarks.fit_truth import Stage, load_stage
from pipeline.body import BodyModel, Identity, PointSet, Poses, rest_joints, rest_vertices
from pipeline.body.eyes import CORNERS, lid_openings
from pipeline.body.landmarks import locate
from pipeline.clip.clock import times_of_numbers
from pipeline.clip.keypoints import Keypoints
from pipeline.config.workspace import open_workspace
from pipeline.detection.mediapipe import Estimator, resize
from pipeline.detection.wholebody import to_keypoints, to_pixels
from stages.fit.registration import register
from stages.fit.run import published_poses
from stages.fit.settings import FitSettings
from stages.ingest.mannequin import MannequinSpec
from stages.ingest.mannequin.footage import Mannequin, make_mannequin

MOTIONS = {"head": "nod+speech+eyes", "upper": "sway+gesture+eyes"}
SIZES = {"head": 256, "upper": 384}
IDENTITIES = (1, 2)
FRAMES, QUICK_FRAMES = 75, 12
VARIANTS: dict[str, dict[str, Any]] = {
    "own terms": {},
    "as other points": {"lambda_lids": 0.0, "lambda_gaze": 0.0},
}
"""The fits that are compared: what differs from the default settings."""
_SHUT, _OPEN = 0.1, 0.5  # shares of the eye's opening at rest
_ENLARGED = 2.0  # for MediaPipe


@dataclasses.dataclass(frozen=True)
class EyeErrors:
    """The errors that the module's text explains; NaN where a clip has no such frame."""

    opening: float
    in_blinks: float
    gaze: float
    still: float


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Films, fits and measures every clip; a row a clip, and the means."""
    stage, found = load_stage(), []
    detectors = ("simulated", *(("MediaPipe",) if options.mediapipe else ()))
    for framing in options.framings:
        for identity in IDENTITIES[: 1 if options.quick else None]:
            spec = MannequinSpec(
                framing=framing, motion=MOTIONS[framing], size=SIZES[framing], identity=identity,
                seed=identity, frames=QUICK_FRAMES if options.quick else FRAMES,
            )  # fmt: skip
            mannequin = make_mannequin(spec, stage.body, stage.landmarks)
            for detector in detectors:
                seen = mannequin.keypoints if detector == "simulated" else detected(mannequin)
                for variant, changes in VARIANTS.items():
                    errors = fitted_errors(stage, mannequin, seen, FitSettings(**changes))
                    found.append(((detector, variant), errors))
                    row = {"points": detector, "fit": variant, "framing": framing, "identity": identity}
                    report.add({**row, **dataclasses.asdict(errors)}, "clips")
    means = {}
    for detector, variant in itertools.product(detectors, VARIANTS):
        mean = mean_errors([errors for which, errors in found if which == (detector, variant)])
        report.add({"points": detector, "fit": variant, **dataclasses.asdict(mean)}, "means")
        means[detector, variant] = mean
    return "; ".join(
        f"{detector}, {variant}: opening {m.opening:.2f}, in blinks {m.in_blinks:.2f}, gaze {m.gaze:.1f} of "
        f"{m.still:.1f} deg"
        for (detector, variant), m in means.items()
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--framings", nargs="+", choices=MOTIONS, default=list(MOTIONS), help="all of them")
    parser.add_argument("--mediapipe", action="store_true", help="also what MediaPipe finds in the pictures")


def fitted_errors(
    stage: Stage, mannequin: Mannequin, keypoints: Keypoints, settings: FitSettings
) -> EyeErrors:
    """The errors of one fit of one clip."""
    fitted = register(stage.body, stage.landmarks, keypoints, mannequin.cameras, settings)
    times = times_of_numbers(keypoints.frames)
    poses = published_poses(fitted, settings, times)
    return eye_errors(stage, (fitted.identity, poses), (mannequin.truth.identity, mannequin.truth.poses))


def eye_errors(stage: Stage, fitted: tuple[Identity, Poses], true: tuple[Identity, Poses]) -> EyeErrors:
    """The errors of fitted eyes against the truth of the same frames."""
    body, points = stage.body, stage.landmarks.face_mesh
    rest = eye_openings(body, points, true[0], torch.zeros_like(true[1].expression[:1]))
    opening, goal = (eye_openings(body, points, who, how.expression) / rest for who, how in (fitted, true))
    looks, should = (roma.rotvec_to_rotmat(how.rotation[:, 23:25])[..., 2] for _, how in (fitted, true))
    ahead = torch.tensor([0.0, 0.0, 1.0]).expand_as(should)
    open_eyes = goal >= _OPEN

    def mean(values: Tensor, chosen: Tensor) -> float:
        return float(values[chosen].mean())

    return EyeErrors(
        opening=float((opening - goal).abs().mean()),
        in_blinks=mean(opening, goal < _SHUT),
        gaze=mean(_degrees(looks, should), open_eyes),
        still=mean(_degrees(ahead, should), open_eyes),
    )


def eye_openings(body: BodyModel, face_mesh: PointSet, identity: Identity, expression: Tensor) -> Tensor:
    """The opening of each eye over its width, at rest but for the expression: [T, E] -> [T, 2]."""
    joints, rest = rest_joints(body, identity), rest_vertices(body, identity)
    at_rest = locate(face_mesh, joints, rest)
    moved = torch.einsum(
        "fk,fkce->fce", face_mesh.barycentrics, body.expression_directions[face_mesh.vertices]
    )
    places = at_rest + torch.einsum("fce,te->tfc", moved, expression)
    opening = lid_openings(places, places.new_tensor([0.0, 1.0, 0.0]))
    first, second = np.array(CORNERS).T
    return opening / (at_rest[first] - at_rest[second]).norm(dim=-1)


def _degrees(first: Tensor, second: Tensor) -> Tensor:
    """The angle between unit vectors [..., 3]: [...]."""
    return torch.rad2deg(
        torch.atan2(torch.linalg.cross(first, second).norm(dim=-1), (first * second).sum(-1))
    )


def detected(mannequin: Mannequin) -> Keypoints:
    """MediaPipe's own points in a mannequin's pictures.

    Raises:
        UserError: MediaPipe was not fetched.
    """
    asset = frame.asset_folder(open_workspace(), "mediapipe")
    with tempfile.TemporaryDirectory() as folder:
        estimator = Estimator(asset, Path(folder) / "mediapipe.log")
        found = [estimator.estimate(resize(image, _ENLARGED)) for image in mannequin.frames]
    height, width = mannequin.frames.shape[1:3]
    missed = sum(estimate is None for estimate in found)
    assert not missed, f"MediaPipe found nobody in {missed} of {len(found)} pictures"
    points = [to_pixels(estimate, width, height) for estimate in found]
    return to_keypoints(np.arange(len(found)), points, width, height, _ENLARGED)


def mean_errors(errors: list[EyeErrors]) -> EyeErrors:
    """The means over clips; clips without such frames do not count."""
    columns = {}
    for field in dataclasses.fields(EyeErrors):
        values = [v for v in (getattr(e, field.name) for e in errors) if v == v]
        columns[field.name] = statistics.mean(values) if values else float("nan")
    return EyeErrors(**columns)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("eyes", __doc__, measure, arguments, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
