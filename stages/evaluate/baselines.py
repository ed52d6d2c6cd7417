"""What any avatar must be compared with: pictures that need no avatar at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

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
        errors = torch.tensor([[_error(image, truth) for truth in truths] for image in map(person, training)])
        nearest.update(zip(chunk, [training[row] for row in errors.argmin(0).tolist()], strict=True))
    return nearest


def _error(image: Tensor, truth: Tensor) -> float:
    return float((image - truth).square().mean(dtype=torch.float64))
