"""Everything that depends on the iteration alone: rates, what is active, and random draws.

Draws have no state. Each is made from (seed, purpose, position), so that a run that was killed and
resumed draws what an uninterrupted one would have drawn.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from stages.train.settings import TrainSettings

FRAMES, BACKGROUND, POSE_NOISE, TIME, CROP, SOURCE = 1, 2, 3, 4, 5, 6  # purposes


def rate_factor(settings: TrainSettings, iteration: int) -> float:
    """The factor of the learning rates: a short linear rise, then a cosine."""
    done = iteration / settings.iterations
    cosine = 0.5 * (1 + math.cos(math.pi * done))
    warm = min(1.0, (iteration + 1) / max(1, settings.warm_up))
    return warm * (settings.final_rate + (1 - settings.final_rate) * cosine)


def reached(settings: TrainSettings, fraction: float, iteration: int) -> bool:
    """True once ``fraction`` of the run is done."""
    return iteration >= fraction * settings.iterations


def begun(settings: TrainSettings, fraction: float, iteration: int) -> bool:
    """True where something that starts at ``fraction`` of the run takes part; 1 stands for never."""
    return fraction < 1 and reached(settings, fraction, iteration)


def drawn_frame(seed: int, frames: tuple[int, ...], position: int) -> int:
    """The frame of the ``position``-th draw: every frame once, in random order, then again."""
    epoch, place = divmod(position, len(frames))
    return frames[_order(seed, len(frames), epoch)[place]]


def drawn_of_two(
    seed: int, captured: tuple[int, ...], generated: tuple[int, ...], every: int, position: int
) -> int:
    """The frame of the ``position``-th draw from two sources.

    Every ``every`` draws hold one generated frame, at a random place among them; within a source as
    ``drawn_frame``. An empty source leaves all draws to the other.

    Args:
        seed: of the run.
        captured, generated: frame numbers.
        every: 2 draws from both equally often, as in the paper (Section 3.6).
        position: which draw of the run.
    """
    if not captured or not generated:
        return drawn_frame(seed, captured or generated, position)
    block, place = divmod(position, every)
    chosen = int(every * drawn_share(seed, SOURCE, block))
    if place == chosen:
        return drawn_frame(seed, generated, block)
    return drawn_frame(seed, captured, block * (every - 1) + place - (place > chosen))


@functools.lru_cache(maxsize=4)
def _order(seed: int, count: int, epoch: int) -> np.ndarray:
    return np.random.default_rng([seed, FRAMES, epoch]).permutation(count)


def drawn_background(seed: int, position: int) -> Tensor:
    """A uniformly random colour, [3]."""
    return torch.from_numpy(np.random.default_rng([seed, BACKGROUND, position]).random(3, np.float32))


def drawn_share(seed: int, purpose: int, position: int) -> float:
    """A uniformly random number in [0, 1)."""
    return float(np.random.default_rng([seed, purpose, position]).random())


def drawn_noise(seed: int, position: int, size: int) -> Tensor:
    """Standard normal numbers, [size]."""
    draws = np.random.default_rng([seed, POSE_NOISE, position]).standard_normal(size, np.float32)
    return torch.from_numpy(draws)
