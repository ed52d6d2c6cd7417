"""The registration's error against the truth of mannequins, and its cost.

Holds: docs/results.md, "Registration". Three tables, of which ``--detectors``, ``--framings``, ``--variants``
and ``--no-effort`` choose a part:

- errors against the truth of mannequins in each framing (see ``fit_truth.py``), for the fit as it is and for
  fits that lack one thing each. ``tau = 0`` trusts every score but still masks what lies outside the
  picture; ``no mask`` trusts everything that a detector returned. Keypoints come from simulated detectors
  with measured errors: ``mediapipe`` puts unseen points outside the picture, ``heatmap`` (such as DWPose)
  inside it; ``regressor`` is heatmap's points with a regressor's poses to start from, as the paper has;
- what posing the landmarks costs beside posing the whole mesh and picking them;
- the effort knob: error against seconds over iterations. ``--figure FILE`` draws it.

Seconds are of this machine and one process; the fit computes on one thread.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks import frame
from benchmarks.fit_truth import SOURCES, Errors, Stage, TrueClip, load_stage, make_clips, measure
from pipeline.body import (
    Identity,
    expression_offsets,
    forward_kinematics,
    linear_blend_skinning,
    locate,
    rest_joints,
    rest_vertices,
)
from pipeline.body.landmarks import join
from pipeline.numba_kernels import threads
from stages.fit.face_offset import spread_matrix
from stages.fit.parameters import Parameters, landmark_model, parameters_of
from stages.fit.registration import register
from stages.fit.settings import FitSettings
from stages.ingest.mannequin import FRAMINGS, MannequinSpec

MASKED = "masked"
VARIANTS: dict[str, dict[str, Any]] = {
    MASKED: {},
    "tau = 0": {"score_threshold": 0.0},
    "no mask": {"masked": False},
    "no face offsets": {"face_offsets": False},
    "no joint offsets": {"joint_offsets": False},
    "start only": {"iterations": 0},
}
"""The rows of the table: what differs from the default settings."""

MOTIONS = {
    "full": ("turn+gesture+curl+speech", "sway+gesture+curl+speech"),
    "upper": ("sway+gesture+curl+speech", "turn+gesture+nod+speech"),
    "head": ("nod+speech", "sway+nod+speech"),
}
IDENTITIES = (1, 2)
FRAMES, QUICK_FRAMES = 30, 8
EFFORTS, QUICK_EFFORTS = (25, 50, 100, 200, 400), (10, 20)
QUICK_ITERATIONS = 20  # of the error table: enough to see that it runs
COLUMNS = ("joints", "procrustes", "body", "surface", "pixels")
_REPEATS = 7  # of the posing cost; the least time counts
_POSED_FRAMES = 64


@dataclasses.dataclass(frozen=True)
class Run:
    """One fit of one clip."""

    detector: str
    framing: str
    motion: str
    identity: int
    variant: str
    iterations: int
    seconds_per_100_frames: float
    errors: Errors


def measure_fit(options: argparse.Namespace, report: frame.Report) -> str:
    """Fits every clip in every variant; errors in mm (joints, surface aligned at the anchor) and pixels."""
    stage, quick = load_stage(), options.quick
    detectors = tuple(options.detectors or (SOURCES[:1] if quick else SOURCES))
    clips = {name: list(clips_of(name, stage, detectors, quick, options.bvh)) for name in options.framings}
    base = FitSettings(iterations=QUICK_ITERATIONS) if quick else FitSettings()
    runs: list[Run] = []
    for detector, framing, variant in itertools.product(detectors, options.framings, options.variants):
        settings = dataclasses.replace(base, **VARIANTS[variant])
        chosen = (clip for clip in clips[framing] if clip.detector == detector)
        many = [fit(clip, stage, variant, settings) for clip in chosen]
        report.add({"keypoints": detector, "framing": framing, "variant": variant, **means(many)}, "errors")
        runs += many
    landmarks, mesh = posing_cost(stage, 4 if quick else _POSED_FRAMES)
    report.add({"landmarks_ms": landmarks, "mesh_ms": mesh}, "posing")
    efforts = () if options.no_effort else QUICK_EFFORTS if quick else EFFORTS
    for iterations in efforts:
        first = (clips[framing][0] for framing in options.framings)
        many = [fit(clip, stage, MASKED, FitSettings(iterations=iterations)) for clip in first]
        report.add({"iterations": iterations, **means(many)}, "effort")
    if options.figure is not None and efforts:
        draw_effort(report.tables["effort"], options.figure)
    return headline(runs, (landmarks, mesh))


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw error against seconds (PNG)")
    parser.add_argument("--bvh", type=Path, metavar="FILE", help="a motion to add to the full framing")
    parser.add_argument("--detectors", nargs="+", choices=SOURCES, help="whose errors the keypoints have")
    parser.add_argument("--framings", nargs="+", choices=FRAMINGS, default=FRAMINGS, help="all of them")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="all of them")
    parser.add_argument("--no-effort", action="store_true", help="leave out error against seconds")


def clips_of(
    framing: str, stage: Stage, detectors: tuple[str, ...], quick: bool, bvh: Path | None
) -> Iterator[TrueClip]:
    """The clips of a framing, as each detector sees them."""
    motions = MOTIONS[framing][: 1 if quick else None]
    if bvh is not None and framing == "full":
        motions = (*motions, str(bvh))
    for identity in IDENTITIES[: 1 if quick else None]:
        for seed, motion in enumerate(motions):
            spec = MannequinSpec(
                framing=framing, motion=motion, identity=identity, seed=10 * identity + seed,
                frames=QUICK_FRAMES if quick else FRAMES,
            )  # fmt: skip
            yield from make_clips(spec, stage, detectors)


def fit(clip: TrueClip, stage: Stage, variant: str, settings: FitSettings) -> Run:
    """Fit one clip and measure it."""
    started = time.perf_counter()
    registration = register(
        stage.body, stage.landmarks, clip.keypoints, clip.cameras, settings, start=clip.start
    )
    seconds = time.perf_counter() - started
    spec = clip.spec
    return Run(
        clip.detector, spec.framing, Path(spec.motion).name, spec.identity, variant, settings.iterations,
        100 * seconds / spec.frames,
        measure(registration.identity, registration.poses, clip, stage),
    )  # fmt: skip


def posing_cost(stage: Stage, frames: int) -> tuple[float, float]:
    """Milliseconds of posing the 553 landmarks, and of posing the mesh and picking them from it.

    Forward and backward, each the least of several turns that alternate. Before anything is timed the two
    are compared.

    Raises:
        AssertionError: their landmarks are more than a millimetre apart somewhere.
    """
    body, landmarks = stage.body, stage.landmarks
    points = join(landmarks.pose, landmarks.hands, landmarks.face_mesh)
    spread = spread_matrix(body, landmarks.face_mesh[:468])
    model = landmark_model(body, points, body.shape_directions.shape[2], spread)
    generator = torch.Generator().manual_seed(0)
    rotation = 0.2 * torch.randn(frames, 55, 3, generator=generator)
    sizes = model.shape.shape[2], model.expression.shape[2], spread.shape[1]
    start = parameters_of(rotation, torch.zeros(frames, 3), sizes)

    def of_landmarks(parameters: Parameters) -> Tensor:
        return model.posed(parameters, parameters.matrices)[0]

    def of_mesh(parameters: Parameters) -> Tensor:
        identity = Identity(parameters.betas, parameters.joint_offset, spread @ parameters.face_control)
        rest = rest_vertices(body, identity) + expression_offsets(body, parameters.expression)
        transforms, joints = forward_kinematics(
            parameters.matrices, rest_joints(body, identity), body.parents
        )
        place = parameters.transl[:, None]
        return locate(
            points, joints + place, linear_blend_skinning(transforms, body.skinning_weights, rest) + place
        )

    away = (of_landmarks(start) - of_mesh(start)).norm(dim=-1).max()
    assert away < 1e-3, f"landmarks posed alone are {float(away):.4f} m from those of the mesh"
    with threads(1):
        ways = {"landmarks": of_landmarks, "mesh": of_mesh}
        jobs = {name: lambda way=way: both_passes(way, start) for name, way in ways.items()}
        times = frame.least(jobs, _REPEATS, "wall")
    return times["landmarks"], times["mesh"]


def both_passes(pose: Callable[[Parameters], Tensor], start: Parameters) -> None:
    """One forward and one backward pass through every parameter."""
    pose(start.leaves()).square().sum().backward()


def draw_effort(rows: Iterable[dict[str, Any]], path: Path) -> None:
    """Draws the error of seen joints against seconds, the iterations written beside each point."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    points = {row["iterations"]: (row["s_per_100_frames"], row["joints"]) for row in rows}
    axes.plot(*zip(*points.values(), strict=True), marker="o")
    for iterations, point in points.items():
        axes.annotate(str(iterations), point, textcoords="offset points", xytext=(4, 4), fontsize=8)
    axes.set(xscale="log", xlabel="seconds per 100 frames", ylabel="seen joints, mm (aligned at one joint)")
    figure.savefig(path, dpi=150, metadata={"Software": None})


