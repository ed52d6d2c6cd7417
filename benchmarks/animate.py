"""A frame of a finished avatar in motion: posing and drawing, decoded each frame, unbaked and baked.

Holds: docs/results.md, "A training step and a frame of animation", laid out as the paper's Table 8, with the
residual heads. "bases" is the other representation, baked, of as many Gaussians. ``asset_mib`` is of one
frame's Gaussians (mean, opacity, scale, rotation, colour, float32).
Contestants take turns in one process; the least of the repeats counts.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys

import torch

from benchmarks import frame
from benchmarks.avatars import (
    add_sizes,
    avatar_camera,
    avatar_of,
    bases_avatar_of,
    chosen_case,
    poses_of,
    sizes_of,
)
from pipeline.avatar import Architecture, Avatar
from pipeline.avatar.bake import bake
from pipeline.splat import Gaussians, render

POSES = 4  # taken in turn
PAPERS = Architecture(residual_parts=("face", "left_hand", "right_hand"))
EACH_FRAME, UNBAKED, BAKED, BASES = "decoded each frame", "unbaked", "baked", "bases"


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Times every case."""
    counts, sizes, repeats = sizes_of(options, repeats=15)
    for count in counts:
        avatar, bases = avatar_of(count, PAPERS).eval(), bases_avatar_of(count).eval()
        for size in sizes:
            for row in race(avatar, bases, size, repeats, options.clock):
                report.add(row)
    count, size, case = chosen_case(report.tables["rows"])
    totals = {row["contestant"]: row["total_ms"] for row in case}
    posing = {row["contestant"]: row["posing_ms"] for row in case}
    unbaked, each_frame = (totals[name] / totals[BAKED] for name in (UNBAKED, EACH_FRAME))
    return (
        f"{count} Gaussians at {size}²: {totals[BAKED]:.1f} ms a frame baked, "
        f"{1e3 / totals[BAKED]:.1f} frames a second; unbaked takes {unbaked:.2f} times that, "
        f"decoded each frame {each_frame:.2f} times; bases {totals[BASES]:.1f} ms: baked takes "
        f"{totals[BAKED] / totals[BASES]:.2f} times that, {posing[BAKED] / posing[BASES]:.2f} times in posing"
    )


@torch.no_grad()
def race(avatar: Avatar, bases: Avatar, size: int, repeats: int, clock: str) -> list[dict[str, object]]:
    """A row a contestant."""
    poses, camera, now = poses_of(avatar, POSES), avatar_camera(size), frame.CLOCKS[clock]
    baked = bake(avatar)
    ways = {
        EACH_FRAME: lambda pose: avatar.pose(avatar.decode(), pose).gaussians,
        UNBAKED: avatar.gaussians,
        BAKED: baked.gaussians,
        BASES: bake(bases).gaussians,
    }

    turns = {way: itertools.cycle(poses) for way in ways}

    def one_frame(way: str) -> tuple[float, float, Gaussians]:
        pose = next(turns[way])
        start = now()
        gaussians = ways[way](pose)
        middle = now()
        render(gaussians, camera)
        return 1e3 * (middle - start), 1e3 * (now() - middle), gaussians

    rows = []
    for way, taken in frame.in_turn({way: lambda way=way: one_frame(way) for way in ways}, repeats).items():
        posing, drawing, gaussians = zip(*taken, strict=True)
        total = min(posing) + min(drawing)
        asset = sum(tensor.numel() * tensor.element_size() for tensor in gaussians[0].tensors()) / 2**20
        rows.append({
            "gaussians": len(avatar), "size": size, "contestant": way, "asset_mib": asset,
            "posing_ms": min(posing), "median_ms": statistics.median(posing), "render_ms": min(drawing),
            "total_ms": total, "fps": 1e3 / total, "posing": posing, "rendering": drawing,
        })  # fmt: skip
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("animate", __doc__, measure, arguments, options=add_sizes)


if __name__ == "__main__":
    sys.exit(main())
