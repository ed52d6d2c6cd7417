"""How far precision carries training: ``python -m benchmarks.drift [--quick] [--json FILE] [--steps N]``.

One small subject, one seed, the same draws, in bfloat16 and in float32 as the product has them, and in
float64 by the straightforward implementation of the same model. Training is chaotic, so that what a precision
does must be held against what one rounding of the initial weights does: that is a contestant, too.

Printed at a few steps: the loss (mean of the steps since the last), PSNR of frames that were not trained on
against their truth, and PSNR against float64's pictures of the same frames.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from benchmarks.avatars import avatar_camera, avatar_of, open_body, poses_of
from benchmarks.machine import described, prepare
from benchmarks.step import _photometric, _regularisers
from benchmarks.straightforward import StraightforwardAvatar
from pipeline.avatar import Architecture, Avatar
from pipeline.body import Pose, mean_identity
from pipeline.metrics import psnr
from pipeline.splat import render

SIZES = Architecture(plane_resolution=32, plane_channels=8, width=32, groups=4, residual_parts=())
GAUSSIANS, PIXELS, FRAMES, HELD_OUT = 1500, 96, 12, 4
HALF, SINGLE, ROUNDED, DOUBLE = "bfloat16", "float32", "float32, one rounding apart", "float64"
STEPS, QUICK_STEPS = 500, 20
HEAD = (0.0, -0.25, -0.6)  # metres
POINTS = 5  # of the table
RATES = (5e-3, 1e-3)  # of planes and heads, as train's
Record = TypeVar("Record")


class Run:
    """One contestant's training."""

    def __init__(self, name: str, model: Avatar | StraightforwardAvatar, dtype: torch.dtype):
        """Starts at step 0."""
        self.name, self.model, self.dtype = name, model, dtype
        networks = model.representation if isinstance(model, Avatar) else model
        planes = list(networks.triplane.parameters())
        rest = [one for key, one in networks.named_parameters() if not key.startswith("triplane.")]
        groups = [{"params": part, "lr": rate} for part, rate in zip((planes, rest), RATES, strict=True)]
        self.optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
        self.losses: list[float] = []

    def step(self, pose: Pose, target: Tensor, background: Tensor) -> None:
        """One optimiser step on one frame."""
        decoded = self.model.decode()
        posed = self.model.pose(decoded, in_precision(pose, self.dtype))
        rendering = render(posed.gaussians, avatar_camera(PIXELS))
        loss = _photometric(rendering, target.to(self.dtype), background.to(self.dtype))
        loss = loss + _regularisers(decoded, posed)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        self.losses.append(float(loss.detach()))

    @torch.no_grad()
    def picture(self, pose: Pose) -> Tensor:
        """What it shows of a pose, [H, W, 3] float64 in [0, 1]."""
        posed = self.model.pose(self.model.decode(), in_precision(pose, self.dtype))
        return render(posed.gaussians, avatar_camera(PIXELS)).color.double().clamp(0, 1)


def in_precision(pose: Pose, dtype: torch.dtype) -> Pose:
    """A pose of another floating-point type."""
    return Pose(pose.rotation.to(dtype), pose.expression.to(dtype), pose.transl.to(dtype))


