"""A finished avatar in motion: ``python -m benchmarks.animate [--quick] [--json FILE] [--threads N]``.

What a new frame costs, posing and drawing, of an avatar as it was trained and of the same one baked
(``pipeline.avatar.bake``), laid out as the paper's runtime table: the number of Gaussians, the asset (a
Gaussian's mean, opacity, scale, rotation and colour in float32, in MiB), animation, rendering, their sum and
frames a second. Both take turns in one process.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from benchmarks.avatars import avatar_camera, avatar_of, poses_of
from benchmarks.machine import described, prepare
from pipeline.avatar import Architecture, Avatar
from pipeline.avatar.bake import BakedAvatar, bake
from pipeline.body import Pose
from pipeline.splat import Gaussians, render

COUNTS, SIZES = (10_000, 40_000, 167_000), (256, 512)
QUICK_COUNTS, QUICK_SIZES = (10_000,), (256,)
HEADLINE = (40_000, 512)
POSES = 4  # taken in turn
PAPERS = Architecture(residual_parts=("face", "left_hand", "right_hand"))
CLOCKS = ("wall", "cpu")
EACH_FRAME, UNBAKED, BAKED = "decoded each frame", "unbaked", "baked"
WIDTHS = (10, 7, 20, 10, 10, 10, 10, 10, 8)


@dataclasses.dataclass(frozen=True)
class Timing:
    """Milliseconds of one way to animate.

    Attributes:
        contestant: its name.
        gaussians: their number.
        size: pixels along a side of the picture.
        asset_mib: of one frame's Gaussians.
        animation, rendering: wall-clock and CPU time of every frame.
    """

    contestant: str
    gaussians: int
    size: int
    asset_mib: float
    animation: tuple[tuple[float, float], ...]
    rendering: tuple[tuple[float, float], ...]

    def best(self, clock: int) -> tuple[float, float]:
        """The least animation and the least rendering time."""
        return min(one[clock] for one in self.animation), min(one[clock] for one in self.rendering)


def main(arguments: list[str] | None = None) -> None:
    """Time, print one table and one headline line."""
    options = _options(arguments)
    if arguments is None:
        prepare("benchmarks.animate", options.threads)
    counts, sizes = (QUICK_COUNTS, QUICK_SIZES) if options.quick else (COUNTS, SIZES)
    counts, sizes = options.gaussians or counts, options.sizes or sizes
    clock = CLOCKS.index(options.clock)
    print(f"{described()}; least ms of {options.clock} time")
    print(_row("#G", "image", "", "asset MB", "anim", "median", "rend", "total", "FPS"))
    timings: list[Timing] = []
    for count in counts:
        avatar = avatar_of(count, PAPERS).eval()
        baked = bake(avatar)
        for size in sizes:
            taken = _race(avatar, baked, size, options.repeats or (3 if options.quick else 15))
            timings += taken
            for line in _lines(taken, clock):
                print(line, flush=True)
    if options.json is not None:
        record = {"unit": "ms", "clocks": CLOCKS, "timings": [dataclasses.asdict(one) for one in timings]}
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    print(_headline(timings, clock))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.animate", description="Time animation.")
    parser.add_argument("--quick", action="store_true", help="one small case, few repeats")
    parser.add_argument("--repeats", type=int, help="frames of each contestant in each case")
    parser.add_argument("--gaussians", type=int, nargs="+", metavar="N", help="the counts to time")
    parser.add_argument("--sizes", type=int, nargs="+", metavar="PIXELS", help="the pictures to time")
    parser.add_argument("--threads", type=int, default=0, help="of torch and numba; 0 for all")
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: on a machine that is busy")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every single time there")
    return parser.parse_args(arguments)


@torch.no_grad()
def _race(avatar: Avatar, baked: BakedAvatar, size: int, repeats: int) -> list[Timing]:
    """Everybody's frames, in turns."""

    def each_frame(pose: Pose) -> Gaussians:
        return avatar.pose(avatar.decode(), pose).gaussians

    ways = {
        EACH_FRAME: each_frame,
        UNBAKED: lambda pose: avatar.gaussians(pose),
        BAKED: lambda pose: baked.gaussians(pose),
    }
    poses, camera = poses_of(avatar, POSES), avatar_camera(size)
    times: dict[str, list[tuple[tuple[float, float], tuple[float, float]]]] = {name: [] for name in ways}
    for repeat in range(repeats + 1):
        for name, animate in ways.items():
            start = _now()
            gaussians = animate(poses[repeat % POSES])
            middle = _now()
            render(gaussians, camera)
            end = _now()
            if repeat > 0:  # the first turn compiles and warms up
                times[name].append((_passed(start, middle), _passed(middle, end)))
    asset = sum(tensor.numel() * tensor.element_size() for tensor in gaussians.tensors()) / 2**20
    return [
        Timing(name, len(avatar), size, asset, *zip(*pairs, strict=True)) for name, pairs in times.items()
    ]


def _lines(timings: list[Timing], clock: int) -> Iterator[str]:
    for timing in timings:
        animation, rendering = timing.best(clock)
        total, median = animation + rendering, statistics.median(one[clock] for one in timing.animation)
        milliseconds = (f"{one:.1f}" for one in (animation, median, rendering, total))
        yield _row(
            str(timing.gaussians),
            f"{timing.size}²",
            timing.contestant,
            f"{timing.asset_mib:.2f}",
            *milliseconds,
            f"{1e3 / total:.1f}",
        )


def _row(*cells: str) -> str:
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS, strict=True))


def _headline(timings: list[Timing], clock: int) -> str:
    """One line: the middle count at the larger size, or the last case that was timed."""
    cases: dict[tuple[int, int], dict[str, float]] = {}
    for timing in timings:
        total = sum(timing.best(clock))
        cases.setdefault((timing.gaussians, timing.size), {})[timing.contestant] = total
    wanted = [case for case in cases if abs(case[0] / HEADLINE[0] - 1) < 0.01 and case[1] == HEADLINE[1]]
    count, size = wanted[0] if wanted else list(cases)[-1]
    totals = cases[count, size]
    unbaked, each_frame = (totals[name] / totals[BAKED] for name in (UNBAKED, EACH_FRAME))
    return (
        f"animate: {count} Gaussians at {size}²: {totals[BAKED]:.1f} ms a frame baked, "
        f"{1e3 / totals[BAKED]:.1f} frames a second; unbaked takes {unbaked:.2f} times that, "
        f"decoded each frame {each_frame:.2f} times"
    )


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _passed(start: tuple[float, float], end: tuple[float, float]) -> tuple[float, float]:
    return (end[0] - start[0]) * 1e3, (end[1] - start[1]) * 1e3


if __name__ == "__main__":
    main()
