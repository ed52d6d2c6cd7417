"""One training step, part by part: ``python -m benchmarks.step [--quick] [--json FILE] [--threads N]``.

Decode, pose heads, skinning, rendering, losses, regularisers, their backward passes and Adam, beside the
straightforward implementation of the same model (``straightforward.py``). All start from the same weights,
and before anything is timed their images and their gradients are compared. They take turns in one process, so
that what else the machine does falls on all. All have the fast rasterizer, SSIM and regularisers, and the
allocator's settings: what differs is the model's own arithmetic, and Adam's.

"ours" asks the pose heads only for the Gaussians that the frame shows, as training does under
``train.pose_seen_only``, as known from the last time that the frame was drawn; the others would get no
gradient from it. "ours, all" asks them for every Gaussian.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from benchmarks.avatars import avatar_camera, avatar_of, poses_of
from benchmarks.machine import described, prepare
from benchmarks.parts import PartClock
from benchmarks.straightforward import StraightforwardAvatar, matched_gradients
from pipeline.avatar import Avatar, Decoded, Posed
from pipeline.body import Pose
from pipeline.clip.camera import Camera
from pipeline.clip.composite import over
from pipeline.metrics import ssim_loss
from pipeline.splat import Rendering, render
from stages.train import losses
from stages.train.regularisers import unmixed

COUNTS, SIZES = (10_000, 40_000, 167_000), (256, 512)
QUICK_COUNTS, QUICK_SIZES = (10_000,), (256,)
HEADLINE = (40_000, 512)
REST = "pose, skin"
PARTS = ("triplane", "static heads", "pose heads", REST, "render", "losses", "regularisers", "Adam")
STILL = 1e-9  # learning rate: every repetition does the same work
CLOCKS = ("wall", "cpu")
OURS, ALL, OURS_SINGLE, PLAIN = "ours", "ours, all", "ours float32", "straightforward"


@dataclasses.dataclass(frozen=True)
class Timing:
    """Milliseconds of one contestant's steps.

    Attributes:
        contestant: its name.
        gaussians: their number.
        size: pixels along a side of the picture.
        steps: for every step and part the wall-clock and the CPU time.
    """

    contestant: str
    gaussians: int
    size: int
    steps: tuple[dict[str, tuple[float, float]], ...]

    def part(self, part: str, clock: int) -> float:
        """The least of a part's times."""
        return min(step.get(part, (0.0, 0.0))[clock] for step in self.steps)

    def totals(self, clock: int) -> list[float]:
        """Every step's time."""
        return [sum(times[clock] for times in step.values()) for step in self.steps]


def main(arguments: list[str] | None = None) -> None:
    """Time, print a table a case and one headline line."""
    options = _options(arguments)
    if arguments is None:
        prepare("benchmarks.step", options.threads)
    counts, sizes = (QUICK_COUNTS, QUICK_SIZES) if options.quick else (COUNTS, SIZES)
    counts, sizes = options.gaussians or counts, options.sizes or sizes
    clock = CLOCKS.index(options.clock)
    print(f"{described()}; ms of {options.clock} time, {options.frames} frame(s) a step")
    timings: list[Timing] = []
    for count in counts:
        contestants = contestants_of(count)
        for size in sizes:
            avatar = contestants[0].model
            assert isinstance(avatar, Avatar)
            frames = frames_of(avatar, options.frames, size)
            print(_agreement(contestants, frames))
            timings += _race(contestants, frames, options.repeats or (2 if options.quick else 7))
            for line in _table(timings[-len(contestants) :], clock):
                print(line, flush=True)
    if options.json is not None:
        record = {"unit": "ms", "clocks": CLOCKS, "timings": [dataclasses.asdict(one) for one in timings]}
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    print(_headline(timings, clock))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.step", description="Time a training step.")
    parser.add_argument("--quick", action="store_true", help="one small case, few repeats")
    parser.add_argument("--repeats", type=int, help="steps of each contestant in each case")
    parser.add_argument("--gaussians", type=int, nargs="+", metavar="N", help="the counts to time")
    parser.add_argument("--sizes", type=int, nargs="+", metavar="PIXELS", help="the pictures to time")
    parser.add_argument("--frames", type=int, default=1, help="frames a step")
    parser.add_argument("--threads", type=int, default=0, help="of torch and numba; 0 for all")
    parser.add_argument("--clock", choices=CLOCKS, default="wall", help="cpu: on a machine that is busy")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every single time there")
    return parser.parse_args(arguments)


@dataclasses.dataclass(frozen=True)
class Frame:
    """What one rendering is compared with.

    Attributes:
        pose: of the body.
        camera: of the picture.
        target: [H, W, 3], here random.
        background: [3].
        seen: [M] int64, the Gaussians that have a part in the picture.
    """

    pose: Pose
    camera: Camera
    target: Tensor
    background: Tensor
    seen: Tensor  # [M]


