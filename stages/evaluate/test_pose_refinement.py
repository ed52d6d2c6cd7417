"""Test-time pose refinement: held-out poses fitted to the held-out images themselves (Section 4.1).

The protocol of the NeuMan benchmark: the networks are frozen, and of each held-out frame rotation,
expression and translation move, driven by that image alone. It tells the avatar's own error from the
fit's, and it has looked at the answer: its numbers stand beside those at the fit's poses and never replace
them. The method that shows the refined poses is an ``AvatarMethod`` of the name ``REFINED``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from pipeline.body import Pose, Poses, write_poses
from pipeline.clip.composite import BACKGROUNDS, over
from pipeline.metrics.ssim import rounded_gaussian_window, ssim_loss
from pipeline.splat import render
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.methods import Animate

PictureLoss = Callable[[Tensor, Tensor], Tensor]
"""A scalar of two images, [H, W, 3] each."""

EFFECT = "test_time_refinement"  # the plan's name of it

L1_WEIGHT, SSIM_WEIGHT = 0.8, 0.2  # Equation 9
LEARNING_RATE = 1e-3  # radians, units of expression and metres a step
DECAYS = (0.75, 0.95)  # shares of the steps after which a step is a tenth as long, as ExAvatar does


@dataclasses.dataclass(frozen=True)
class RefinedTestPoses:
    """The refined poses of the held-out frames.

    Attributes:
        poses: held-out frame -> its pose; the fit's where refinement stopped. Empty where none was asked for.
        stopped: the frames whose loss or gradient was not finite.
        steps: a frame.
    """

    poses: Mapping[int, Pose]
    stopped: tuple[int, ...]
    steps: int


NOT_REFINED = RefinedTestPoses({}, (), 0)


def refine(
    clip: EvaluatedClip,
    animate: Animate,
    background: str,
    steps: int,
    advance: Callable[[], object],
    perceptual: PictureLoss | None = None,
    frames: Sequence[int] | None = None,
) -> RefinedTestPoses:
    """Refines the poses of held-out frames.

    Args:
        clip: the clip.
        animate: a pose -> Gaussians, with gradients that reach the pose alone.
        background: what both images are composited on.
        steps: a frame.
        advance: called after each frame.
        perceptual: a further loss of two images, weighted; the paper's L_lpips.
        frames: which of them; all by default.
    """
    poses: dict[int, Pose] = {}
    stopped = []
    for frame in clip.split.test if frames is None else frames:
        fitted = clip.pose(frame)
        refined = refined_pose(frame_loss(clip, animate, background, frame, perceptual), fitted, steps)
        if refined is None:
            stopped.append(frame)
        poses[frame] = refined or fitted
        advance()
    return RefinedTestPoses(poses, tuple(stopped), steps)


def frame_loss(
    clip: EvaluatedClip,
    animate: Animate,
    background: str,
    frame: int,
    perceptual: PictureLoss | None = None,
) -> Callable[[Pose], Tensor]:
    """The image loss of a frame as a function of its pose."""
    camera, seconds = clip.camera(frame), clip.seconds.get(frame)
    truth = clip.person(frame, background)

    def loss(pose: Pose) -> Tensor:
        rendering = render(animate(pose, seconds), camera)
        image = over(rendering.color, rendering.alpha, background)
        plain = image_loss(image, truth.to(image), BACKGROUNDS[background])
        return plain if perceptual is None else plain + perceptual(image, truth.to(image))

    return loss


def image_loss(image: Tensor, truth: Tensor, background: float = 0.0) -> Tensor:
    """``0.8 L1 + 0.2 (1 - SSIM)`` of two images [H, W, 3], scalar: what of Equation 9 needs no network."""
    dissimilar = ssim_loss(image, truth, background, rounded_gaussian_window())
    return L1_WEIGHT * (image - truth).abs().mean() + SSIM_WEIGHT * dissimilar


def refined_pose(loss: Callable[[Pose], Tensor], fitted: Pose, steps: int) -> Pose | None:
    """The pose of least loss that Adam meets, the fitted one included.

    Args:
        loss: pose -> scalar.
        fitted: where it starts.
        steps: how many.

    Returns:
        The pose; None where the loss or its gradient was not finite.
    """
    pose = _copy(fitted)
    parts = _parts(pose)
    for part in parts:
        part.requires_grad_()
    optimiser = torch.optim.Adam(parts, LEARNING_RATE)
    decays = [max(1, int(share * steps)) for share in DECAYS]
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimiser, decays, 0.1)
    least, best = float("inf"), fitted
    for step in range(steps + 1):
        value = loss(pose)
        # A renderer leaves out what is not finite, so that the loss may not show it.
        if not _finite(value, *parts):
            return None
        if value.item() < least:
            least, best = value.item(), _copy(pose)
        if step == steps:
            break
        optimiser.zero_grad()
        value.backward()
        # What the image has no say in, such as an expression that the avatar lacks, has no gradient.
        if not _finite(*(part.grad for part in parts if part.grad is not None)):
            return None
        optimiser.step()
        schedule.step()
    return best


def write_refined(path: Path, refined: RefinedTestPoses) -> None:
    """Writes ``test_poses.parquet``: the refined poses in the layout of ``poses.parquet``.

    ``valid`` is true where a frame was refined.
    """
    frames = tuple(sorted(refined.poses))
    poses = Poses.stack(frames, [refined.poses[frame] for frame in frames])
    valid = torch.tensor([frame not in refined.stopped for frame in frames])
    write_poses(path, dataclasses.replace(poses, valid=valid))


def _parts(pose: Pose) -> tuple[Tensor, ...]:
    return pose.rotation, pose.expression, pose.transl


def _copy(pose: Pose) -> Pose:
    return Pose(*(part.detach().clone() for part in _parts(pose)))


def _finite(*tensors: Tensor) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in tensors)