def headline(runs: list[Run], cost: tuple[float, float]) -> str:
    """One line: by how much the mask helps on seen joints, by framing and detector."""
    parts = []
    for detector in dict.fromkeys(run.detector for run in runs):
        ratios = []
        for framing in dict.fromkeys(run.framing for run in runs):
            masked, tau, none = (
                _mean_joints(
                    [r for r in runs if (r.detector, r.framing, r.variant) == (detector, framing, v)]
                )
                for v in (MASKED, "tau = 0", "no mask")
            )
            ratios.append(f"{framing} {tau / masked:.2f} and {none / masked:.2f}")
        parts.append(f"{detector}: {', '.join(ratios)}")
    return (
        f"error of seen joints at tau = 0 and without mask, times that of the mask; {'; '.join(parts)}; "
        f"posing landmarks costs {cost[0] / cost[1]:.3f} of the mesh"
    )


def _mean_joints(runs: list[Run]) -> float:
    """The mean error of seen joints; NaN if there is no such run."""
    return statistics.mean(run.errors.joints for run in runs) if runs else float("nan")


def means(runs: list[Run]) -> dict[str, Any]:
    """The means over clips, as the columns of a table, and every run."""
    found = {name: statistics.mean(getattr(run.errors, name) for run in runs) for name in COLUMNS}
    seconds = statistics.mean(run.seconds_per_100_frames for run in runs)
    return found | {"s_per_100_frames": seconds, "runs": [dataclasses.asdict(run) for run in runs]}


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("fit", __doc__, measure_fit, arguments, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
