"""One training step, part by part, beside the straightforward implementation of the same model.

Holds: docs/results.md, "A training step and a frame of animation", and what issue 17 wants faster. Parts are
triplane, heads, skinning, rendering, losses, regularisers, forward and backward, and Adam. All contestants
start from the same weights (``straightforward.py``), and before anything is timed their images and gradients
are compared. They take turns in one process. All have the fast rasterizer, SSIM and regularisers: what
differs is the model's own arithmetic, and Adam's.

"ours" asks the pose heads only for the Gaussians that the frame shows, as training does under
``train.pose_seen_only``; the others would get no gradient from it. "ours, all" asks them for every Gaussian.

"bases" is the other representation, as many Gaussians with parameters and linear bases of their own, posed
in one pass; "bases, step by step" is its plain twin. They are compared with each other.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys

import torch
from torch import Tensor, nn

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
from benchmarks.parts import PartClock
from benchmarks.straightforward import StraightforwardAvatar, matched_gradients
from pipeline.avatar import Avatar, Decoded, Posed
from pipeline.avatar.bases_representation import BasesRepresentation
from pipeline.body import Pose
from pipeline.clip.camera import Camera
from pipeline.clip.composite import over
from pipeline.device import moved
from pipeline.metrics import ssim_loss
from pipeline.splat import Rendering, render
from stages.train import losses
from stages.train.body_regions import unmixed

REST = "pose, skin"
PARTS = ("triplane", "static heads", "pose heads", REST, "render", "losses", "regularisers", "Adam")
STILL = 1e-9  # learning rate: every repetition does the same work
OURS, ALL, OURS_SINGLE, PLAIN = "ours", "ours, all", "ours float32", "straightforward"
BASES, TWIN = "bases", "bases, step by step"


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Compares and times every case."""
    counts, sizes, repeats = sizes_of(options, repeats=7)
    for count in counts:
        contestants, bases = contestants_of(count, options.clock), bases_of(count, options.clock)
        for size in sizes:
            avatar = contestants[0].model
            assert isinstance(avatar, Avatar)
            frames = frames_of(avatar, options.frames, size)
            for one in contestants[:-1]:
                image, gradient = difference(one, contestants[-1], frames)
                row = {"gaussians": len(avatar), "size": size, "contestant": one.name}
                report.add(row | {"image": image, "gradients": gradient}, f"apart from {PLAIN}")
            image, gradient = bases_difference(*bases, frames)
            row = {"gaussians": len(avatar), "size": size, "contestant": BASES}
            report.add(row | {"image": image, "gradients": gradient}, f"apart from {TWIN}")
            for row in race([*contestants, *bases], frames, repeats):
                report.add({"gaussians": len(avatar), "size": size, **row})
    count, size, case = chosen_case(report.tables["rows"])
    fastest = {row["contestant"]: row["step_ms"] for row in case}
    ratio, whole, single = (fastest[PLAIN] / fastest[name] for name in (OURS, ALL, OURS_SINGLE))
    triplane, twin = (fastest[name] / fastest[BASES] for name in (OURS, TWIN))
    return (
        f"{count} Gaussians at {size}²: {fastest[OURS]:.1f} ms; {PLAIN} takes {ratio:.2f} times ours "
        f"({whole:.2f} where every Gaussian is posed, {single:.2f} of these in float32); bases "
        f"{fastest[BASES]:.1f} ms: ours takes {triplane:.2f} times that, bases step by step {twin:.2f} times"
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    add_sizes(parser)
    parser.add_argument("--frames", type=int, default=1, help="frames a step")


@dataclasses.dataclass(frozen=True)
class Frame:
    """A frame to train on.

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
        clock: str = "wall",
    ):
        """Puts the clock on the model's parts.

        Args:
            name: for the table.
            model: the avatar.
            optimizer: of its parameters.
            shared: whether the frames of a step share one decode.
            seen: whether pose heads are asked only for the Gaussians that a frame shows.
            clock: of ``frame.CLOCKS``.
        """
        self.name, self.model, self.optimizer, self.shared, self.seen = name, model, optimizer, shared, seen
        self.clock = PartClock(REST, frame.CLOCKS[clock])
        networks = model.representation if isinstance(model, Avatar) else model
        if not isinstance(networks, BasesRepresentation):
            self.clock.watch("triplane", networks.triplane)
            self.clock.watch("static heads", networks.geometry, networks.color)
            self.clock.watch("pose heads", networks.pose_geometry, networks.pose_color)
        self._render = self.clock.timed("render", render)
        self._compare = self.clock.timed("losses", photometric)
        self._regularise = self.clock.timed("regularisers", regularisers)

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
        for place, one in enumerate(frames):
            if place and not self.shared:
                decoded = self.model.decode()
            posed = self.pose(decoded, one)
            rendering = self._render(posed.gaussians, one.camera)
            total = total + self._compare(rendering, one.target, one.background)
            if regularised:
                total = total + self._regularise(decoded, posed)
        return total / len(frames)

    def pose(self, decoded: Decoded, shown: Frame) -> Posed:
        """The frame's Gaussians."""
        if isinstance(self.model, Avatar) and self.seen:
            return self.model.pose(decoded, shown.pose, rows=shown.seen)
        return self.model.pose(decoded, shown.pose)


def photometric(rendering: Rendering, target: Tensor, background: Tensor) -> Tensor:
    """The loss of a picture, L1 and SSIM."""
    image = over(rendering.color, rendering.alpha, background)
    return 0.8 * losses.l1(image, target).mean() + 0.2 * ssim_loss(image, target)


def regularisers(decoded: Decoded, posed: Posed) -> Tensor:
    """The loss of a posed avatar, roughness and size."""
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
    """Random poses and random pictures, on the avatar's device."""
    generator, decoded = torch.Generator().manual_seed(2), avatar.decode()
    camera = moved(avatar_camera(size), avatar.device)
    frames = []
    for pose in moved(poses_of(avatar, count), avatar.device):
        target = torch.rand(size, size, 3, generator=generator)
        background = torch.rand(3, generator=generator)
        weights = render(avatar.pose(decoded, pose).gaussians, camera).weights
        drawn = moved((target, background), avatar.device)
        frames.append(Frame(pose, camera, *drawn, torch.nonzero(weights)[:, 0]))
    return frames


def contestants_of(count: int, clock: str) -> list[Contestant]:
    """The product in both precisions and the straightforward implementation, from the same weights."""
    half, whole = avatar_of(count), avatar_of(count)
    single = avatar_of(count, half_precision=False)
    plain = StraightforwardAvatar(single)
    return [
        Contestant(OURS, half, adam(half, fused=True), shared=True, seen=True, clock=clock),
        Contestant(ALL, whole, adam(whole, fused=True), shared=True, clock=clock),
        Contestant(OURS_SINGLE, single, adam(single, fused=True), shared=True, clock=clock),
        Contestant(PLAIN, plain, adam(plain, fused=False), shared=False, clock=clock),
    ]


def bases_of(count: int, clock: str) -> tuple[Contestant, Contestant]:
    """Linear bases in one pass and step by step, from the same weights."""
    fused, plain = bases_avatar_of(count), bases_avatar_of(count)
    plain.at_once = False
    both = ((BASES, fused), (TWIN, plain))
    made = [Contestant(name, one, adam(one, fused=True), shared=True, clock=clock) for name, one in both]
    return made[0], made[1]


def bases_difference(fused: Contestant, plain: Contestant, frames: list[Frame]) -> tuple[float, float]:
    """As ``difference``, of two avatars of bases."""
    images, gradients = [], []
    for one in (fused, plain):
        one.objective(frames).backward()
        gradients.append([parameter.grad for parameter in one.model.parameters()])
        one.model.zero_grad(set_to_none=True)
        with torch.no_grad():
            images.append(render(one.pose(one.model.decode(), frames[0]).gaussians, frames[0].camera).color)
    apart = [float((mine - theirs).norm() / theirs.norm()) for mine, theirs in zip(*gradients, strict=True)]
    return float((images[0] - images[1]).abs().mean()), max(apart)


def adam(model: nn.Module, fused: bool) -> torch.optim.Adam:
    """The optimiser of a contestant."""
    return torch.optim.Adam(model.parameters(), lr=STILL, betas=(0.9, 0.99), eps=1e-15, fused=fused)


def difference(ours: Contestant, plain: Contestant, frames: list[Frame]) -> tuple[float, float]:
    """Differences between two contestants in what they show and in what they learn.

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


def race(contestants: list[Contestant], frames: list[Frame], repeats: int) -> list[dict[str, object]]:
    """A row a contestant: the least milliseconds of each part and of the step, and the step's median."""

    def step(one: Contestant) -> dict[str, float]:
        one.step(frames)
        return {part: 1e3 * seconds for part, seconds in one.clock.spent.items()}

    taken = frame.in_turn({one.name: lambda one=one: step(one) for one in contestants}, repeats)
    rows, ours = [], None
    for name, steps in taken.items():
        totals = [sum(one.values()) for one in steps]
        ours = ours or min(totals)
        parts = {part: min(one.get(part, 0.0) for one in steps) for part in PARTS}
        whole = {"step_ms": min(totals), "median_ms": statistics.median(totals), "x ours": min(totals) / ours}
        rows.append({"contestant": name, **parts, **whole, "steps": steps})
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("step", __doc__, measure, arguments, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
