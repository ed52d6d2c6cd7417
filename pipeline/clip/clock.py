"""The time of a clip's frames, in units that do not depend on how many frames a second it has.

Priors and filters in time were tuned at 30 frames a second; their unit is the 30th part of a second. Frames
that do not follow one another (single pictures, the cameras of a rig) lie ``BREAK`` apart, so far that
nothing in time reaches from one to the next.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.clip.records import SHOT_STEP, Footage

RATE = 30.0
"""Units a second."""

BREAK = 1000.0
"""Units between frames that do not follow one another: half a minute."""

_LEAST = 1e-3  # units between frames whose clock stands still


def frame_times(frames: Sequence[int] | np.ndarray, footage: Footage) -> np.ndarray:
    """The times of a clip's kept frames: [T] float64, increasing, from 0.

    Pictures without a clock that follow one another count as a film of ``RATE`` frames a second.

    Args:
        frames: [T], the kept frames' numbers, increasing.
        footage: the clip's record, of the same frames.
    """
    numbers = np.asarray(frames, np.int64)
    if footage.stills:
        return BREAK * np.arange(len(numbers))
    rate = RATE if footage.fps else 1.0  # without a clock, seconds are places
    seconds = np.asarray(footage.seconds, np.float64)
    if len(seconds) != len(numbers):
        return times_of_numbers(numbers)
    steps = np.maximum(np.round(np.diff(seconds) * rate, 3), _LEAST)
    return np.concatenate([[0.0], np.cumsum(_broken(steps, numbers))])[: len(numbers)]


def times_of_numbers(frames: np.ndarray) -> np.ndarray:
    """Times as if each frame number were a unit: [T] -> [T] float64, from 0."""
    steps = np.diff(frames.astype(np.float64))
    return np.concatenate([[0.0], np.cumsum(_broken(steps, frames))])[: len(frames)]


def usual_step(times: np.ndarray) -> float:
    """The median time between frames that follow one another; ``BREAK`` where none do."""
    steps = np.diff(times)
    steps = steps[steps < BREAK]
    return float(np.median(steps)) if len(steps) else BREAK


def _broken(steps: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """The steps with a break between the cameras of a rig."""
    return np.where(np.diff(numbers // SHOT_STEP) != 0, BREAK, steps)
