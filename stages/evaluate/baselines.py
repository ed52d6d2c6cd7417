"""What any avatar must be compared with: pictures that need no avatar at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial

import torch
from torch import Tensor

from pipeline.spread import spread_end_to_end
from stages.evaluate.evidence import Evidence
from stages.evaluate.judging import Judge, On
from stages.evaluate.mesh import TexturedMesh
from stages.evaluate.scoring import MEAN, MESH, NEAREST, Picture, Scorer
from stages.evaluate.settings import EvaluateSettings

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


@dataclasses.dataclass(frozen=True)
class Baselines:
    """What stands beside the avatar on a held-out frame.

    Attributes:
        nearest: held-out frame -> its nearest training frame.
        mean: the mean frame.
        copied: training frame -> the person in it.
        mesh: the textured mesh, where it was asked for.
        evidence: the clip.
        ready: a key, what is shown -> the same made ready; remembers the last ones.
    """

    nearest: Mapping[int, int]
    mean: On
    copied: Callable[[int], On]
    mesh: TexturedMesh | None
    evidence: Evidence
    ready: Callable[[tuple[str, int]], Picture]

    def pictures(self, judge: Judge) -> Iterator[tuple[str, Picture]]:
        """Each baseline's method and picture of the frame that is judged now."""
        frame = judge.truth.frame
        for key in ((MEAN, 0), (NEAREST, self.nearest[frame])):
            shown = self.mean if key[0] == MEAN else self.copied(key[1])
            yield key[0], judge.make(shown) if judge.cuts else self.ready(key)
        if self.mesh is not None:
            yield MESH, judge.make(self.mesh.on(self.evidence.pose(frame), self.evidence.cameras[frame]))


def prepare_baselines(
    evidence: Evidence, scorer: Scorer, settings: EvaluateSettings, mesh: TexturedMesh | None
) -> Baselines:
    """Takes the mean of the training frames and finds each held-out frame's nearest."""
    frames = evidence.split.train
    training = spread_end_to_end(frames, settings.baseline_frames or len(frames))

    @lru_cache(maxsize=2)
    def mean(background: str) -> Tensor:
        return mean_frame(partial(evidence.person, background=background), training)

    def copied(frame: int) -> On:
        return partial(evidence.person, frame)

    # Neighbouring held-out frames often share their nearest frame.
    @lru_cache(maxsize=3)
    def ready(key: tuple[str, int]) -> Picture:
        return scorer.composited(mean if key[0] == MEAN else copied(key[1]))

    person = partial(evidence.person, background=scorer.background)
    nearest = nearest_frames(person, training, evidence.split.test)
    return Baselines(nearest, mean, copied, mesh, evidence, ready)
