"""What guards and precision cost: ``python -m benchmarks.stability [--quick] [--json FILE]``.

Processor time on one thread, with and without each, in turns in one process; the least of the repeats counts.
``benchmarks.drift`` is what the precisions of training come to.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.avatars import avatar_of
from benchmarks.fit_truth import load_stage, make_clips
from benchmarks.machine import described, prepare
from benchmarks.step import Contestant, _adam, frames_of
from pipeline.avatar import save_avatar
from pipeline.body import Poses, write_poses
from pipeline.files import tables
from pipeline.finite import finite, require_finite_files
from pipeline.metrics import ssim
from pipeline.store import artifact
from stages.fit import adam, parameters
from stages.fit.outlier_frames import mask_outlier_frames
from stages.fit.registration import register
from stages.fit.settings import FitSettings
from stages.ingest.mannequin import MannequinSpec

WORDS = {True: "kept", False: "dropped"}


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


def main(arguments: list[str] | None = None) -> None:
    """Time all, print the table and one headline line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.stability", description="What guards cost.")
    parser.add_argument("--quick", action="store_true", help="few repeats of small cases")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    options = parser.parse_args(arguments)
    if arguments is None:
        prepare("benchmarks.stability", 1)
    torch.set_num_threads(1)
    repeats = 2 if options.quick else 9
    print(f"{described()}; ms of processor time, the least of {repeats}")
    print(f"{'guard or precision':<58}{'without':>10}{'adds':>9}  ")
    costs = []
    for cost in (
        *training(options.quick, repeats),
        *fitting(options.quick, repeats),
        *files(repeats),
        *precision(repeats),
    ):
        costs.append(cost)
        print(
            f"{cost.what:<58}{cost.without:>10.2f}{cost.share:>9.2%}  {WORDS[cost.kept]}: {cost.why}",
            flush=True,
        )
    if options.json is not None:
        options.json.write_text(json.dumps([dataclasses.asdict(one) for one in costs], indent=1) + "\n")
    print(headline(costs))


def least(repeats: int, *jobs: Callable[[], object]) -> list[float]:
    """The least processor time of each job, milliseconds; they take turns."""
    spent: list[list[float]] = [[] for _ in jobs]
    for turn in range(repeats + 1):
        for job, times in zip(jobs, spent, strict=True):
            start = time.process_time()
            job()
            if turn:  # the first one compiles and warms up
                times.append(1e3 * (time.process_time() - start))
    return [min(times) for times in spent]


def training(quick: bool, repeats: int) -> Iterator[Cost]:
    """The gradients of a step, looked at in three ways, and the parameters."""
    avatar = avatar_of(2000 if quick else 10_000)
    contestant = Contestant("ours", avatar, _adam(avatar, fused=True), shared=True)
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
        with without(adam, "require_finite_gradient", lambda *arguments: None):
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


def headline(costs: list[Cost]) -> str:
    """One line."""
    of = {cost.what: cost.share for cost in costs}
    step = of["training: gradients, one sum, every step"] + of["training: parameters, every 250th step"]
    fit = of["fit: gradients, one sum, every step"] + of["fit: six numbers that are no rotation"]
    return f"stability: guards add {step:.2%} to a step of training and {fit:.1%} to a step of the fit"


if __name__ == "__main__":
    main()
