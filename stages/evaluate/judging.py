"""Judging what is shown of one frame after another."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property, partial

import numpy as np
from torch import Tensor

from pipeline.boxes import Box
from pipeline.composite import BACKGROUNDS, BLACK, WHITE, cut_out
from pipeline.metrics.flicker import flicker
from pipeline.metrics.protocol import interior, person
from pipeline.metrics.psnr import psnr
from pipeline.metrics.regions import region_boxes
from pipeline.protocols import TRUTH, Protocol
from pipeline.splat import Rendering
from stages.evaluate.evidence import Evidence
from stages.evaluate.rendering import scored_picture
from stages.evaluate.scoring import HELD_OUT, OTHER_CAMERA, Picture, Score, Scorer

On = Callable[[str], Tensor]
"""A background -> what is shown on it, [H, W, 3] float in [0, 1]."""


@dataclasses.dataclass(frozen=True)
class Truth:
    """What one frame's pictures are compared with.

    Attributes:
        frame: number in the source clip.
        split: where it belongs.
        view: empty, or ``OTHER_CAMERA``.
        scorer: the metrics.
        picture: the person.
        mask: [H, W] uint8, soft alpha.
        boxes: region -> its crops.
    """

    frame: int
    split: str
    view: str
    scorer: Scorer
    picture: Picture
    mask: np.ndarray  # [H, W]
    boxes: Mapping[str, list[Box]]

    @cached_property
    def interior(self) -> Tensor:
        """[H, W] bool, the eroded mask."""
        return interior(self.mask)

    @cached_property
    def person(self) -> Tensor:
        """[H, W] bool, the mask."""
        return person(self.mask)

    @cached_property
    def crops(self) -> dict[str, list[Picture]]:
        """Region -> its crops of the truth."""
        return {region: self.scorer.crops(self.picture, boxes) for region, boxes in self.boxes.items()}

    def score(self, method: str, metric: str, value: float) -> Score:
        """A score of this frame."""
        return Score(self.frame, self.split, method, metric, value, self.view)


class Judge:
    """Scores pictures under one protocol; remembers the frame before, for flicker.

    Attributes:
        truth: of the frame that is judged now.
    """

    truth: Truth

    def __init__(self, evidence: Evidence, scorer: Scorer, choices: Protocol) -> None:
        self._evidence, self._scorer, self._choices = evidence, scorer, choices
        self._before: Truth | None = None
        self._shown: dict[str, Tensor] = {}  # method -> this frame's picture on black
        self._shown_before: dict[str, Tensor] = {}

    def turn_to(self, split: str, frame: int) -> None:
        """Goes on to another frame."""
        evidence, scorer = self._evidence, self._scorer
        camera = evidence.cameras[frame]
        view = OTHER_CAMERA if split == HELD_OUT and frame in evidence.other_cameras else ""
        points = evidence.points(frame)
        boxes = {} if points is None else region_boxes(points, camera.width, camera.height)
        picture = scorer.composited(partial(evidence.person, frame))
        before = getattr(self, "truth", None)
        self.truth = Truth(frame, split, view, scorer, picture, evidence.mask(frame), boxes)
        follows = before is not None and evidence.follow(before.frame, frame) and before.view == view
        self._before, self._shown_before = (before, self._shown) if follows else (None, {})
        self._shown = {}

    def make(self, on: On) -> Picture:
        """A picture as the protocol cuts it out, made ready."""
        if self._choices.render_mask != TRUTH:
            return self._scorer.composited(on)
        cut = partial(cut_out, on(BLACK), on(WHITE), self.truth.mask)
        return self._scorer.composited(cut)

    @property
    def cuts(self) -> bool:
        """Whether a picture depends on the frame that it is compared with."""
        return self._choices.render_mask == TRUTH

    def score(self, method: str, picture: Picture) -> list[Score]:
        """Every metric of a picture of the present frame."""
        truth = self.truth
        values = self._scorer.values(picture, truth.picture, truth.interior, truth.person)
        for region, crops in truth.crops.items():
            made = self._scorer.crops(picture, truth.boxes[region])
            values |= self._scorer.crop_values(region, made, crops)
        if self._before is not None and method in self._shown_before:
            pictures = (
                picture.black,
                self._shown_before[method],
                truth.picture.black,
                self._before.picture.black,
            )
            values["flicker"] = flicker(*pictures, truth.interior & self._before.interior)
        self._shown[method] = picture.black
        return [truth.score(method, metric, value) for metric, value in values.items()]

    def composites(self, method: str, rendering: Rendering) -> list[Score]:
        """PSNR of a rendering under every composite: either background, its own alpha or the truth's mask."""
        truth, found = self.truth, []
        black, white = (scored_picture(rendering, background) for background in (BLACK, WHITE))
        for background in BACKGROUNDS:
            true = self._evidence.person(truth.frame, background)
            own = scored_picture(rendering, background)
            masked = cut_out(black, white, truth.mask, background)
            for mask, image in (("own", own), ("truth", masked)):
                found.append(truth.score(method, f"psnr_{background}_{mask}", psnr(image, true)))
        return found
