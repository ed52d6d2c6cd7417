"""Points of the training curve: held-out PSNR on the way, and a stop where training makes the avatar worse.

With learning rates a hundred times too high nothing overflows: GroupNorm and sigmoids bound what the heads
say, and Adam bounds the steps. The avatar is a ruin all the same, though every number in it is finite, and
must not be published.
"""

from __future__ import annotations

from typing import Any

import torch

from pipeline.clip.curves import Curve
from pipeline.device import moved
from pipeline.errors import UserError
from pipeline.metrics.psnr import psnr
from pipeline.splat import render
from stages.train import schedule
from stages.train.hooks import Log, describe
from stages.train.loop import Hook, Trainer
from stages.train.settings import TrainSettings, learning_rates
from stages.train.timer import TrainingTimer

# dB under the untrained avatar. Rates ten times too high lose 2 of a perfect start, a hundred times 7 to 19.
WORSE = 3.0
SEEN = 25.0  # dB from which on a difference is not a ruin: a made-up clip that starts at 37 dB may fall to 30
WATCHED = 3  # training frames that are looked at where none is held out


class HeldOutCurve(Hook):
    """The curve of a run: the mean loss terms since the last point, and PSNR of held-out frames.

    Attributes:
        curve: so far.
        untrained: mean PSNR of the watched frames before the first step, dB; None before a start.
    """

    def __init__(self, shown: tuple[int, ...], watched: tuple[int, ...], timer: TrainingTimer, log: Log):
        """An empty curve.

        Args:
            shown: held-out frames, whose PSNR is part of the curve; may be empty.
            watched: the frames that must not become much worse.
            timer: marked at each point, and paused while frames are rendered.
            log: for a line at each point.
        """
        self.curve = Curve()
        self.untrained: float | None = None
        self._shown, self._watched, self._timer, self._log = shown, watched, timer, log

    def on_start(self, trainer: Trainer) -> None:
        """Renders the untrained avatar."""
        if self.untrained is None:
            with self._timer.paused():
                self.untrained = held_out_psnr(trainer, self._watched)

    def on_step(self, trainer: Trainer, terms: dict[str, float]) -> None:
        """Counts the terms, and adds a point where it is time.

        Raises:
            NotFiniteError: a parameter is not finite.
            UserError: the avatar has become much worse than it was untrained.
        """
        self.curve.count(terms)
        settings, iteration = trainer.settings, trainer.iteration
        if iteration != settings.iterations and iteration % settings.held_out_every:
            return
        self._timer.mark(iteration)
        trainer.require_finite()
        with self._timer.paused():
            now = held_out_psnr(trainer, self._watched)
        if self.untrained is not None:
            require_progress(self.untrained, now, iteration, settings)
        values = {
            "gaussians": float(len(trainer.avatar.surface(trainer.level).canonical)),
            "learning_rate": getattr(settings, learning_rates(settings)[0])
            * schedule.rate_factor(settings, iteration),
        }
        note = ""
        if self._shown:
            values["psnr"], note = now, f", held-out PSNR {now:.2f} dB"
        self.curve.point(iteration, values)
        self._log(f"iteration {iteration}: {describe(terms)}{note}")

    def json_state(self) -> dict[str, Any]:
        """The curve and the untrained avatar's PSNR."""
        return {**self.curve.state(), "untrained": self.untrained}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from a checkpoint's curve."""
        if state:
            self.curve, self.untrained = Curve.restored(state), state["untrained"]


def held_out_psnr(trainer: Trainer, frames: tuple[int, ...]) -> float:
    """Mean PSNR of the person on black in uncropped frames, at their fitted poses, dB.

    Of the level of subdivision that is trained now: the finer one is not ready before its time.
    """
    avatar, values = trainer.avatar, []
    with torch.no_grad():
        decoded = avatar.decode(trainer.level)
        for frame in frames:
            view, pose = moved(trainer.data.whole[frame], avatar.device), trainer.poses.fitted(frame)
            posed = avatar.pose(decoded, pose, time=trainer.data.clip.seconds.get(frame))
            color = render(posed.gaussians, view.camera).color
            values.append(psnr(color.clamp(0, 1), view.composite(color.new_zeros(3))))
    return sum(values) / len(values)


def require_progress(untrained: float, now: float, iteration: int, settings: TrainSettings) -> None:
    """Refuses to go on with an avatar much worse than the fitted body in its initial colours.

    Args:
        untrained, now: PSNR of the same frames, dB.
        iteration: steps done.
        settings: of the stage.

    Raises:
        UserError: it is.
    """
    if now >= min(untrained - WORSE, SEEN):
        return
    rates = ", ".join(f"train.{name} (now {getattr(settings, name):g})" for name in learning_rates(settings))
    raise UserError(
        f"training stopped: after {iteration} iterations its pictures are worse than before the first, "
        f"{now:.1f} dB of {untrained:.1f}; try smaller {rates}; the last checkpoint is kept, nothing is "
        "published"
    )