class Contestant:
    """A model, its optimiser, and how it takes a step."""

    def __init__(
        self,
        name: str,
        model: Avatar | StraightforwardAvatar,
        optimizer: torch.optim.Optimizer,
        shared: bool,
        seen: bool = False,
    ):
        """Puts the clock on the model's parts.

        Args:
            name: for the table.
            model: the avatar.
            optimizer: of its parameters.
            shared: whether the frames of a step share one decode.
            seen: whether pose heads are asked only for the Gaussians that a frame shows.
        """
        self.name, self.model, self.optimizer, self.shared, self.seen = name, model, optimizer, shared, seen
        self.clock = PartClock(REST)
        networks = model.representation if isinstance(model, Avatar) else model
        self.clock.watch("triplane", networks.triplane)
        self.clock.watch("static heads", networks.geometry, networks.color)
        self.clock.watch("pose heads", networks.pose_geometry, networks.pose_color)
        self._render = self.clock.timed("render", render)
        self._compare = self.clock.timed("losses", _photometric)
        self._regularise = self.clock.timed("regularisers", _regularisers)

    def step(self, frames: list[Frame]) -> Tensor:
        """One optimiser step over the frames; returns the loss. The clock holds what it cost."""
        self.clock.start()
        loss = self.objective(frames)
        loss.backward()
        self.clock.enter("Adam")
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.clock.stop()
        return loss.detach()

    def objective(self, frames: list[Frame], regularised: bool = True) -> Tensor:
        """The loss, mean over the frames."""
        decoded = self.model.decode()
        total = torch.zeros(())
        for place, frame in enumerate(frames):
            if place and not self.shared:
                decoded = self.model.decode()
            posed = self.pose(decoded, frame)
            rendering = self._render(posed.gaussians, frame.camera)
            total = total + self._compare(rendering, frame.target, frame.background)
            if regularised:
                total = total + self._regularise(decoded, posed)
        return total / len(frames)

    def pose(self, decoded: Decoded, frame: Frame) -> Posed:
        """The frame's Gaussians."""
        if isinstance(self.model, Avatar) and self.seen:
            return self.model.pose(decoded, frame.pose, rows=frame.seen)
        return self.model.pose(decoded, frame.pose)


def _photometric(rendering: Rendering, target: Tensor, background: Tensor) -> Tensor:
    image = over(rendering.color, rendering.alpha, background)
    return 0.8 * losses.l1(image, target).mean() + 0.2 * ssim_loss(image, target)


def _regularisers(decoded: Decoded, posed: Posed) -> Tensor:
    neighbours, colors, pose_offset = decoded.surface.neighbours, posed.gaussians.colors, posed.pose_offset
    assert pose_offset is not None
    same = None if posed.rows is None else unmixed(posed.rows, neighbours, len(colors))

    def roughness(values: Tensor, mask: Tensor | None = None) -> Tensor:
        return losses.weighted_mean(losses.laplacian(values, neighbours), mask)

    smooth = (
        1e3 * roughness(decoded.offset)
        + 1e3 * roughness(pose_offset, same)
        + 0.02 * roughness(posed.log_scale, same)
        + 0.002 * roughness(colors, same)
    )
    sizes = (decoded.offset, pose_offset, posed.gaussians.scales)
    offset, pose, scale = (losses.l2(values).mean() for values in sizes)
    return smooth + 10 * offset + 50 * pose + 50 * scale


@torch.no_grad()
def frames_of(avatar: Avatar, count: int, size: int) -> list[Frame]:
    """Random poses and random pictures."""
    generator, camera, decoded = torch.Generator().manual_seed(2), avatar_camera(size), avatar.decode()
    frames = []
    for pose in poses_of(avatar, count):
        target = torch.rand(size, size, 3, generator=generator)
        background = torch.rand(3, generator=generator)
        weights = render(avatar.pose(decoded, pose).gaussians, camera).weights
        frames.append(Frame(pose, camera, target, background, torch.nonzero(weights)[:, 0]))
    return frames


def contestants_of(count: int) -> list[Contestant]:
    """The product in both precisions and the straightforward implementation, from the same weights."""
    half, whole = avatar_of(count), avatar_of(count)
    single = avatar_of(count, half_precision=False)
    plain = StraightforwardAvatar(single)
    return [
        Contestant(OURS, half, _adam(half, fused=True), shared=True, seen=True),
        Contestant(ALL, whole, _adam(whole, fused=True), shared=True),
        Contestant(OURS_SINGLE, single, _adam(single, fused=True), shared=True),
        Contestant(PLAIN, plain, _adam(plain, fused=False), shared=False),
    ]


