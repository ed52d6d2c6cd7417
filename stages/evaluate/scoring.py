"""Every metric of every frame, and their means."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from pipeline.boxes import Box
from pipeline.composite import BACKGROUNDS, BLACK
from pipeline.guard import require_finite
from pipeline.metrics.intervals import Interval, interval
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.psnr import PSNR_CAP, psnr
from pipeline.metrics.ssim import ssim
from pipeline.tables import write_table
from stages.evaluate.settings import EvaluateSettings

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

AVATAR, REFINED, MEAN, NEAREST, MESH, CEILING = METHODS = (
    "avatar", "avatar_refined", "mean_frame", "nearest_frame", "textured_mesh", "second_mask",
)  # fmt: skip
"""What is scored: the avatar, the avatar with test poses refined, the three baselines, and the true frame
itself under a second mask."""

BASELINES = (MEAN, NEAREST, MESH)

HELD_OUT, TRAINING, VIEWS = SPLITS = ("test", "train", "views")
"""The splits, by their names in split.json, and a mannequin's unseen cameras."""

OTHER_CAMERA = "other camera"
"""The view of a held-out frame that no training camera filmed."""


@dataclasses.dataclass(frozen=True)
class Score:
    """One metric of one image.

    Attributes:
        frame: number in the source clip.
        split: one of ``SPLITS``.
        method: one of ``METHODS``.
        metric: ``psnr``, ``psnr_interior``, ``psnr_person`` (dB), ``ssim``, ``lpips_alex`` or ``lpips_vgg``;
            ``psnr_face``, ``ssim_hands`` and so on of crops; ``psnr_white_truth`` and so on of composites;
            ``flicker`` (levels of 255); ``identity_distance``, ``identity_cosine``, ``identity_found``;
            ``psnr_seen`` and ``psnr_unseen`` (dB) of surface that training frames show, or do not, and
            ``unseen_share``, the latter's part of the person.
        value: as the metric is defined, not times 100.
        view: empty for a camera of the training frames; else which other.
    """

    frame: int
    split: str
    method: str
    metric: str
    value: float
    view: str = ""


@dataclasses.dataclass(frozen=True)
class Picture:
    """An image with the features that LPIPS compares, so that they are computed once.

    Attributes:
        image: [H, W, 3] float in [0, 1], on the background of the scorer.
        black: [H, W, 3], the same on black, where interiors are measured.
        features: LPIPS backbone -> its features.
    """

    image: Tensor  # [H, W, 3]
    black: Tensor  # [H, W, 3]
    features: Mapping[str, list[Tensor]]


class Scorer:
    """Scores pictures against the truth, with the LPIPS backbones that are loaded.

    Attributes:
        networks: LPIPS backbone -> the network.
        background: what all pictures are composited on, one of ``BACKGROUNDS``.
    """

    def __init__(self, networks: Mapping[str, Lpips], background: str = BLACK) -> None:
        self.networks, self.background = networks, background

    @property
    def metrics(self) -> tuple[str, ...]:
        """The names of the metrics, in the order of the tables."""
        return ("psnr", "psnr_interior", "ssim", *(f"lpips_{name}" for name in self.networks))

    @torch.no_grad()
    def picture(self, image: Tensor, black: Tensor | None = None) -> Picture:
        """An image made ready.

        Args:
            image: [H, W, 3] float in [0, 1], on the background.
            black: the same on black; the image itself if None.
        """
        require_finite({"a picture": image}, "scoring", "before any metric", "run the train stage again")
        features = {name: network.features(image) for name, network in self.networks.items()}
        return Picture(image, image if black is None else black, features)

    def composited(self, on: Callable[[str], Tensor]) -> Picture:
        """What ``on`` makes of a background, made ready: [H, W, 3] float in [0, 1]."""
        return self.picture(on(self.background), None if self.background == BLACK else on(BLACK))

    @torch.no_grad()
    def values(
        self, picture: Picture, truth: Picture, interior: Tensor, person: Tensor | None = None
    ) -> dict[str, float]:
        """Every metric of one picture.

        Args:
            picture: what is judged.
            truth: the person.
            interior: [H, W] bool, see :func:`pipeline.metrics.protocol.interior`.
            person: [H, W] bool, the person's pixels; without ``psnr_person`` if None.

        Returns:
            Metric -> value; ``psnr_interior`` and ``psnr_person`` are NaN where there is no such pixel.
        """
        values = {
            "psnr": psnr(picture.image, truth.image),
            "psnr_interior": psnr(picture.black, truth.black, interior),
            "ssim": ssim(picture.image, truth.image, BACKGROUNDS[self.background]),
        }
        if person is not None:
            values["psnr_person"] = psnr(picture.black, truth.black, person)
        return {**values, **self._perceptual(picture, truth)}

    def crops(self, picture: Picture, boxes: Iterable[Box]) -> list[Picture]:
        """Parts of a picture, each made ready by itself."""
        parts = [box.slices for box in boxes]
        return [self.picture(picture.image[part], picture.black[part]) for part in parts]

    @torch.no_grad()
    def crop_values(self, region: str, crops: list[Picture], truths: list[Picture]) -> dict[str, float]:
        """PSNR, SSIM and LPIPS of a region, the mean over its crops: ``psnr_face`` and so on."""
        found = []
        for crop, truth in zip(crops, truths, strict=True):
            values = {
                "psnr": psnr(crop.image, truth.image),
                "ssim": ssim(crop.image, truth.image, BACKGROUNDS[self.background]),
            }
            found.append({**values, **self._perceptual(crop, truth)})
        return {f"{name}_{region}": math.fsum(one[name] for one in found) / len(found) for name in found[0]}

    def _perceptual(self, picture: Picture, truth: Picture) -> dict[str, float]:
        return {
            f"lpips_{name}": float(network.distance(picture.features[name], truth.features[name]))
            for name, network in self.networks.items()
        }


