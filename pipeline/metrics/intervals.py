"""How sure a mean over frames is: a bootstrap over blocks of neighbouring frames.

Neighbouring frames look alike, and so do their scores: drawing single frames anew would count each as a
witness of its own and give intervals that are too narrow. Blocks of frames that follow one another are
drawn instead (Kuensch 1989; circular, Politis and Romano 1992, so that every frame is drawn equally
often), as long as the square root of their number. That keeps what correlates over a few frames
together; of a clip that is one slow motion even this is too sure of itself, and a handful of frames has
no honest interval at all: it says how much the held-out frames differ, not what another clip would give.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean and where it would lie were the frames drawn anew.

    Attributes:
        mean: over the frames.
        low, high: the interval's ends.
    """

    mean: float
    low: float
    high: float


def block_length(count: int) -> int:
    """Frames that are drawn together: the square root of their number, rounded up, at least 1."""
    return max(1, math.ceil(math.sqrt(count)))


def interval(
    values: np.ndarray,  # [N]
    rounds: int = 2000,
    seed: int = 0,
    confidence: float = 0.95,
    block: int | None = None,
) -> Interval | None:
    """The percentile interval of a mean over frames.

    Args:
        values: in the order of the frames; NaN where a frame has no value, and such are left out.
        rounds: drawn samples.
        seed: of the draws.
        confidence: the share of the drawn means that lie inside.
        block: frames a block; ``block_length`` of their number if None.

    Returns:
        The interval; None without a value. Of one value its ends are that value.
    """
    values = np.asarray(values, np.float64)
    values = values[~np.isnan(values)]
    count = len(values)
    if not count:
        return None
    block = min(block or block_length(count), count)
    random = np.random.default_rng(seed)
    starts = random.integers(0, count, (rounds, -(-count // block)))
    places = (starts[..., None] + np.arange(block)).reshape(rounds, -1)[:, :count] % count
    means = values[places].mean(1)
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(means, [tail, 100 - tail])
    return Interval(math.fsum(values) / count, float(low), float(high))
