"""The training loop: draw, decode, pose, render, compare, step. All else is done by hooks (``hooks.py``)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from pipeline.avatar import Avatar
from pipeline.body import Pose
from pipeline.clip.views import View
from pipeline.finite import NotFiniteError, finite, require_finite
from pipeline.metrics import Lpips
from stages.train import schedule
from stages.train.checkpoint import Checkpoint, gather, restore
from stages.train.data import TrainingData
from stages.train.objective import TrainingObjective
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings, learning_rates

BETA1, EPSILON = 0.9, 1e-15


class Hook:
    """A hook that does nothing; each of its methods is called by the trainer.

    A checkpoint holds the parameters and buffers of a hook that is a ``torch.nn.Module``, and ``json_state``.
    """

    def on_start(self, trainer: Trainer) -> None:
        """Called before the first step of a process, after a checkpoint was restored."""

    def on_frame(self, pose: Pose, view: View) -> None:
        """Called with the pose in which a frame was rendered, and the frame."""

    def on_step(self, trainer: Trainer, terms: dict[str, float]) -> None:
        """Called after each step with the weighted loss terms; ``trainer.iteration`` counts the step."""

    def json_state(self) -> dict[str, Any]:
        """JSON values for a checkpoint."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """Takes back what ``json_state`` gave; an empty dict leaves everything as it is."""


class Trainer:
    """An avatar in training and its optimisers.

    Attributes:
        avatar: what is trained.
        poses: the frames' poses, refined along the way.
        data: what is learnt from.
        settings: of the stage.
        objective: what is minimised.
        hooks: called in their order; a checkpoint holds their state under their names.
        iteration: optimiser steps done.
    """

    def __init__(
        self,
        avatar: Avatar,
        poses: PoseRefinement,
        data: TrainingData,
        settings: TrainSettings,
        network: Lpips | None = None,
        hooks: Mapping[str, Hook] | None = None,
    ):
        """Starts at iteration 0.

        Args:
            avatar: untrained.
            poses: fitted.
            data: the training frames.
            settings: of the stage.
            network: LPIPS, if it has a weight.
            hooks: by name; more may be added before a checkpoint is restored.
        """
        self.avatar, self.poses, self.settings, self.data = avatar, poses, settings, data
        self.hooks: dict[str, Hook] = dict(hooks or {})
        self.objective = TrainingObjective(avatar, poses, data, settings, network, self._on_frame)
        self.iteration = 0
        self._avatar_optimizer, self._pose_optimizer = _optimizers(avatar, poses, settings)
        self._update_phase()

    def run(self) -> None:
        """Takes all steps that are left, hooks included.

        Raises:
            NotFiniteError: as of ``step``, or a parameter is not finite in the end.
        """
        for hook in self.hooks.values():
            hook.on_start(self)
        while self.iteration < self.settings.iterations:
            self.step()
        self.require_finite()

    def step(self) -> dict[str, float]:
        """The weighted loss terms of one optimiser step that it takes.

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
        self.iteration += 1
        for hook in self.hooks.values():
            hook.on_step(self, values)
        return values

    @property
    def level(self) -> int:
        """The level of subdivision that is trained now."""
        fine = schedule.reached(self.settings, self.settings.subdivide_from, self.iteration)
        return len(self.avatar.surfaces) - 1 if fine else 0

    def checkpoint(self, key: str) -> Checkpoint:
        """A checkpoint with all of the state.

        Raises:
            NotFiniteError: any of it is not finite.
        """
        self.require_finite()
        tensors = gather(self._modules(), (self._avatar_optimizer, self._pose_optimizer))
        extra = {name: hook.json_state() for name, hook in self.hooks.items()}
        return Checkpoint(self.iteration, key, tensors, extra)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Restores the state of a checkpoint, the hooks' included."""
        restore(checkpoint.tensors, self._modules(), (self._avatar_optimizer, self._pose_optimizer))
        self.avatar.apply_skin()
        self.iteration = checkpoint.iteration
        for name, hook in self.hooks.items():
            hook.restore(checkpoint.extra.get(name, {}))
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
        optimizers = (self._avatar_optimizer, self._pose_optimizer)
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        found = [weight.grad for group in groups for weight in group["params"] if weight.grad is not None]
        if not finite(found):  # names are asked for only then: there is a pose for every frame
            named = {
                f"the gradient of {prefix}.{name}": weight.grad
                for prefix, module in self._modules().items()
                for name, weight in module.named_parameters()
                if weight.grad is not None
            }
            require_finite(named, "training", self._where, self._remedy)

    @property
    def _where(self) -> str:
        """The present iteration and frames in words, for messages."""
        batch = self.settings.batch
        frames = [self.objective.draw(self.iteration * batch + place).frame for place in range(batch)]
        numbers = ", ".join(map(str, frames))
        return f"at iteration {self.iteration}, frame{'s' if len(frames) > 1 else ''} {numbers}"

    @property
    def _first_rate(self) -> str:
        name = learning_rates(self.settings)[0]
        return f"train.{name} (now {getattr(self.settings, name):g})"

    @property
    def _remedy(self) -> str:
        return f"try a smaller {self._first_rate}; the last checkpoint is kept, nothing is published"

    def _modules(self) -> dict[str, torch.nn.Module]:
        """Everything with state, by the prefix that its tensors have in messages and checkpoints."""
        own = {
            "avatar": self.avatar, "poses": self.poses,
            "visibility_cache": self.objective.visibility_cache,
        }  # fmt: skip
        return own | {name: hook for name, hook in self.hooks.items() if isinstance(hook, torch.nn.Module)}

    def _on_frame(self, pose: Pose, view: View) -> None:
        for hook in self.hooks.values():
            hook.on_frame(pose, view)

    def _poses_move(self) -> bool:
        settings = self.settings
        return settings.refine_poses and schedule.reached(settings, settings.refine_from, self.iteration)

    def _update_phase(self) -> None:
        """Switches on what the schedule says, and sets the learning rates."""
        settings = self.settings
        self.avatar.pose_heads_active = schedule.begun(settings, settings.pose_heads_from, self.iteration)
        self.avatar.residuals_active = schedule.begun(settings, settings.residual_from, self.iteration)
        self.avatar.residual_share = schedule.residual_share(settings, self.iteration)
        factor = schedule.rate_factor(settings, self.iteration)
        for optimizer in (self._avatar_optimizer, self._pose_optimizer):
            for group in optimizer.param_groups:
                group["lr"] = group["base_rate"] * factor


