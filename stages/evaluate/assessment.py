"""Scores the avatar and the baselines on the clip, and keeps a few frames to look at."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from pipeline.boxes import Box, person_box
from pipeline.composite import composite_frame
from pipeline.spread import spread_end_to_end
from stages.evaluate.baselines import Baselines, prepare_baselines
from stages.evaluate.evidence import Evidence, Pose
from stages.evaluate.judging import Judge
from stages.evaluate.likeness import Reader, likeness
from stages.evaluate.mesh import TexturedMesh
from stages.evaluate.pictures import Closeup, Comparison, closeups, compare
from stages.evaluate.rendering import Animate, render_frame, scored_picture
from stages.evaluate.scoring import (
    AVATAR,
    CEILING,
    HELD_OUT,
    NEAREST,
    REFINED,
    TRAINING,
    Picture,
    Score,
    Scorer,
)
from stages.evaluate.second_mask import NONE, SecondMasks
from stages.evaluate.settings import EvaluateSettings

Advance = Callable[[], object]


@dataclasses.dataclass(frozen=True)
class Extras:
    """What is judged, or judges, where it was asked for.

    Attributes:
        mesh: the textured mesh.
        second: masks for the ceiling.
        reader: of faces.
    """

    mesh: TexturedMesh | None = None
    second: SecondMasks = NONE
    reader: Reader | None = None


@dataclasses.dataclass(frozen=True)
class Assessment:
    """What is known about an avatar's pictures.

    Attributes:
        scores: every metric of every frame and method.
        comparisons: a few frames, cropped to the person; held out where any frame is.
        nearest: held-out frame -> its nearest training frame.
        slider: as ``comparisons``, more of them, for the report.
        closeups: faces and hands of the frames in ``comparisons``.
    """

    scores: tuple[Score, ...]
    comparisons: tuple[Comparison, ...]
    nearest: Mapping[int, int]
    slider: tuple[Comparison, ...] = ()
    closeups: tuple[Closeup, ...] = ()

    def with_views(self, scores: Sequence[Score]) -> Assessment:
        """The same with scores in cameras that are not the clip's."""
        return dataclasses.replace(self, scores=(*self.scores, *scores))


def scored_frames(evidence: Evidence, settings: EvaluateSettings) -> list[tuple[str, int]]:
    """The (split, frame) pairs that are scored: all held out, and some that were trained on."""
    trained = spread_end_to_end(evidence.split.train, settings.training_frames)
    return [(HELD_OUT, frame) for frame in evidence.split.test] + [(TRAINING, frame) for frame in trained]


def assess(
    evidence: Evidence,
    animate: Animate,
    scorer: Scorer,
    settings: EvaluateSettings,
    refined: Mapping[int, Pose],
    advance: Advance,
    extras: Extras | None = None,
) -> Assessment:
    """Scores the clip.

    Args:
        evidence: the clip.
        animate: a pose -> Gaussians.
        scorer: the metrics.
        settings: how many frames, and the protocol.
        refined: held-out frame -> its refined pose; empty where none was refined.
        advance: called after each scored frame.
        extras: what else is judged, or judges.
    """
    shown, sliding = frames_to_show(evidence, settings), frames_to_slide(evidence, settings)
    masks = [evidence.mask(frame) for frame in {*shown, *sliding}]
    box = person_box(masks) or Box.whole(masks[0])
    extras = extras or Extras()
    panel = _Panel(
        judge=Judge(evidence, scorer, settings.choices),
        evidence=evidence,
        animate=animate,
        refined=refined,
        baselines=prepare_baselines(evidence, scorer, settings, extras.mesh),
        extras=extras,
    )
    scores: list[Score] = []
    comparisons: dict[int, Comparison] = {}
    near: list[Closeup] = []
    for split, frame in scored_frames(evidence, settings):
        panel.judge.turn_to(split, frame)
        found, picture = panel.hear()
        scores += found
        if frame in shown or frame in sliding:
            truth = panel.judge.truth
            psnr = next(one.value for one in found if (one.method, one.metric) == (AVATAR, "psnr"))
            pair = compare(frame, truth.picture.image, picture.image, settings.error_gain, psnr)
            near += closeups(pair, truth.boxes) if frame in shown else []
            comparisons[frame] = pair.cropped(box)
        advance()
    chosen = (tuple(comparisons[frame] for frame in frames) for frames in (shown, sliding))
    return Assessment(tuple(scores), next(chosen), panel.baselines.nearest, next(chosen), tuple(near))


def frames_to_show(evidence: Evidence, settings: EvaluateSettings) -> list[int]:
    """The frames of the comparison: held out, or trained on and scored where none is."""
    return _some(evidence, settings, settings.comparison_frames)


def frames_to_slide(evidence: Evidence, settings: EvaluateSettings) -> list[int]:
    """The frames of the report's slider, chosen likewise; those of the comparison at least."""
    return sorted({*_some(evidence, settings, settings.slider_frames), *frames_to_show(evidence, settings)})


def _some(evidence: Evidence, settings: EvaluateSettings, count: int) -> list[int]:
    frames = evidence.split.test or spread_end_to_end(evidence.split.train, settings.training_frames)
    return spread_end_to_end(frames, count) if count else []


@dataclasses.dataclass(frozen=True)
class _Panel:
    """Everything that is shown of a frame, scored."""

    judge: Judge
    evidence: Evidence
    animate: Animate
    refined: Mapping[int, Pose]
    baselines: Baselines
    extras: Extras

    def hear(self) -> tuple[list[Score], Picture]:
        """The scores of the judge's present frame, and the avatar's picture of it."""
        judge = self.judge
        split, frame = judge.truth.split, judge.truth.frame
        rendering = render_frame(self.animate, self.evidence, frame)
        renderings = {AVATAR: rendering}
        if frame in self.refined:
            renderings[REFINED] = render_frame(self.animate, self.evidence, frame, self.refined[frame])
        shown = {method: judge.make(partial(scored_picture, one)) for method, one in renderings.items()}
        if split == HELD_OUT:
            shown |= dict(self.baselines.pictures(judge))
        scores = [score for method, picture in shown.items() for score in judge.score(method, picture)]
        if split == HELD_OUT:
            scores += [score for name, one in renderings.items() for score in judge.composites(name, one)]
            scores += self._ceiling(frame)
            if self.extras.reader is not None:
                faces = {name: shown[name] for name in (AVATAR, REFINED, NEAREST) if name in shown}
                scores += likeness(self.extras.reader, judge.truth, faces)
        return scores, shown[AVATAR]

    def _ceiling(self, frame: int) -> list[Score]:
        if frame not in self.extras.second.masks:
            return []
        second = partial(composite_frame, self.evidence.frame(frame), self.extras.second.masks[frame])
        return self.judge.score(CEILING, self.judge.make(second))
