"""Everything that depends on the iteration alone: rates, phases, costs and random draws.

Draws have no state. Each is made from (seed, purpose, position), so that a run that was killed and
resumed draws what an uninterrupted one would have drawn.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from stages.train.settings import TrainSettings

STEPS = ((0.95, 0.01), (0.75, 0.1), (0.0, 1.0))  # from this share of the run on, this factor
FRAMES, BACKGROUND, POSE_NOISE, TIME, CROP, SOURCE = 1, 2, 3, 4, 5, 6  # purposes

# Costs in Gaussians' static heads, read off runs of `smile`: of a triplane, subdivided and with all heads, a
# step takes five times as long as the first ones. They matter only until a phase has been measured.
PICTURE_COST = 6000.0  # rendering and comparing
LPIPS_COST = 5000.0
POSE_HEADS_COST, RESIDUALS_COST = 1.0, 0.1  # of what the static heads take
BASES_COST = 0.15  # of the same


@dataclasses.dataclass(frozen=True)
class Draw:
    """The random values of one draw of a frame. Equal positions in a run draw equally.

    Attributes:
        position: which draw of the run this is.
        frame: its number.
        background: [3], the colour behind the person.
        noise: [54 * 6], added to what the heads are told of the pose.
        time: seconds that the residual heads are told; None where they are told none.
        place: in [0, 1), where on the person LPIPS looks.
    """

    position: int
    frame: int
    background: Tensor  # [3]
    noise: Tensor  # [54 * 6]
    time: float | None
    place: float


def rate_factor(settings: TrainSettings, iteration: int) -> float:
    """The factor of the learning rates: a short linear rise, then a cosine, or steps (ExAvatar's)."""
    done = iteration / settings.iterations
    if settings.schedule == "steps":
        warm = min(1.0, (iteration + 1) / max(1, settings.warm_up))
        return warm * next(factor for share, factor in STEPS if done >= share)
    cosine = 0.5 * (1 + math.cos(math.pi * done))
    warm = min(1.0, (iteration + 1) / max(1, settings.warm_up))
    return warm * (settings.final_rate + (1 - settings.final_rate) * cosine)


def reached(settings: TrainSettings, fraction: float, iteration: int) -> bool:
    """True once ``fraction`` of the run is done."""
    return iteration >= fraction * settings.iterations


def begun(settings: TrainSettings, fraction: float, iteration: int) -> bool:
    """True where something that starts at ``fraction`` of the run takes part; 1 stands for never."""
    return fraction < 1 and reached(settings, fraction, iteration)


def residual_share(settings: TrainSettings, iteration: int) -> float:
    """The share of the residual colours that is added: from 0 to 1 over ``residual_ramp``."""
    if not settings.residual_ramp:
        return 1.0
    done = iteration / settings.iterations - settings.residual_from
    return min(1.0, max(0.0, done / settings.residual_ramp))


def first_iteration(settings: TrainSettings, fraction: float) -> int | None:
    """The first iteration at which ``begun`` is true; None for never."""
    return None if fraction == 1 else math.ceil(fraction * settings.iterations)


def step_costs(settings: TrainSettings, gaussians: Sequence[int]) -> list[float]:
    """The relative cost of every iteration of a run, for the time left that is shown.

    Args:
        settings: of the stage.
        gaussians: their number at each level of subdivision.
    """

    def cost(iteration: int) -> float:
        fine = reached(settings, settings.subdivide_from, iteration)
        lpips = bool(settings.lpips) and begun(settings, settings.lpips_from, iteration)
        picture = PICTURE_COST + LPIPS_COST / settings.lpips_every * lpips
        if settings.representation == "bases":
            return picture + BASES_COST * gaussians[-1]
        heads = 1.0
        heads += POSE_HEADS_COST * begun(settings, settings.pose_heads_from, iteration)
        heads += RESIDUALS_COST * begun(settings, settings.residual_from, iteration)
        return picture + heads * gaussians[-1 if fine else 0]

    return [cost(iteration) for iteration in range(settings.iterations)]


def make_draw(
    settings: TrainSettings,
    sources: tuple[tuple[int, ...], tuple[int, ...]],
    seconds: Mapping[int, float],
    noise_size: int,
    position: int,
) -> Draw:
    """Everything random about the ``position``-th drawn frame of a run.

    Args:
        settings: of the stage.
        sources: numbers of captured and of generated frames.
        seconds: frame number -> when it was filmed, where that is known.
        noise_size: of the noise.
        position: which draw.
    """
    seed = settings.seed
    frame = drawn_of_two(seed, *sources, settings.generated_every, position)
    timeless = drawn_share(seed, TIME, position) < settings.time_dropout
    return Draw(
        position=position,
        frame=frame,
        background=drawn_background(seed, position),
        noise=settings.pose_noise * drawn_noise(seed, position, noise_size),
        time=None if timeless else seconds.get(frame),
        place=drawn_share(seed, CROP, position),
    )


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