def _optimizers(
    avatar: Avatar, poses: PoseRefinement, settings: TrainSettings
) -> tuple[torch.optim.Adam, torch.optim.Adam]:
    """One optimiser for the avatar, one for poses and identity; ``base_rate`` is what the schedule scales."""
    groups = avatar.representation.parameter_groups()
    if avatar.opacity_logit is not None:
        groups["opacity_learning_rate"] = [avatar.opacity_logit]
    rate, beta2 = settings.pose_learning_rate, settings.adam_beta2
    angles = [*poses.rotation.parameters(), *poses.expression.parameters()]
    identity = [] if avatar.identity_change is None else list(avatar.identity_change.parameters())
    return (
        _adam([(parameters, getattr(settings, name)) for name, parameters in groups.items()], beta2),
        _adam(
            [([*angles, *identity], rate), (list(poses.transl.parameters()), rate * settings.transl_rate)],
            beta2,
        ),
    )


def _adam(groups: list[tuple[list[torch.nn.Parameter], float]], beta2: float) -> torch.optim.Adam:
    described = [{"params": parameters, "lr": rate, "base_rate": rate} for parameters, rate in groups]
    # The fused kernel is ten times faster on a CPU than the loop over tensors; CUDA has one, too.
    return torch.optim.Adam(described, betas=(BETA1, beta2), eps=EPSILON, fused=True)
