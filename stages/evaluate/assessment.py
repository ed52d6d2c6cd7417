"""Scores the avatar and the baselines on the clip, and keeps a few frames to look at."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import lru_cache, partial

import numpy as np
from torch import Tensor

from pipeline.metrics.protocol import interior
from stages.evaluate.baselines import mean_frame, nearest_frames
from stages.evaluate.evidence import Evidence, Pose, evenly
from stages.evaluate.pictures import Comparison, compare, person_box
from stages.evaluate.rendering import Animate, render_frame, scored_picture
from stages.evaluate.scoring import (
    AVATAR,
    HELD_OUT,
    MEAN,
    NEAREST,
    REFINED,
    TRAINING,
    Picture,
    Score,
    Scorer,
)
from stages.evaluate.settings import EvaluateSettings

Advance = Callable[[], object]


@dataclasses.dataclass(frozen=True)
class Assessment:
    """What is known about an avatar's pictures.

    Attributes:
        scores: every metric of every frame and method.
        comparisons: a few frames, cropped to the person; held out where any frame is.
        nearest: held-out frame -> its nearest training frame.
    """

    scores: tuple[Score, ...]
    comparisons: tuple[Comparison, ...]
    nearest: Mapping[int, int]


@dataclasses.dataclass(frozen=True)
class _Judge:
    """Scores pictures against one frame's truth."""

    frame: int
    split: str
    scorer: Scorer
    truth: Picture
    mask: np.ndarray  # [H, W]

    def score(self, method: str, picture: Picture) -> list[Score]:
        values = self.scorer.values(picture, self.truth, interior(self.mask))
        return [Score(self.frame, self.split, method, metric, value) for metric, value in values.items()]


def scored_frames(evidence: Evidence, settings: EvaluateSettings) -> list[tuple[str, int]]:
    """The (split, frame) pairs that are scored: all held out, and some that were trained on."""
    trained = evenly(evidence.split.train, settings.training_frames)
    return [(HELD_OUT, frame) for frame in evidence.split.test] + [(TRAINING, frame) for frame in trained]


def assess(
    evidence: Evidence,
    animate: Animate,
    scorer: Scorer,
    settings: EvaluateSettings,
    refined: Mapping[int, Pose],
    advance: Advance,
) -> Assessment:
    """Scores the clip.

    Args:
        evidence: the clip.
        animate: a pose -> Gaussians.
        scorer: the metrics.
        settings: how many frames.
        refined: held-out frame -> its refined pose; empty where none was refined.
        advance: called after each scored frame.
    """
    shown = frames_to_show(evidence, settings)
    box = person_box([evidence.mask(frame) for frame in shown])
    baselines = _Baselines.prepare(evidence, scorer, settings)
    scores: list[Score] = []
    comparisons: dict[int, Comparison] = {}
    for split, frame in scored_frames(evidence, settings):
        truth = scorer.composited(partial(evidence.person, frame))
        judge = _Judge(frame, split, scorer, truth, evidence.mask(frame))
        picture = scorer.composited(partial(scored_picture, render_frame(animate, evidence, frame)))
        avatar = judge.score(AVATAR, picture)
        scores += avatar
        if frame in refined:
            rendering = render_frame(animate, evidence, frame, refined[frame])
            scores += judge.score(REFINED, scorer.composited(partial(scored_picture, rendering)))
        if split == HELD_OUT:
            scores += judge.score(MEAN, baselines.mean)
            scores += judge.score(NEAREST, baselines.picture(baselines.nearest[frame]))
        if frame in shown:
            psnr = next(one.value for one in avatar if one.metric == "psnr")
            pair = compare(frame, truth.image, picture.image, settings.error_gain, psnr)
            comparisons[frame] = pair.cropped(box)
        advance()
    return Assessment(tuple(scores), tuple(comparisons[frame] for frame in shown), baselines.nearest)


def frames_to_show(evidence: Evidence, settings: EvaluateSettings) -> list[int]:
    """The frames of the comparison: held out, or trained on and scored where none is."""
    if evidence.split.test:
        return evenly(evidence.split.test, settings.comparison_frames)
    return evenly(evenly(evidence.split.train, settings.training_frames), settings.comparison_frames)


@dataclasses.dataclass(frozen=True)
class _Baselines:
    mean: Picture
    nearest: Mapping[int, int]
    picture: Callable[[int], Picture]

    @classmethod
    def prepare(cls, evidence: Evidence, scorer: Scorer, settings: EvaluateSettings) -> _Baselines:
        frames = evidence.split.train
        training = evenly(frames, settings.baseline_frames or len(frames))

        # Neighbouring held-out frames often share their nearest frame.
        @lru_cache(maxsize=2)
        def picture(frame: int) -> Picture:
            return scorer.composited(partial(evidence.person, frame))

        def mean(background: str) -> Tensor:
            return mean_frame(partial(evidence.person, background=background), training)

        person = partial(evidence.person, background=scorer.background)
        return cls(
            mean=scorer.composited(mean),
            nearest=nearest_frames(person, training, evidence.split.test),
            picture=picture,
        )
