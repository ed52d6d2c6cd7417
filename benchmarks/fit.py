"""What the registration is worth and what it costs: ``python -m benchmarks.fit [--quick] [--json FILE]``.

Three tables, of which ``--detectors``, ``--framings``, ``--variants`` and ``--no-effort`` choose a part:

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
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.fit_truth import ANCHORS, SOURCES, Errors, Stage, TrueClip, load_stage, make_clips, measure
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
COLUMNS = ("joints", "Procrustes", "body", "surface", "pixels")
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


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the tables and one headline line."""
    options = _options(arguments)
    stage = load_stage()
    quick = options.quick
    print(f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}")
    detectors, framings = tuple(options.detectors), tuple(options.framings)
    clips = {framing: list(_clips(framing, stage, detectors, quick, options.bvh)) for framing in framings}

    runs: list[Run] = []
    for detector in detectors:
        for framing in framings:
            chosen = [clip for clip in clips[framing] if clip.detector == detector]
            iterations = QUICK_ITERATIONS if quick else None
            for line in _error_table(chosen, stage, runs, options.variants, iterations):
                print(line, flush=True)
    cost = posing_cost(stage, 4 if quick else _POSED_FRAMES)
    print(f"\nposing, forward and backward: landmarks {cost[0]:.1f} ms, whole mesh {cost[1]:.1f} ms")
    effort: list[Run] = []
    if not options.no_effort:
        first = [clips[framing][0] for framing in framings]
        for line in _effort_table(first, stage, QUICK_EFFORTS if quick else EFFORTS, effort):
            print(line, flush=True)
    if options.json is not None:
        record = {"errors": runs, "effort": effort}
        lists = {name: [dataclasses.asdict(run) for run in many] for name, many in record.items()}
        posing = {"landmarks_ms": cost[0], "mesh_ms": cost[1]}
        options.json.write_text(json.dumps({**lists, "posing": posing}, indent=1) + "\n")
    if options.figure is not None and effort:
        draw_effort(effort, options.figure)
    print(headline(runs, cost))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fit", description="Measure the fit stage.")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="one short clip a framing, one detector, few iterations: figures that mean nothing",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every single run there")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw error against seconds (PNG)")
    parser.add_argument("--bvh", type=Path, metavar="FILE", help="a motion to add to the full framing")
    parser.add_argument(
        "--detectors", nargs="+", choices=SOURCES, help="whose errors the keypoints have (all of them)"
    )
    parser.add_argument("--framings", nargs="+", choices=FRAMINGS, default=FRAMINGS, help="all of them")
    parser.add_argument(
        "--variants",
        nargs="+",
        choices=VARIANTS,
        default=list(VARIANTS),
        help="rows of the error tables (all)",
    )
    parser.add_argument("--no-effort", action="store_true", help="leave out error against seconds")
    options = parser.parse_args(arguments)
    options.detectors = options.detectors or (SOURCES[:1] if options.quick else SOURCES)
    return options


def _clips(
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


def _error_table(
    clips: list[TrueClip], stage: Stage, runs: list[Run], variants: list[str], iterations: int | None = None
) -> Iterator[str]:
    """Fit the clips of one framing and detector in each variant; append the runs, yield lines."""
    base = FitSettings() if iterations is None else FitSettings(iterations=iterations)
    framing, detector = clips[0].spec.framing, clips[0].detector
    yield (
        f"\n{framing}, {detector} keypoints, {len(clips)} clips of {clips[0].spec.frames} frames; what is "
        f"seen, mm aligned at the {ANCHORS[framing]} (Procrustes: by the seen joints), px of "
        f"{clips[0].spec.size}"
    )
    yield _row("", *COLUMNS, "s/100 fr.")
    for variant in variants:
        settings = dataclasses.replace(base, **VARIANTS[variant])
        many = [fit(clip, stage, variant, settings) for clip in clips]
        runs.extend(many)
        yield _row(variant, *_cells(many))


def _effort_table(
    clips: list[TrueClip], stage: Stage, efforts: tuple[int, ...], runs: list[Run]
) -> Iterator[str]:
    """Fit one clip of each framing with every effort; append the runs, yield lines."""
    names = ", ".join(clip.spec.framing for clip in clips)
    yield f"\neffort in iterations, {clips[0].detector} keypoints, mean of one clip each of {names}"
    yield _row("", *COLUMNS, "s/100 fr.")
    for iterations in efforts:
        settings = FitSettings(iterations=iterations)
        many = [fit(clip, stage, MASKED, settings) for clip in clips]
        runs.extend(many)
        yield _row(str(iterations), *_cells(many))


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
    times: dict[str, list[float]] = {"landmarks": [], "mesh": []}
    for _ in range(_REPEATS):
        times["landmarks"].append(_milliseconds(of_landmarks, start))
        times["mesh"].append(_milliseconds(of_mesh, start))
    return min(times["landmarks"]), min(times["mesh"])


def _milliseconds(pose: Callable[[Parameters], Tensor], start: Parameters) -> float:
    """One forward and one backward pass through every parameter."""
    leaves = start.leaves()
    with threads(1):
        started = time.perf_counter()
        pose(leaves).square().sum().backward()
        return 1e3 * (time.perf_counter() - started)


def draw_effort(runs: list[Run], path: Path) -> None:
    """Draw the error of seen joints against seconds, the iterations written beside each point."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    efforts = sorted({run.iterations for run in runs})
    points = [_effort_point([run for run in runs if run.iterations == effort]) for effort in efforts]
    axes.plot(*zip(*points, strict=True), marker="o")
    for iterations, point in zip(efforts, points, strict=True):
        axes.annotate(str(iterations), point, textcoords="offset points", xytext=(4, 4), fontsize=8)
    axes.set(xscale="log", xlabel="seconds per 100 frames", ylabel="seen joints, mm (aligned at one joint)")
    figure.savefig(path, dpi=150, metadata={"Software": None})


def _effort_point(runs: list[Run]) -> tuple[float, float]:
    seconds = statistics.mean(run.seconds_per_100_frames for run in runs)
    return seconds, statistics.mean(run.errors.joints for run in runs)


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
        f"fit: error of seen joints at tau = 0 and without mask, times that of the mask; {'; '.join(parts)}; "
        f"posing landmarks costs {cost[0] / cost[1]:.3f} of the mesh"
    )


def _mean_joints(runs: list[Run]) -> float:
    """The mean error of seen joints; NaN if there is no such run."""
    return statistics.mean(run.errors.joints for run in runs) if runs else float("nan")


def _cells(runs: list[Run]) -> list[str]:
    """The means over clips, as the columns of a table."""
    names = ("joints", "procrustes", "body", "surface", "pixels")
    means = [statistics.mean(getattr(run.errors, name) for run in runs) for name in names]
    seconds = statistics.mean(run.seconds_per_100_frames for run in runs)
    return [*(f"{mean:.1f}" for mean in means[:-1]), f"{means[-1]:.2f}", f"{seconds:.1f}"]


def _row(*cells: str) -> str:
    widths = (16, 8, 11, 8, 8, 8, 10)
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))


if __name__ == "__main__":
    main()