def main(arguments: list[str] | None = None) -> None:
    """Train all, print a table and one headline line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drift", description="Precision's drift.")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_STEPS} steps")
    parser.add_argument("--steps", type=int, help=f"{STEPS} by default")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    options = parser.parse_args(arguments)
    if arguments is None:
        prepare("benchmarks.drift", 1)
    steps = options.steps or (QUICK_STEPS if options.quick else STEPS)
    print(f"{described()}; {GAUSSIANS} Gaussians, {PIXELS}², seed 0")
    rows = race(steps)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    print(headline(rows))


def race(steps: int) -> list[dict[str, Any]]:
    """Every contestant's steps, in turns; rows of the table, which is printed on the way."""
    truth = avatar_of(GAUSSIANS, SIZES, half_precision=False).eval()
    poses, camera = near(poses_of(truth, FRAMES + HELD_OUT)), avatar_camera(PIXELS)
    with torch.no_grad():
        decoded = truth.decode()
        films = [render(truth.pose(decoded, one).gaussians, camera) for one in poses]
    runs = contestants(truth)
    generator, rows = torch.Generator().manual_seed(0), []
    print(f"{'step':>5} {'':<30}{'loss':>10}{'held out dB':>13}{'to float64 dB':>15}")
    for step in range(1, steps + 1):
        frame = int(torch.randint(FRAMES, (), generator=generator))
        background = torch.rand(3, generator=generator)
        film = films[frame]
        target = film.color + (1 - film.alpha[..., None]) * background
        for run in runs:
            run.step(poses[frame], target, background)
        if step % max(1, steps // POINTS) == 0:
            rows += point(runs, step, poses[FRAMES:], [film.color.double() for film in films[FRAMES:]])
    return rows


def near(poses: list[Pose]) -> list[Pose]:
    """The poses with the head before the camera: of a body so few Gaussians are the uppermost."""
    return [dataclasses.replace(pose, transl=torch.tensor(HEAD)) for pose in poses]


def point(runs: list[Run], step: int, poses: list[Pose], truths: list[Tensor]) -> list[dict[str, Any]]:
    """A row a contestant, printed."""
    exact, rows = [runs[-1].picture(pose) for pose in poses], []
    for run in runs:
        pictures = [run.picture(pose) for pose in poses]
        held_out, apart = (
            sum(psnr(one, other) for one, other in zip(pictures, others, strict=True)) / len(poses)
            for others in (truths, exact)
        )
        loss, run.losses = sum(run.losses) / len(run.losses), []
        rows.append({"step": step, "run": run.name, "loss": loss, "held_out": held_out, "apart": apart})
        print(f"{step:>5} {run.name:<30}{loss:>10.5f}{held_out:>13.2f}{apart:>15.2f}", flush=True)
    return rows


def contestants(truth: Avatar) -> list[Run]:
    """From the same weights; float64 last."""

    def fresh(half: bool) -> Avatar:
        body = open_body()
        return Avatar(body, mean_identity(body), truth.vertex_ids, truth.architecture, 0, half).train()

    rounded = fresh(False)
    with torch.no_grad():
        planes = rounded.representation.triplane.planes
        planes.copy_(torch.nextafter(planes, torch.full_like(planes, torch.inf)))
    double = StraightforwardAvatar(fresh(False)).double()
    for name in ("surface", "base_color"):
        setattr(double, name, cast(getattr(double, name), torch.float64))
    double.triplane.coordinates = double.triplane.coordinates.double()
    return [
        Run(HALF, fresh(True), torch.float32),
        Run(SINGLE, fresh(False), torch.float32),
        Run(ROUNDED, rounded, torch.float32),
        Run(DOUBLE, double, torch.float64),
    ]


def cast(record: Record, dtype: torch.dtype) -> Record:
    """A record with its floating tensors in another precision."""
    if isinstance(record, Tensor):
        return record.to(dtype) if record.is_floating_point() else record  # type: ignore[return-value]
    if not dataclasses.is_dataclass(record) or isinstance(record, type):
        return record
    fields = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return dataclasses.replace(record, **{name: cast(value, dtype) for name, value in fields.items()})


def headline(rows: list[dict[str, Any]]) -> str:
    """One line, at the last step."""
    last = {row["run"]: row for row in rows if row["step"] == rows[-1]["step"]}
    parts = []
    for name in (HALF, SINGLE, ROUNDED):
        better = last[name]["held_out"] - last[DOUBLE]["held_out"]
        parts.append(f"{name} {better:+.2f} dB ({last[name]['apart']:.1f} dB apart)")
    return f"drift: after {rows[-1]['step']} steps, held out against float64: {'; '.join(parts)}"


if __name__ == "__main__":
    main()
