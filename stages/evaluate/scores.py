"""The table of scores: every metric of every frame and method, a row each; and the loop that fills it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
import pyarrow as pa
from torch import Tensor

from pipeline.clip.frames import spread_end_to_end
from pipeline.files.tables import write_table
from pipeline.metrics.flicker import flicker
from pipeline.metrics.regions import region_boxes
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.frame_metrics import (
    AlignedFaceEmbedder,
    FaceEmbedder,
    FrameTruth,
    ScoredPicture,
    Scorer,
    arcface_metrics,
    composite_metrics,
    face_metrics,
    picture_metrics,
)
from stages.evaluate.methods import AVATAR, CEILING, NEAREST, REFINED, Method

SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("split", pa.string()),
        ("method", pa.string()),
        ("metric", pa.string()),
        ("value", pa.float64()),
        ("view", pa.string()),
    ]
)

HELD_OUT, TRAINING, VIEWS = SPLITS = ("test", "train", "views")
"""The splits, by their names in split.json, and a mannequin's unseen cameras."""

OTHER_CAMERA = "other camera"
"""The view of a held-out frame that no training camera filmed."""

COMPOSITED = (AVATAR, REFINED)
"""The methods that are scored under every composite."""

WITH_FACES = (AVATAR, REFINED, NEAREST)
"""The methods whose faces are compared."""


@dataclasses.dataclass(frozen=True)
class TableRow:
    """One metric of one picture.

    Attributes:
        frame: number in the source clip.
        split: one of ``SPLITS``.
        method: one of ``METHODS``.
        metric: ``psnr``, ``psnr_interior``, ``psnr_person`` (dB), ``ssim``, ``lpips_alex`` or ``lpips_vgg``;
            ``psnr_face``, ``ssim_hands`` and so on of crops; ``psnr_white_truth`` and so on of composites;
            ``flicker`` (levels of 255); ``identity_distance``, ``identity_cosine``, ``identity_found``,
            ``arcface_cosine``;
            ``psnr_seen`` and ``psnr_unseen`` (dB) of surface that training frames show, or do not, and
            ``unseen_share``, the latter's part of the person.
        value: as the metric is defined, not times 100; NaN where it is not defined.
        view: empty for a camera of the training frames; else which other.
    """

    frame: int
    split: str
    method: str
    metric: str
    value: float
    view: str = ""


@dataclasses.dataclass(frozen=True)
class ScoredFrame:
    """The scores of a frame, and what the next frame's flicker needs of it.

    Attributes:
        truth: the person.
        rows: the scores of all methods.
        render: [H, W, 3] float in [0, 1], the avatar as it was scored.
        black: method -> [H, W, 3], its picture on black.
    """

    truth: FrameTruth
    rows: Sequence[TableRow]
    render: Tensor
    black: Mapping[str, Tensor]

    @property
    def psnr(self) -> float:
        """The avatar's PSNR of the whole picture, dB."""
        return next(row.value for row in self.rows if (row.method, row.metric) == (AVATAR, "psnr"))


def frames_to_score(clip: EvaluatedClip, training_frames: int) -> list[tuple[str, int]]:
    """The (split, frame) pairs that are scored: all held out, and some that were trained on."""
    trained = spread_end_to_end(clip.split.train, training_frames)
    return [(HELD_OUT, frame) for frame in clip.split.test] + [(TRAINING, frame) for frame in trained]


def score_clip(
    clip: EvaluatedClip,
    methods: Sequence[Method],
    scorer: Scorer,
    frames: Iterable[tuple[str, int]],
    embedder: FaceEmbedder | None = None,
    arcface: AlignedFaceEmbedder | None = None,
) -> Iterator[ScoredFrame]:
    """Scores one frame after another.

    Args:
        clip: the truth.
        methods: what is scored, each on its own frames.
        scorer: the metrics.
        frames: (split, frame) pairs.
        embedder: compares faces; they are not compared if None.
        arcface: compares them as the paper does, likewise.
    """
    before: ScoredFrame | None = None
    for split, frame in frames:
        truth = frame_truth(clip, scorer, split, frame)
        before = score_frame(truth, methods, before_of(clip, before, truth), embedder, arcface)
        yield before


