"""The cost of guards and of precision.

Holds: docs/stability.md, "What stability costs". Processor time on one thread, with and without each, in
turns in one process; the least of the repeats counts. ``adds`` is what it adds to ``without``.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks import frame
from benchmarks.avatars import avatar_of
from benchmarks.fit_truth import load_stage, make_clips
from benchmarks.step import Contestant, adam, frames_of
from pipeline.avatar import save_avatar
from pipeline.body import Poses, write_poses
from pipeline.files import tables
from pipeline.finite import finite, require_finite_files
from pipeline.metrics import ssim
from pipeline.store import artifact
from stages.fit import adam as fit_adam
from stages.fit import parameters
from stages.fit.outlier_frames import mask_outlier_frames
from stages.fit.registration import register
from stages.fit.settings import FitSettings
from stages.ingest.mannequin import MannequinSpec


@dataclasses.dataclass(frozen=True)
class Cost:
    """One line of the table.

    Attributes:
        what: the guard or precision.
        without, share: milliseconds of processor time without it, and what it adds, as a part of that.
        kept: whether the product has it.
        why: in a few words.
    """

    what: str
    without: float
    share: float
    kept: bool
    why: str


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Times all."""
    repeats = 2 if options.quick else 9
    costs = {}
    for cost in (
        *training(options.quick, repeats),
        *fitting(options.quick, repeats),
        *files(repeats),
        *precision(repeats),
    ):
        costs[cost.what] = cost.share
        report.add(cost)
    step = costs["training: gradients, one sum, every step"] + costs["training: parameters, every 250th step"]
    fit = costs["fit: gradients, one sum, every step"] + costs["fit: six numbers that are no rotation"]
    return f"guards add {step:.2%} to a step of training and {fit:.1%} to a step of the fit"


def least(repeats: int, *jobs: Callable[[], object]) -> list[float]:
    """The least processor time of each job, milliseconds; they take turns."""
    return list(frame.least({str(place): job for place, job in enumerate(jobs)}, repeats).values())


def training(quick: bool, repeats: int) -> Iterator[Cost]:
    """The gradients of a step, looked at in three ways, and the parameters."""
    avatar = avatar_of(2000 if quick else 10_000)
    contestant = Contestant("ours", avatar, adam(avatar, fused=True), shared=True)
    frames = frames_of(avatar, 1, 128 if quick else 256)

    def backward() -> None:
        avatar.zero_grad(set_to_none=True)
        contestant.objective(frames).backward()

    backward()
    gradients = [one.grad for one in avatar.parameters() if one.grad is not None]
    state = list(avatar.state_dict().values())

    def each() -> bool:
        return all(bool(one.isfinite().all()) for one in gradients)

    def norm() -> bool:
        return bool(torch.stack(torch._foreach_norm(gradients)).sum().isfinite())

    whole, sums, every, norms, weights = least(
        repeats, lambda: contestant.step(frames), lambda: finite(gradients), each, norm, lambda: finite(state)
    )
    backward()
    yield Cost(
        "training: gradients, one sum, every step", whole, sums / whole, True, "names iteration and frame"
    )
    yield Cost(
        "training: gradients, isfinite of each, every step", whole, every / whole, False, "says no more"
    )
    yield Cost(
        "training: gradients, norms, every step", whole, norms / whole, False, "squares overflow sooner"
    )
    yield Cost(
        "training: parameters, every step", whole, weights / whole, False, "finite gradients leave them so"
    )
    yield Cost("training: parameters, every 250th step", whole, weights / whole / 250, True, "at checkpoints")


@contextmanager
def without(owner: Any, name: str, instead: Callable[..., Any]) -> Iterator[None]:
    """The product with one function replaced."""
    with mock.patch.object(owner, name, instead):
        yield


