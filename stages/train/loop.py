"""The training loop: draw, decode, pose, render, compare, step."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pipeline.avatar import Avatar, Decoded, Posed
from pipeline.avatar.canonical import HANDS
from pipeline.errors import UserError
from pipeline.metrics.image import psnr
from pipeline.splat import render
from stages.train import losses, schedule
from stages.train.checkpoint import Checkpoint, gather, restore
from pipeline.curves import Curve
from stages.train.data import Frames
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings

BETAS, EPSILON = (0.9, 0.99), 1e-15
TRANSL_RATE = 0.1  # of the pose's learning rate: a translation moves every pixel at once
Terms = dict[str, Tensor]


class Trainer:
    """An avatar in training, its optimisers and its curve.

    Attributes:
        avatar: what is trained.
        poses: the frames' poses, refined along the way.
        curve: what has happened so far.
        iteration: optimiser steps done.
    """

    def __init__(
        self,
        avatar: Avatar,
        poses: PoseRefinement,
        views: Frames,
        frames: tuple[int, ...],
        settings: TrainSettings,
    ):
        """Starts at iteration 0.

        Args:
            avatar: untrained.
            poses: fitted.
            views: crops of the training frames.
            frames: the training frames' numbers.
            settings: of the stage.
        """
        self.avatar, self.poses, self.settings = avatar, poses, settings
        self.views, self.frames = views, frames
        self.curve, self.iteration = Curve(), 0
        self._avatar_optimizer, self._pose_optimizer = _optimizers(avatar, poses, settings)
        self._update_phase()

    def step(self) -> dict[str, float]:
        """One optimiser step; returns the weighted loss terms.

        Raises:
            UserError: if a term is not finite; nothing has been changed then.
        """
        self._update_phase()
        terms = self._objective()
        values = {name: float(term.detach()) for name, term in terms.items()}
        for name, value in values.items():
            if not math.isfinite(value):
                raise UserError(
                    f"training stopped: loss term '{name}' is {value} at iteration {self.iteration}; "
                    f"try a smaller train.learning_rate (now {self.settings.learning_rate:g})"
                )
        for optimizer in (self._avatar_optimizer, self._pose_optimizer):
            optimizer.zero_grad(set_to_none=True)
        torch.stack(list(terms.values())).sum().backward()
        self._avatar_optimizer.step()
        if self._poses_move():
            self._pose_optimizer.step()
        self.curve.count(values)
        self.iteration += 1
        return values

    @property
    def level(self) -> int:
        """The level of subdivision that is trained now."""
        fine = schedule.reached(self.settings, self.settings.subdivide_from, self.iteration)
        return self.settings.subdivisions if fine else 0

    def held_out(self, views: Frames, frames: tuple[int, ...]) -> float:
        """Mean PSNR of the person on black in uncropped frames, at their fitted poses, dB.

        Of the level of subdivision that is trained now: the finer one is not ready before its time.
        """
        values = []
        with torch.no_grad():
            decoded = self.avatar.decode(self.level)
            for frame in frames:
                view, pose = views[frame], self.poses.fitted(frame)
                posed = self.avatar.pose(decoded, pose.rotation, pose.expression, pose.transl)
                color = render(posed.gaussians, view.camera).color
                values.append(psnr(color.clamp(0, 1), view.composite(torch.zeros(3))))
        return sum(values) / len(values)

    def checkpoint(self, key: str) -> Checkpoint:
        """All of the state.

        Raises:
            UserError: if any of it is not finite.
        """
        self.require_finite()
        tensors = gather(self._modules(), (self._avatar_optimizer, self._pose_optimizer))
        return Checkpoint(self.iteration, key, tensors, self.curve.state())

    def resume(self, checkpoint: Checkpoint) -> None:
        """Goes back to where ``checkpoint`` was taken."""
        restore(checkpoint.tensors, self._modules(), (self._avatar_optimizer, self._pose_optimizer))
        self.curve, self.iteration = Curve.restored(checkpoint.extra), checkpoint.iteration
        self._update_phase()

    def require_finite(self) -> None:
        """Refuses to go on with a parameter that is not finite, however it came to be so.

        Raises:
            UserError: naming the parameter and the iteration.
        """
        for prefix, module in self._modules().items():
            for name, tensor in module.state_dict().items():
                if not bool(torch.isfinite(tensor).all()):
                    raise UserError(
                        f"training stopped: {prefix}.{name} is not finite after iteration {self.iteration}; "
                        f"try a smaller train.learning_rate (now {self.settings.learning_rate:g})"
                    )

    def _modules(self) -> dict[str, torch.nn.Module]:
        return {"avatar": self.avatar, "poses": self.poses}

    def _poses_move(self) -> bool:
        settings = self.settings
        return settings.refine_poses and schedule.reached(settings, settings.refine_from, self.iteration)

    def _update_phase(self) -> None:
        settings = self.settings
        late = settings.pose_heads_from < 1
        self.avatar.pose_heads_active = late and schedule.reached(
            settings, settings.pose_heads_from, self.iteration
        )
        factor = schedule.rate_factor(settings, self.iteration)
        for optimizer in (self._avatar_optimizer, self._pose_optimizer):
            for group in optimizer.param_groups:
                group["lr"] = group["base_rate"] * factor

    def _objective(self) -> Terms:
        """The weighted terms of this iteration, averaged over its frames."""
        decoded = self.avatar.decode(self.level)
        per_frame = [self._frame_terms(decoded, place) for place in range(self.settings.batch)]
        terms = {name: torch.stack([one[name] for one in per_frame]).mean() for name in per_frame[0]}
        return {**terms, **self._static_terms(decoded)}

    def _frame_terms(self, decoded: Decoded, place: int) -> Terms:
        settings = self.settings
        position = self.iteration * settings.batch + place
        frame = schedule.drawn_frame(settings.seed, self.frames, position)
        background = schedule.drawn_background(settings.seed, position)
        view = self.views[frame]
        pose = self.poses(frame) if self._poses_move() else self.poses.fitted(frame)
        noise = self._pose_noise(position)
        posed = self.avatar.pose(decoded, pose.rotation, pose.expression, pose.transl, noise)
        rendering = render(posed.gaussians, view.camera)
        image, target = losses.over(rendering.color, rendering.alpha, background), view.composite(background)
        terms = {
            "l1": settings.l1 * losses.l1(image, target),
            "ssim": settings.ssim * losses.ssim(image, target),
            **self._posed_terms(decoded, posed),
        }
        if settings.pose_change and self._poses_move():
            terms["pose_change"] = settings.pose_change * self.poses.change(frame)
        return terms

    def _pose_noise(self, position: int) -> Tensor:
        settings, length = self.settings, 6 * (self.poses.poses.rotation.shape[1] - 1)
        return settings.pose_noise * schedule.drawn_noise(settings.seed, position, length)

    def _posed_terms(self, decoded: Decoded, posed: Posed) -> Terms:
        settings, neighbours, gaussians = self.settings, decoded.surface.neighbours, posed.gaussians
        terms = {
            "laplacian_scale": settings.laplacian_scale * losses.laplacian(posed.log_scale, neighbours),
            "laplacian_color": settings.laplacian_color * losses.laplacian(gaussians.colors, neighbours),
            "scale_size": settings.scale_size * losses.size(gaussians.scales),
        }
        if posed.pose_offset is not None:
            smoothness = losses.laplacian(posed.pose_offset, neighbours)
            terms["laplacian_pose_offset"] = settings.laplacian_offset * smoothness
            terms["pose_offset"] = settings.pose_offset * losses.size(posed.pose_offset)
        return terms

    def _static_terms(self, decoded: Decoded) -> Terms:
        settings, offset = self.settings, decoded.offset
        hands = decoded.surface.canonical.is_part(*HANDS)
        smoothness = losses.laplacian(offset, decoded.surface.neighbours)
        return {
            "laplacian_offset": settings.laplacian_offset * smoothness,
            "offset": settings.offset * losses.size(offset),
            "hand_offset": settings.hand_offset * losses.size(offset, hands),
        }


def _optimizers(
    avatar: Avatar, poses: PoseRefinement, settings: TrainSettings
) -> tuple[torch.optim.Adam, torch.optim.Adam]:
    """One optimiser for the avatar and one for the poses; ``base_rate`` is what the schedule scales."""
    planes = list(avatar.triplane.parameters())
    rest = [parameter for name, parameter in avatar.named_parameters() if not name.startswith("triplane.")]
    rate = settings.pose_learning_rate
    angles = [*poses.rotation.parameters(), *poses.expression.parameters()]
    return (
        _adam([(planes, settings.plane_learning_rate), (rest, settings.learning_rate)]),
        _adam([(angles, rate), (list(poses.transl.parameters()), rate * TRANSL_RATE)]),
    )


def _adam(groups: list[tuple[list[torch.nn.Parameter], float]]) -> torch.optim.Adam:
    described = [{"params": parameters, "lr": rate, "base_rate": rate} for parameters, rate in groups]
    # The fused kernel is ten times faster on a CPU than the loop over tensors.
    return torch.optim.Adam(described, betas=BETAS, eps=EPSILON, fused=True)


def describe(values: dict[str, float]) -> str:
    """The note beside the progress bar."""
    return f"loss {sum(values.values()):.4f}"


def point_values(trainer: Trainer, psnr_db: float | None) -> dict[str, float]:
    """What a point of the curve holds besides the loss terms."""
    values = {
        "gaussians": float(len(trainer.avatar.surfaces[trainer.level].canonical)),
        "learning_rate": trainer.settings.learning_rate
        * schedule.rate_factor(trainer.settings, trainer.iteration),
    }
    return values if psnr_db is None else {**values, "psnr": psnr_db}