def _adam(model: nn.Module, fused: bool) -> torch.optim.Adam:
    return torch.optim.Adam(model.parameters(), lr=STILL, betas=(0.9, 0.99), eps=1e-15, fused=fused)


def difference(ours: Contestant, plain: Contestant, frames: list[Frame]) -> tuple[float, float]:
    """How far the two are apart in what they show and in what they learn.

    Returns:
        the mean absolute difference between pixels of the first frame, of colours in [0, 1] (single pixels
        differ more, where a Gaussian is just beyond the rasterizer's cut-off in one of them), and the largest
        relative difference (Frobenius norms) between the gradients of any weights.
    """
    images = []
    for one in (ours, plain):
        one.model.zero_grad(set_to_none=True)
        # Where pose heads are asked for some only, regularisers see less: another objective.
        one.objective(frames, regularised=not ours.seen).backward()
        with torch.no_grad():
            posed = one.pose(one.model.decode(), frames[0])
            images.append(render(posed.gaussians, frames[0].camera).color)
    assert isinstance(ours.model, Avatar) and isinstance(plain.model, StraightforwardAvatar)
    apart = [
        float((mine - theirs).norm() / theirs.norm().clamp_min(1e-12))
        for mine, theirs in matched_gradients(ours.model, plain.model).values()
    ]
    for one in (ours, plain):
        one.model.zero_grad(set_to_none=True)
    return float((images[0] - images[1]).abs().mean()), max(apart)


def _agreement(contestants: list[Contestant], frames: list[Frame]) -> str:
    """One line: that all contestants do the same."""
    plain = contestants[-1]
    parts = []
    for one in contestants[:-1]:
        image, gradient = difference(one, plain, frames)
        parts.append(f"{one.name} image {image:.1e}, gradients {gradient:.1e}")
    return f"apart from {plain.name}, mean and relative: " + "; ".join(parts)


def _race(contestants: list[Contestant], frames: list[Frame], repeats: int) -> list[Timing]:
    """Everybody's steps, in turns."""
    steps: dict[str, list[dict[str, tuple[float, float]]]] = {one.name: [] for one in contestants}
    for repeat in range(repeats + 1):
        for one in contestants:
            one.step(frames)
            if repeat > 0:  # the first turn compiles and warms up
                spent = one.clock.spent.items()
                steps[one.name].append({part: (wall * 1e3, cpu * 1e3) for part, (wall, cpu) in spent})
    count = len(contestants[0].model.base_color)
    size = frames[0].camera.width
    return [Timing(name, count, size, tuple(taken)) for name, taken in steps.items()]


def _table(timings: list[Timing], clock: int) -> Iterator[str]:
    yield f"{timings[0].gaussians} Gaussians, {timings[0].size}²".ljust(26) + "".join(
        f"{timing.contestant:>18} share" for timing in timings
    )
    fastest = [min(timing.totals(clock)) for timing in timings]
    for part in PARTS:
        cells = [(timing.part(part, clock), total) for timing, total in zip(timings, fastest, strict=True)]
        yield f"{part:<26}" + "".join(f"{cell:18.1f} {cell / total:5.0%}" for cell, total in cells)
    yield f"{'step, fastest':<26}" + "".join(f"{total:18.1f}      " for total in fastest)
    medians = [statistics.median(timing.totals(clock)) for timing in timings]
    yield f"{'step, median':<26}" + "".join(f"{median:18.1f}      " for median in medians)
    yield f"{'times ours':<26}" + "".join(f"{total / fastest[0]:18.2f}      " for total in fastest) + "\n"


def _headline(timings: list[Timing], clock: int) -> str:
    """One line: the middle count at the larger size, or the last case that was timed."""
    cases: dict[tuple[int, int], dict[str, float]] = {}
    for timing in timings:
        case = cases.setdefault((timing.gaussians, timing.size), {})
        case[timing.contestant] = min(timing.totals(clock))
    wanted = [case for case in cases if abs(case[0] / HEADLINE[0] - 1) < 0.01 and case[1] == HEADLINE[1]]
    count, size = wanted[0] if wanted else list(cases)[-1]
    fastest = cases[count, size]
    ratio, whole, single = (fastest[PLAIN] / fastest[name] for name in (OURS, ALL, OURS_SINGLE))
    return (
        f"step: {count} Gaussians at {size}²: {fastest[OURS]:.1f} ms; {PLAIN} takes {ratio:.2f} times ours "
        f"({whole:.2f} where every Gaussian is posed, {single:.2f} of these in float32)"
    )


if __name__ == "__main__":
    main()