def values_of(
    scores: Iterable[Score], split: str, method: str, metric: str, view: str | None = None
) -> list[tuple[int, float]]:
    """Frame and value of a metric, in the order of the scores; what is not defined is left out.

    Args:
        scores: all of them.
        split, method, metric: which.
        view: of this camera alone; of all if None.
    """
    wanted = (split, method, metric)
    rows = [one for one in scores if (one.split, one.method, one.metric) == wanted]
    return [(one.frame, one.value) for one in rows if view in (None, one.view) and not math.isnan(one.value)]


def mean(
    scores: Iterable[Score], split: str, method: str, metric: str, view: str | None = None
) -> float | None:
    """A metric's mean over a split's frames; None if no frame has it.

    Frames without an interior have no ``psnr_interior`` and are left out of its mean.
    """
    values = [value for _, value in values_of(scores, split, method, metric, view)]
    return math.fsum(values) / len(values) if values else None


def further_metrics(scores: Iterable[Score], metrics: Iterable[str]) -> list[str]:
    """The metrics that were measured besides those of the main table, sorted by name."""
    return sorted({one.metric for one in scores} - set(metrics))


def table(
    scores: Iterable[Score], metrics: Iterable[str], view: str | None = None
) -> dict[str, dict[str, dict[str, float | None]]]:
    """The means, split -> method -> metric -> mean, rounded to 6 decimals; only what was scored.

    Of the metrics after the main table's, a method has those that it was measured in.
    """
    scores = [one for one in scores if view in (None, one.view)]
    result: dict[str, dict[str, dict[str, float | None]]] = {}
    metrics = list(metrics)
    for split in SPLITS:
        for method in METHODS:
            own = [one for one in scores if (one.split, one.method) == (split, method)]
            measured = {one.metric for one in own}
            names = [*(metrics if split != VIEWS else ()), *further_metrics(own, metrics)]
            names += sorted(measured & set(metrics)) if split == VIEWS else []
            if own:
                means = {name: mean(own, split, method, name) for name in names}
                result.setdefault(split, {})[method] = {
                    name: _rounded(value) for name, value in means.items()
                }
    return result


Intervals = dict[str, dict[str, dict[str, list[float]]]]
"""split -> method -> metric -> the interval's ends."""


def intervals(scores: Iterable[Score], settings: EvaluateSettings) -> Intervals:
    """Where each mean of the clip's own cameras would lie were the frames drawn anew."""
    scores = [one for one in scores if one.split != VIEWS]
    result: Intervals = {}
    for split, method, metric in dict.fromkeys((one.split, one.method, one.metric) for one in scores):
        # Training frames are spread over the clip: none of those that are scored is the next of another.
        block = 1 if split == TRAINING else None
        found = _interval([value for _, value in values_of(scores, split, method, metric)], settings, block)
        if found is not None:
            ends = [round(value, 6) for value in np.clip([found.low, found.high], *bounds(metric)).tolist()]
            result.setdefault(split, {}).setdefault(method, {})[metric] = ends
    return result


def differences(
    scores: Iterable[Score], metrics: Iterable[str], settings: EvaluateSettings
) -> dict[str, dict[str, dict[str, float]]]:
    """What the avatar has over each other method on the held-out frames that both have, frame by frame.

    Frames are hard or easy for all methods alike, so that differences are surer than means.

    Returns:
        method -> metric -> mean, low, high, of avatar minus method.
    """
    scores = list(scores)
    result: dict[str, dict[str, dict[str, float]]] = {}
    for method in (name for name in METHODS if name != AVATAR):
        for metric in metrics:
            own = dict(values_of(scores, HELD_OUT, AVATAR, metric))
            other = values_of(scores, HELD_OUT, method, metric)
            found = _interval([own[frame] - value for frame, value in other if frame in own], settings)
            if found is not None:
                ends = {name: round(value, 6) for name, value in dataclasses.asdict(found).items()}
                result.setdefault(method, {})[metric] = ends
    return result


def bounds(metric: str) -> tuple[float, float]:
    """The least and the largest value that a metric can have, which a stretched interval knows nothing of."""
    if metric in ("identity_found", "unseen_share"):
        return 0.0, 1.0
    if metric.startswith(("ssim", "identity_cosine")):
        return -1.0, 1.0
    return (-math.inf, PSNR_CAP) if metric.startswith("psnr") else (0.0, math.inf)


def _interval(values: list[float], settings: EvaluateSettings, block: int | None = None) -> Interval | None:
    rounds, seed = settings.bootstrap_rounds, settings.bootstrap_seed
    return interval(np.array(values, np.float64), rounds, seed, settings.confidence, block)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 6)


def write_scores(path: Path, scores: Iterable[Score]) -> None:
    """Writes ``metrics.parquet``: frame int32, split, method, metric string, value float64, view string.

    What is not defined (the interior of a frame that has none) has no row.
    """
    rows = [row for row in scores if not math.isnan(row.value)]
    columns = {name: np.array([getattr(row, name) for row in rows]) for name in SCHEMA.names}
    write_table(path, SCHEMA, columns)
