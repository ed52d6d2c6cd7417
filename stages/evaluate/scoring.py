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

from pipeline.guard import require_finite
from pipeline.metrics.image import psnr, ssim
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.protocol import BACKGROUNDS, BLACK
from pipeline.tables import write_table

SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("split", pa.string()),
        ("method", pa.string()),
        ("metric", pa.string()),
        ("value", pa.float64()),
    ]
)

AVATAR, REFINED, MEAN, NEAREST = METHODS = ("avatar", "avatar_refined", "mean_frame", "nearest_frame")
"""What is scored: the avatar, the avatar with test poses refined, and the two baselines."""

HELD_OUT, TRAINING = "test", "train"
"""The splits, by their names in split.json."""


@dataclasses.dataclass(frozen=True)
class Score:
    """One metric of one image.

    Attributes:
        frame: number in the source clip.
        split: ``test`` or ``train``.
        method: one of ``METHODS``.
        metric: ``psnr`` (dB), ``psnr_interior`` (dB), ``ssim``, ``lpips_alex`` or ``lpips_vgg``.
        value: as the metric is defined, not times 100.
    """

    frame: int
    split: str
    method: str
    metric: str
    value: float


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
    def values(self, picture: Picture, truth: Picture, interior: Tensor) -> dict[str, float]:
        """Every metric of one picture.

        Args:
            picture: what is judged.
            truth: the person.
            interior: [H, W] bool, see :func:`pipeline.metrics.protocol.interior`.

        Returns:
            Metric -> value; ``psnr_interior`` is NaN where the interior is empty.
        """
        values = {
            "psnr": psnr(picture.image, truth.image),
            "psnr_interior": psnr(picture.black, truth.black, interior),
            "ssim": ssim(picture.image, truth.image, BACKGROUNDS[self.background]),
        }
        for name, network in self.networks.items():
            values[f"lpips_{name}"] = float(network.distance(picture.features[name], truth.features[name]))
        return values


def mean(scores: Iterable[Score], split: str, method: str, metric: str) -> float | None:
    """A metric's mean over a split's frames; None if no frame has it.

    Frames without an interior have no ``psnr_interior`` and are left out of its mean.
    """
    wanted = (split, method, metric)
    values = [one.value for one in scores if (one.split, one.method, one.metric) == wanted]
    values = [value for value in values if not math.isnan(value)]
    return math.fsum(values) / len(values) if values else None


def table(scores: Iterable[Score], metrics: Iterable[str]) -> dict[str, dict[str, dict[str, float | None]]]:
    """The means, split -> method -> metric -> mean, rounded to 6 decimals; only what was scored."""
    scores = list(scores)
    result: dict[str, dict[str, dict[str, float | None]]] = {}
    metrics = list(metrics)
    for split in (HELD_OUT, TRAINING):
        for method in METHODS:
            if any(one.split == split and one.method == method for one in scores):
                means = {metric: mean(scores, split, method, metric) for metric in metrics}
                rounded = {name: None if value is None else round(value, 6) for name, value in means.items()}
                result.setdefault(split, {})[method] = rounded
    return result


def write_scores(path: Path, scores: Iterable[Score]) -> None:
    """Writes ``metrics.parquet``: frame int32, split, method, metric string, value float64.

    What is not defined (the interior of a frame that has none) has no row.
    """
    rows = [row for row in scores if not math.isnan(row.value)]
    columns = {name: np.array([getattr(row, name) for row in rows]) for name in SCHEMA.names}
    write_table(path, SCHEMA, columns)