def fitting(quick: bool, repeats: int) -> Iterator[Cost]:
    """A fit with and without what guards it."""
    import roma

    stage = load_stage()
    spec = MannequinSpec(framing="full", motion="sway+gesture", frames=8 if quick else 60, size=256)
    clip = make_clips(spec, stage, ("mediapipe",))[0]
    settings = FitSettings(iterations=4 if quick else 12, face="off")

    def fit() -> None:
        register(stage.body, stage.landmarks, clip.keypoints, clip.cameras, settings)

    def fit_unguarded() -> None:
        with without(fit_adam, "require_finite_gradient", lambda *arguments: None):
            fit()

    def fit_trusting() -> None:
        with without(parameters, "orthonormalised", roma.special_gramschmidt):
            fit()

    turns = min(repeats, 5)
    guarded, bare, trusting = least(turns, fit, fit_unguarded, fit_trusting)
    yield Cost("fit: gradients, one sum, every step", bare, guarded / bare - 1, True, "names step and frame")
    yield Cost("fit: six numbers that are no rotation", trusting, guarded / trusting - 1, True, "else NaN")
    (masking,) = least(turns, lambda: mask_outlier_frames(clip.keypoints))
    full = guarded * 200 / settings.iterations
    yield Cost("fit: outlier frames, of 200 steps", full, masking / full, True, "else 60 degrees off")


def files(repeats: int) -> Iterator[Cost]:
    """Writing and publishing with and without a look."""
    count = 2000
    generator = torch.Generator().manual_seed(0)
    poses = Poses(tuple(range(count)), torch.randn(count, 55, 3, generator=generator), torch.zeros(count, 50),
                  torch.zeros(count, 3))  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_avatar(folder / "avatar.safetensors", avatar_of(10_000))

        def publish() -> None:
            artifact.describe_file(folder, folder / "avatar.safetensors")
            artifact.flush_tree(folder)

        stored, look = least(repeats, publish, lambda: require_finite_files(folder, ""))
        yield Cost(
            "publishing: every array file of a version (avatar)", stored, look / stored, True, "the last net"
        )

        def write() -> None:
            write_poses(folder / "poses.parquet", poses)

        from pipeline.body import poses as module

        def unguarded() -> None:
            with without(module, "rows_not_finite", lambda values: []):
                write()

        guarded, bare = least(repeats, write, unguarded)
        yield Cost(
            "tables: poses of 2,000 frames", bare, guarded / bare - 1, True, "NaN was published before"
        )
        columns = {"value": np.zeros((2000, 133 * 3), np.float32)}
        schema = tables.pa.schema([("value", tables.vectors(133 * 3))])

        def table() -> None:
            tables.write_table(folder / "t.parquet", schema, columns)

        def untold() -> None:
            with without(tables, "_require_finite", lambda *arguments: None):
                table()

        guarded, bare = least(repeats, table, untold)
        yield Cost("tables: 2,000 frames of 133 points", bare, guarded / bare - 1, True, "readers rely on it")


def precision(repeats: int) -> Iterator[Cost]:
    """Where float64 is computed in, and what float32 would have been off."""
    generator = torch.Generator().manual_seed(0)
    image = torch.full((512, 512, 3), 0.7)
    truth = (image + 0.01 * torch.rand(image.shape, generator=generator)).clamp(0, 1)
    wide, narrow = least(repeats, lambda: ssim(image, truth), lambda: single_ssim(image, truth))
    off = abs(ssim(image, truth) - single_ssim(image, truth))
    yield Cost(
        "SSIM of a flat image in float64", narrow, wide / narrow - 1, True, f"float32 is {off:.1e} off"
    )


def single_ssim(image: Tensor, truth: Tensor) -> float:
    """``pipeline.metrics.ssim`` with float32 throughout."""
    x, y = image.numpy(), truth.numpy()

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (11, 11), 1.5, borderType=cv2.BORDER_REFLECT_101)

    mx, my = mean(x), mean(y)
    variances = mean(x * x) - mx**2 + mean(y * y) - my**2
    covariance = mean(x * y) - mx * my
    c1, c2 = np.float32(0.01**2), np.float32(0.03**2)
    return float(
        ((2 * mx * my + c1) * (2 * covariance + c2) / ((mx**2 + my**2 + c1) * (variances + c2))).mean()
    )


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("stability", __doc__, measure, arguments, threads=1)


if __name__ == "__main__":
    sys.exit(main())
