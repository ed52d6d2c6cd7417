"""The training loop: draw, decode, pose, render, compare, step."""

from __future__ import annotations

import math

import torch

from pipeline.avatar import Avatar
from pipeline.clip.curves import Curve
from pipeline.device import moved
from pipeline.finite import NotFiniteError, finite, require_finite
from pipeline.metrics import Lpips
from pipeline.metrics.psnr import psnr
from pipeline.splat import render
from stages.train import schedule
from stages.train.checkpoint import Checkpoint, gather, restore
from stages.train.data import TrainingData
from stages.train.objective import Objective
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings
from stages.train.visibility_gate import VisibilityGate

BETAS, EPSILON = (0.9, 0.99), 1e-15
TRANSL_RATE = 0.1  # of the pose's learning rate: a translation moves every pixel at once


class Trainer:
    """An avatar in training, its optimisers and its curve.

    Attributes:
        avatar: what is trained.
        poses: the frames' poses, refined along the way.
        gate: which of the avatar is seen often enough to be trained; None where nothing is gated.
        curve: what has happened so far.
        iteration: optimiser steps done.
        untrained: mean PSNR of some frames before the first step, dB; None while nobody has looked.
    """

    def __init__(
        self,
        avatar: Avatar,
        poses: PoseRefinement,
        data: TrainingData,
        settings: TrainSettings,
        network: Lpips | None = None,
        gate: VisibilityGate | None = None,
    ):
        """Starts at iteration 0.

        Args:
            avatar: untrained.
            poses: fitted.
            data: the training frames.
            settings: of the stage.
            network: LPIPS, if it has a weight.
            gate: counts what is seen, and gates the rest; None leaves all of the avatar active.
        """
        self.avatar, self.poses, self.settings, self.gate = avatar, poses, settings, gate
        self.data, self.objective = data, Objective(avatar, poses, data, settings, network)
        self.objective.on_frame = None if gate is None else gate.count
        self.curve, self.iteration = Curve(), 0
        self.untrained: float | None = None
        self._avatar_optimizer, self._pose_optimizer = _optimizers(avatar, poses, settings)
        self._parameters = [
            (f"{prefix}.{name}", parameter)
            for prefix, module in self._modules().items()
            for name, parameter in module.named_parameters()
        ]
        self._update_phase()

    def step(self) -> dict[str, float]:
        """One optimiser step; returns the weighted loss terms.

        Raises:
            NotFiniteError: a term or a gradient is not finite; nothing has been changed then.
        """
        self._update_phase()
        terms = self.objective(self.iteration, self.level, self._poses_move())
        stacked = torch.stack(list(terms.values()))
        # All at once: each number that is asked for waits for the GPU.
        values = dict(zip(terms, stacked.detach().cpu().tolist(), strict=True))
        for name, value in values.items():
            if not math.isfinite(value):
                raise NotFiniteError(
                    f"training stopped: loss term '{name}' is {value} {self._where}; {self._remedy}"
                )
        for optimizer in (self._avatar_optimizer, self._pose_optimizer):
            optimizer.zero_grad(set_to_none=True)
        stacked.sum().backward()
        self._require_finite_gradients()
        self._avatar_optimizer.step()
        if self._poses_move():
            self._pose_optimizer.step()
        self.curve.count(values)
        self.iteration += 1
        if self.gate is not None and self.gate.due(self.iteration):
            self.gate.update()
        if self.settings.skinning == "nearest" and self.iteration % self.settings.skin_every == 0:
            self.avatar.reskin()
        return values

    @property
    def level(self) -> int:
        """The level of subdivision that is trained now."""
        fine = schedule.reached(self.settings, self.settings.subdivide_from, self.iteration)
        return self.settings.subdivisions if fine else 0

    def held_out(self, frames: tuple[int, ...]) -> float:
        """Mean PSNR of the person on black in uncropped frames, at their fitted poses, dB.

        Of the level of subdivision that is trained now: the finer one is not ready before its time.
        """
        values = []
        with torch.no_grad():
            decoded = self.avatar.decode(self.level)
            for frame in frames:
                view, pose = moved(self.data.whole[frame], self.avatar.device), self.poses.fitted(frame)
                time = self.data.clip.seconds.get(frame)
                posed = self.avatar.pose(decoded, pose, time=time)
                color = render(posed.gaussians, view.camera).color
                values.append(psnr(color.clamp(0, 1), view.composite(color.new_zeros(3))))
        return sum(values) / len(values)

    def checkpoint(self, key: str) -> Checkpoint:
        """A checkpoint with all of the state.

        Raises:
            NotFiniteError: any of it is not finite.
        """
        self.require_finite()
        tensors = gather(self._modules(), (self._avatar_optimizer, self._pose_optimizer))
        return Checkpoint(self.iteration, key, tensors, {**self.curve.state(), "untrained": self.untrained})

    def resume(self, checkpoint: Checkpoint) -> None:
        """Restores the state of a checkpoint."""
        restore(checkpoint.tensors, self._modules(), (self._avatar_optimizer, self._pose_optimizer))
        self.avatar.apply_skin()
        self.curve, self.iteration = Curve.restored(checkpoint.extra), checkpoint.iteration
        self.untrained = checkpoint.extra.get("untrained")
        self._update_phase()

    def require_finite(self) -> None:
        """Refuses to go on with a parameter that is not finite.

        Raises:
            NotFiniteError: naming the parameter and the iteration.
        """
        state = {
            f"{prefix}.{name}": tensor
            for prefix, module in self._modules().items()
            for name, tensor in module.state_dict().items()
        }
        require_finite(state, "training", f"after iteration {self.iteration}", self._remedy)

    def _require_finite_gradients(self) -> None:
        """Refuses gradients that are not finite: a finite loss may have them, and Adam would spread them."""
        found = [(name, weight.grad) for name, weight in self._parameters if weight.grad is not None]
        if not finite(gradient for _, gradient in found):
            named = {f"the gradient of {name}": gradient for name, gradient in found}
            require_finite(named, "training", self._where, self._remedy)

    @property
    def _where(self) -> str:
        """The present iteration and frames in words, for messages."""
        batch = self.settings.batch
        frames = [self.objective.draw(self.iteration * batch + place).frame for place in range(batch)]
        numbers = ", ".join(map(str, frames))
        return f"at iteration {self.iteration}, frame{'s' if len(frames) > 1 else ''} {numbers}"

    @property
    def _remedy(self) -> str:
        return (
            f"try a smaller train.learning_rate (now {self.settings.learning_rate:g}); the last checkpoint "
            "is kept, nothing is published"
        )

    def _modules(self) -> dict[str, torch.nn.Module]:
        modules: dict[str, torch.nn.Module] = {
            "avatar": self.avatar, "poses": self.poses,
            "visibility_cache": self.objective.visibility_cache,
        }  # fmt: skip
        return modules if self.gate is None else {**modules, "gate": self.gate}

    def _poses_move(self) -> bool:
        settings = self.settings
        return settings.refine_poses and schedule.reached(settings, settings.refine_from, self.iteration)

    def _update_phase(self) -> None:
        settings = self.settings
        self.avatar.pose_heads_active = schedule.begun(settings, settings.pose_heads_from, self.iteration)
        self.avatar.residuals_active = schedule.begun(settings, settings.residual_from, self.iteration)
        factor = schedule.rate_factor(settings, self.iteration)
        for optimizer in (self._avatar_optimizer, self._pose_optimizer):
            for group in optimizer.param_groups:
                group["lr"] = group["base_rate"] * factor


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
    # The fused kernel is ten times faster on a CPU than the loop over tensors; CUDA has one, too.
    return torch.optim.Adam(described, betas=BETAS, eps=EPSILON, fused=True)


def describe(values: dict[str, float]) -> str:
    """The note beside the progress bar."""
    return f"loss {sum(values.values()):.4f}"


def point_values(trainer: Trainer, psnr_db: float | None) -> dict[str, float]:
    """The values of a point of the curve besides the loss terms."""
    values = {
        "gaussians": float(len(trainer.avatar.surface(trainer.level).canonical)),
        "learning_rate": trainer.settings.learning_rate
        * schedule.rate_factor(trainer.settings, trainer.iteration),
    }
    return values if psnr_db is None else {**values, "psnr": psnr_db}