def frame_truth(clip: EvaluatedClip, scorer: Scorer, split: str, frame: int) -> FrameTruth:
    """The person in a frame, with the crops of face and hands that were detected there."""
    camera, points = clip.camera(frame), clip.points(frame)
    view = OTHER_CAMERA if split == HELD_OUT and frame in clip.other_cameras else ""
    boxes = {} if points is None else region_boxes(points, camera.width, camera.height)
    on = partial(clip.person, frame)
    seen = scorer.composited(on)
    return FrameTruth(frame, split, view, scorer, seen, on, clip.mask(frame), boxes, points)


def before_of(clip: EvaluatedClip, last: ScoredFrame | None, truth: FrameTruth) -> ScoredFrame | None:
    """The frame that was scored last, where it is the one before in the clip and of the same camera."""
    if last is None or last.truth.view != truth.view or not clip.follows(last.truth.frame, truth.frame):
        return None
    return last


def score_frame(
    truth: FrameTruth,
    methods: Sequence[Method],
    before: ScoredFrame | None = None,
    embedder: FaceEmbedder | None = None,
    arcface: AlignedFaceEmbedder | None = None,
) -> ScoredFrame:
    """Scores every method that shows a frame.

    Args:
        truth: the person in the frame.
        methods: what is scored; the avatar among them.
        before: the frame before, for flicker; None where there is none.
        embedder: compares the faces of held-out frames.
        arcface: compares them as the paper does.
    """
    on = {method.name: method.render(truth.frame) for method in methods if truth.frame in method.frames}
    shown = {name: truth.scorer.cut(picture, truth.mask) for name, picture in on.items()}
    found = {
        name: picture_metrics(picture, truth) | flicker_metric(name, picture, truth, before)
        for name, picture in shown.items()
    }
    groups = [(name, values) for name, values in found.items() if name != CEILING]
    if truth.split == HELD_OUT:
        groups += [(name, composite_metrics(on[name], truth)) for name in COMPOSITED if name in on]
        groups += [(CEILING, found[CEILING])] if CEILING in found else []
        faces = {name: shown[name].image for name in WITH_FACES if name in shown}
        if embedder is not None:
            groups += face_metrics(embedder, faces, truth).items()
        if arcface is not None:
            groups += arcface_metrics(arcface, faces, truth).items()
    rows = [
        TableRow(truth.frame, truth.split, method, metric, value, truth.view)
        for method, values in groups
        for metric, value in values.items()
    ]
    black = {name: picture.black for name, picture in shown.items()}
    return ScoredFrame(truth, rows, shown[AVATAR].image, black)


def flicker_metric(
    method: str, picture: ScoredPicture, truth: FrameTruth, before: ScoredFrame | None
) -> dict[str, float]:
    """``flicker`` from the frame before; empty where the method did not show that one."""
    if before is None or method not in before.black:
        return {}
    inside = truth.interior & before.truth.interior
    pictures = (picture.black, before.black[method], truth.picture.black, before.truth.picture.black)
    return {"flicker": flicker(*pictures, inside)}


def score_table(rows: Iterable[TableRow]) -> pd.DataFrame:
    """The rows as a table with the columns of ``SCHEMA``."""
    return pd.DataFrame([dataclasses.astuple(row) for row in rows], columns=SCHEMA.names)


def write_scores(path: Path, table: pd.DataFrame) -> None:
    """Writes ``metrics.parquet``: frame int32, split, method, metric string, value float64, view string.

    What is not defined (the interior of a frame that has none) has no row.
    """
    defined = table.dropna(subset="value")
    write_table(path, SCHEMA, {name: defined[name].to_numpy() for name in SCHEMA.names})
