"""Pictures that need no avatar at all, with which any avatar must be compared: the mean and nearest frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property, lru_cache, partial

import torch
from torch import Tensor

from pipeline.clip.frames import spread_end_to_end
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.methods import MEAN, NEAREST, OnBackground

Person = Callable[[int], Tensor]
"""Frame number -> the person on the background, [H, W, 3] float in [0, 1]."""

_HELD_AT_ONCE = 32  # held-out frames in memory while the training frames are read past them


def mean_frame(person: Person, frames: Sequence[int]) -> Tensor:
    """The mean of the frames, pixel by pixel, [H, W, 3]: the best guess that ignores the pose.

    Raises:
        ValueError: there is no frame.
    """
    if not frames:
        raise ValueError("a mean needs at least one frame")
    # float64: the mean of thousands of float32 frames would depend on their order.
    total = person(frames[0]).double()
    for index in frames[1:]:
        total += person(index)
    return (total / len(frames)).float()


def nearest_frames(person: Person, training: Sequence[int], held_out: Sequence[int]) -> dict[int, int]:
    """For each held-out frame the training frame with the highest PSNR against it.

    This is an oracle: it looks at the held-out image to choose, which no avatar may. It says what
    replaying the clip would reach at best; where the person returns to an earlier pose that is high.
    Of equally near frames the earliest is taken.

    Raises:
        ValueError: there is no training frame.
    """
    if not training:
        raise ValueError("the nearest frame needs at least one training frame")
    nearest: dict[int, int] = {}
    for start in range(0, len(held_out), _HELD_AT_ONCE):
        chunk = held_out[start : start + _HELD_AT_ONCE]
        truths = [person(index) for index in chunk]
        errors = torch.tensor(
            [[_mean_square(image, truth) for truth in truths] for image in map(person, training)]
        )
        nearest.update(zip(chunk, [training[row] for row in errors.argmin(0).tolist()], strict=True))
    return nearest


def _mean_square(image: Tensor, truth: Tensor) -> float:
    return float((image - truth).square().mean(dtype=torch.float64))


@dataclasses.dataclass(frozen=True)
class MeanFrame:
    """The mean of some training frames, the same picture for every held-out frame.

    Attributes:
        clip: the clip.
        training: the frames that are averaged.
        name: ``MEAN``.
    """

    clip: EvaluatedClip
    training: Sequence[int]
    name: str = MEAN

    @property
    def frames(self) -> Collection[int]:
        """The held-out frames."""
        return self.clip.split.test

    def render(self, frame: int) -> OnBackground:
        """The mean."""
        return self._mean

    @cached_property
    def _mean(self) -> OnBackground:
        @lru_cache(maxsize=2)
        def mean(background: str) -> Tensor:
            return mean_frame(partial(self.clip.person, background=background), self.training)

        return mean


@dataclasses.dataclass(frozen=True)
class NearestFrame:
    """For each held-out frame the training frame that is most like it.

    Attributes:
        clip: the clip.
        nearest: held-out frame -> training frame.
        name: ``NEAREST``.
    """

    clip: EvaluatedClip
    nearest: Mapping[int, int]
    name: str = NEAREST

    @property
    def frames(self) -> Collection[int]:
        """The held-out frames."""
        return self.nearest.keys()

    def render(self, frame: int) -> OnBackground:
        """The person in the nearest training frame."""
        return self._copied(self.nearest[frame])

    @cached_property
    def _copied(self) -> Callable[[int], OnBackground]:
        # Neighbouring held-out frames often share their nearest frame.
        return lru_cache(maxsize=3)(partial(partial, self.clip.person))


def frame_baselines(clip: EvaluatedClip, background: str, most: int) -> tuple[MeanFrame, NearestFrame]:
    """The mean and the nearest frame.

    Args:
        clip: the clip.
        background: what frames are compared on to find the nearest.
        most: training frames that both draw from, evenly spaced; 0 for all.
    """
    training = spread_end_to_end(clip.split.train, most or len(clip.split.train))
    person = partial(clip.person, background=background)
    return MeanFrame(clip, training), NearestFrame(clip, nearest_frames(person, training, clip.split.test))
