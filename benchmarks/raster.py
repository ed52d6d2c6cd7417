"""The CPU rasterizer's speed: ``python -m benchmarks.raster [--quick] [--json FILE] [--prototype DIR]``.

Forward and backward, end to end through autograd, on a body of Gaussians. The dense twin runs beside it
where its tensors fit in memory. With ``--prototype`` a folder that holds the throwaway rasterizer
(``rast4.py``) is timed in the same run. Contestants take turns, so that what else the machine does falls on
all of them alike; minima and medians are given, in milliseconds.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.scenes import body_camera, body_scene
from pipeline.clip.camera import Camera
from pipeline.splat import Gaussians, render

# What is drawn: color [H, W, 3], alpha [H, W], depth [H, W].
Images = tuple[Tensor, Tensor, Tensor]
Contestant = Callable[[Gaussians, Camera], Images]

_SCENES = ((500, 128), *((count, size) for count in (10_000, 40_000, 167_000) for size in (256, 512)))
_QUICK_SCENES = ((500, 128), (10_000, 256))
_DENSE_TENSORS = 23  # of [N, H, W] float32 that the dense twin holds at its peak, forward and backward
_HEADLINE = (167_000, 512)


@dataclasses.dataclass(frozen=True)
class Timing:
    """Milliseconds of one contestant on one scene."""

    contestant: str
    gaussians: int
    size: int
    forward: tuple[float, ...]
    backward: tuple[float, ...]

    @property
    def total(self) -> float:
        """The fastest forward and the fastest backward, together."""
        return min(self.forward) + min(self.backward)


def main(arguments: list[str] | None = None) -> None:
    """Time, print a table and one headline line."""
    options = _options(arguments)
    contestants: dict[str, Contestant] = {"numba": _contestant("numba"), "dense": _contestant("dense")}
    if options.prototype is not None:
        contestants["prototype"] = _prototype(options.prototype)
    scenes = _QUICK_SCENES if options.quick else _SCENES
    repeats = options.repeats or (3 if options.quick else 15)

    threads = torch.get_num_threads()
    print(f"{platform.machine()}, {os.cpu_count()} cores, {threads} threads, torch {torch.__version__}")
    print(_row("N", "image", "", "forward", "median", "backward", "median", "x numba"))
    timings: list[Timing] = []
    for count, size in scenes:
        for line in _race(contestants, count, size, repeats, timings):
            print(line, flush=True)
    if options.json is not None:
        record = [dataclasses.asdict(timing) for timing in timings]
        options.json.write_text(json.dumps({"unit": "ms", "timings": record}, indent=1) + "\n")
    print(_headline(timings))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.raster", description="Time the CPU rasterizer."
    )
    parser.add_argument("--quick", action="store_true", help="two small scenes, few repeats")
    parser.add_argument("--repeats", type=int, help="how often each contestant runs each scene")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every single time there")
    parser.add_argument(
        "--prototype", type=Path, metavar="DIR", help="time the rasterizer of DIR/rast4.py too"
    )
    return parser.parse_args(arguments)


def _contestant(backend: str) -> Contestant:
    """A backend of ours."""

    def draw(gaussians: Gaussians, camera: Camera) -> Images:
        rendering = render(gaussians, camera, backend)
        return rendering.color, rendering.alpha, rendering.depth

    return draw


def _prototype(folder: Path) -> Contestant:
    """The throwaway rasterizer of ``folder``."""
    sys.path.insert(0, str(folder))
    import rast4

    def draw(gaussians: Gaussians, camera: Camera) -> Images:
        pose = camera.rotation, camera.translation, camera.intrinsics
        return rast4.rasterize(*gaussians.tensors(), *pose, camera.width, camera.height)[:3]

    return draw


def _race(
    contestants: dict[str, Contestant], count: int, size: int, repeats: int, timings: list[Timing]
) -> Iterator[str]:
    """Time each contestant on one scene in turns; append the timings, yield the table's lines."""
    gaussians, camera = body_scene(count), body_camera(size)
    leaves = Gaussians(*(tensor.requires_grad_() for tensor in gaussians.tensors()))
    dense_bytes = _DENSE_TENSORS * 4 * count * size**2
    running = {
        name: draw for name, draw in contestants.items() if name != "dense" or dense_bytes < _free_memory()
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in running}
    for repeat in range(repeats + 1):
        for name, draw in running.items():
            pair = _time_once(draw, leaves, camera)
            if repeat > 0:  # the first turn compiles and warms up
                times[name].append(pair)
    ours = None
    for name, pairs in times.items():
        timing = Timing(name, count, size, tuple(p[0] for p in pairs), tuple(p[1] for p in pairs))
        timings.append(timing)
        ours = ours or timing
        cells = [f(times) for times in (timing.forward, timing.backward) for f in (min, statistics.median)]
        yield _row(
            str(count),
            f"{size}²",
            name,
            *(f"{cell:.1f}" for cell in cells),
            f"{timing.total / ours.total:.2f}",
        )
    if "dense" not in running:
        yield _row(str(count), f"{size}²", "dense", f"needs {dense_bytes / 2**30:.0f} GiB", "", "", "", "")


def _time_once(draw: Contestant, leaves: Gaussians, camera: Camera) -> tuple[float, float]:
    """Milliseconds of one forward and one backward pass."""
    for tensor in leaves.tensors():
        tensor.grad = None
    start = time.perf_counter()
    images = draw(leaves, camera)
    forward = time.perf_counter() - start
    gradients = [torch.ones_like(image) for image in images]
    start = time.perf_counter()
    torch.autograd.backward(images, gradients)
    return forward * 1e3, (time.perf_counter() - start) * 1e3


def _free_memory() -> int:
    """Bytes of memory that can be had without swapping (half of it all where the system does not tell)."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) * 1024
    except (OSError, StopIteration):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def _row(*cells: str) -> str:
    widths = (8, 6, 10, 13, 8, 9, 8, 8)
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))


def _headline(timings: list[Timing]) -> str:
    """One line: the largest scene, and the peers on the scenes that both ran."""
    ours = {(t.gaussians, t.size): t for t in timings if t.contestant == "numba"}
    count, size = _HEADLINE if _HEADLINE in ours else max(ours)
    best = ours[count, size]
    parts = [f"{count} Gaussians at {size}²: {min(best.forward):.1f} + {min(best.backward):.1f} ms"]
    for peer in ("prototype", "dense"):
        ratios = [t.total / ours[t.gaussians, t.size].total for t in timings if t.contestant == peer]
        if ratios:
            parts.append(
                f"{peer} takes {min(ratios):.2f} to {max(ratios):.2f} times ours over {len(ratios)} scenes"
            )
    return "raster: " + "; ".join(parts)


if __name__ == "__main__":
    main()
