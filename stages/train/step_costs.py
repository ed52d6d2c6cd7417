"""Relative costs of the training steps, for the time left that is shown.

A step costs what its Gaussians' heads cost, and what pictures cost whatever their number. The weights below
were read off runs of `smile`, in which the second half, subdivided and with all heads, takes four times as
long as the first steps. They matter only until a phase has been measured.
"""

from __future__ import annotations

from stages.train import schedule
from stages.train.loop import Trainer

PICTURE = 6000.0  # Gaussians whose static heads take as long as rendering and comparing
POSE_HEADS = 1.0  # of what the static heads take
RESIDUALS = 0.1


def step_costs(trainer: Trainer) -> list[float]:
    """The relative cost of every iteration of a run, in Gaussians' static heads."""
    settings, sizes = trainer.settings, [len(surface.canonical) for surface in _surfaces(trainer)]

    def cost(iteration: int) -> float:
        fine = schedule.reached(settings, settings.subdivide_from, iteration)
        heads = 1.0
        heads += POSE_HEADS * schedule.begun(settings, settings.pose_heads_from, iteration)
        heads += RESIDUALS * schedule.begun(settings, settings.residual_from, iteration)
        return PICTURE + heads * sizes[-1 if fine else 0]

    return [cost(iteration) for iteration in range(settings.iterations)]


def _surfaces(trainer: Trainer) -> list:
    return [trainer.avatar.surface(level) for level in range(trainer.settings.subdivisions + 1)]
