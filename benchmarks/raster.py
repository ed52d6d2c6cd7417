"""The CPU rasterizer, forward and backward through autograd, on a body of Gaussians.

Holds: docs/results.md, "Rasterizer". The dense twin runs beside it where its tensors fit in memory. They take
turns; minima and medians are given, wall milliseconds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from pathlib import Path

import torch

from benchmarks import frame
from benchmarks.scenes import body_camera, body_scene
from pipeline.clip.camera import Camera
from pipeline.splat import Gaussians, render

SCENES = ((500, 128), *((count, size) for count in (10_000, 40_000, 167_000) for size in (256, 512)))
QUICK_SCENES = ((500, 128), (10_000, 256))
DENSE_TENSORS = 23  # of [N, H, W] float32 that the dense twin holds at its peak, forward and backward


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Times every scene."""
    for count, size in QUICK_SCENES if options.quick else SCENES:
        for row in race(count, size, options.repeats or (3 if options.quick else 15)):
            report.add(row)
    rows = report.tables["rows"]
    ours, dense = ([row for row in rows if row["backend"] == name] for name in ("numba", "dense"))
    ratios = [row["x numba"] for row in dense if row["forward_ms"] is not None]
    peer = ""
    if ratios:
        peer = f"; dense takes {min(ratios):.2f} to {max(ratios):.2f} times that over {len(ratios)} scenes"
    last = ours[-1]
    times = f"{last['forward_ms']:.1f} + {last['backward_ms']:.1f} ms"
    return f"{last['gaussians']} Gaussians at {last['size']}²: {times}{peer}"


def race(count: int, size: int, repeats: int) -> list[dict[str, object]]:
    """A row a backend; the dense twin's is empty where it has no room."""
    camera = body_camera(size)
    leaves = Gaussians(*(tensor.requires_grad_() for tensor in body_scene(count).tensors()))
    gibibytes = DENSE_TENSORS * 4 * count * size**2 / 2**30
    backends = ["numba", "dense"] if gibibytes < free_memory() else ["numba"]
    taken = frame.in_turn({name: lambda name=name: once(name, leaves, camera) for name in backends}, repeats)
    rows, ours = [], None
    for name in ("numba", "dense"):
        row: dict[str, object] = {"gaussians": count, "size": size, "backend": name}
        if name in taken:
            forward, backward = zip(*taken[name], strict=True)
            total = min(forward) + min(backward)
            ours = ours or total
            row |= {"forward_ms": min(forward), "median": statistics.median(forward)}
            row |= {"backward_ms": min(backward), "median ": statistics.median(backward)}
            row |= {"x numba": total / ours, "forward": forward, "backward": backward}
        else:
            row |= dict.fromkeys(("forward_ms", "median", "backward_ms", "median "))
            row |= {"x numba": f"needs {gibibytes:.0f} GiB"}
        rows.append(row)
    return rows


def once(backend: str, leaves: Gaussians, camera: Camera) -> tuple[float, float]:
    """Milliseconds of one forward and one backward pass."""
    for tensor in leaves.tensors():
        tensor.grad = None
    start = time.perf_counter()
    rendering = render(leaves, camera, backend)
    images = rendering.color, rendering.alpha, rendering.depth
    forward = time.perf_counter() - start
    gradients = [torch.ones_like(image) for image in images]
    backward = frame.milliseconds(lambda: torch.autograd.backward(images, gradients), "wall")
    return forward * 1e3, backward


def free_memory() -> float:
    """GiB that can be had without swapping (half of it all where the system does not tell)."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) / 2**20
    except (OSError, StopIteration):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**31


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""

    def add_repeats(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--repeats", type=int, help="of each backend on each scene")

    return frame.run("raster", __doc__, measure, arguments, options=add_repeats)


if __name__ == "__main__":
    sys.exit(main())
