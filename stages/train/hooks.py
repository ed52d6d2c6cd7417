"""Hooks of the training loop: what happens beside the optimiser's steps, without the loop knowing of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pipeline.avatar.storage import save_preview
from pipeline.run.progress import Progress
from stages.train.checkpoint import write_checkpoint
from stages.train.loop import Hook, Trainer
from stages.train.timer import TrainingTimer

Log = Callable[[str], None]
"""Writes one line to the terminal."""


class NearestSkinning(Hook):
    """Gives Gaussians the skinning weights of the vertices that they have come to lie at, now and then."""

    def __init__(self, every: int):
        """A hook for every so many iterations."""
        self._every = every

    def on_step(self, trainer: Trainer, terms: dict[str, float]) -> None:
        """Looks for the nearest vertices where it is time."""
        if trainer.iteration % self._every == 0:
            trainer.avatar.reskin()


class Checkpoints(Hook):
    """Writes a checkpoint now and then, but for the last iteration, and the avatar so far beside it."""

    def __init__(self, work: Path, key: str, every: int, timer: TrainingTimer):
        """A hook that has written nothing.

        Args:
            work: the folder for checkpoints.
            key: of the run.
            every: iterations between two.
            timer: its marks are saved beside each.
        """
        self._work, self._key, self._every, self._timer = work, key, every, timer

    def on_step(self, trainer: Trainer, terms: dict[str, float]) -> None:
        """Writes one where it is time."""
        if trainer.iteration < trainer.settings.iterations and trainer.iteration % self._every == 0:
            write_checkpoint(self._work, trainer.checkpoint(self._key))
            save_preview(self._work, trainer.avatar)
            self._timer.save(trainer.iteration)


class ProgressBar(Hook):
    """Moves a progress bar on, with the loss beside it."""

    def __init__(self, progress: Progress):
        """A hook on a bar that counts iterations."""
        self._progress = progress

    def on_start(self, trainer: Trainer) -> None:
        """Skips the iterations of a killed run."""
        self._progress.skip(trainer.iteration)

    def on_step(self, trainer: Trainer, terms: dict[str, float]) -> None:
        """Counts the step."""
        self._progress.advance(1, describe(terms))


def describe(terms: dict[str, float]) -> str:
    """The objective's value in words."""
    return f"loss {sum(terms.values()):.4f}"
