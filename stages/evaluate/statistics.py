"""Means, intervals and differences: group-bys on the table of scores."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from pipeline.metrics.intervals import Interval, interval
from pipeline.metrics.psnr import PSNR_CAP
from stages.evaluate.methods import AVATAR, METHODS
from stages.evaluate.scores import HELD_OUT, OTHER_CAMERA, SPLITS, TRAINING, VIEWS
from stages.evaluate.settings import EvaluateSettings

DECIMALS = 6
"""To which every number of ``summary.json`` is rounded."""

Means = dict[str, dict[str, dict[str, float | None]]]
"""split -> method -> metric -> mean over frames; None where no frame has it."""

Intervals = dict[str, dict[str, dict[str, list[float]]]]
"""split -> method -> metric -> the interval's ends."""

Differences = dict[str, dict[str, dict[str, float]]]
"""method -> metric -> mean, low, high, of avatar minus method."""


def means(table: pd.DataFrame, metrics: Sequence[str]) -> Means:
    """The means of what was scored.

    Frames that lack a metric, such as an interior, are left out of its mean. A method has every metric of
    the main table, except in a mannequin's cameras, and of the others those that it was measured in.

    Args:
        table: the scores.
        metrics: those of the main table.
    """
    known = table.groupby(["split", "method", "metric"])["value"].agg(exact_mean).to_dict()
    result: Means = {}
    for split in SPLITS:
        for method in METHODS:
            measured = {metric for *key, metric in known if tuple(key) == (split, method)}
            if measured:
                main = metrics if split != VIEWS else ()
                further = measured - set(metrics)
                names = [*main, *sorted(further), *(sorted(measured - further) if split == VIEWS else ())]
                values = {name: known.get((split, method, name), math.nan) for name in names}
                result.setdefault(split, {})[method] = {
                    name: None if math.isnan(value) else round(value, DECIMALS)
                    for name, value in values.items()
                }
    return result


def exact_mean(values: pd.Series) -> float:
    """The mean of what is defined, whose rounding does not depend on the order; NaN where nothing is."""
    defined = values.dropna()
    return math.fsum(defined) / len(defined) if len(defined) else math.nan


def further_metrics(table: pd.DataFrame, metrics: Sequence[str]) -> list[str]:
    """The metrics that were measured besides those of the main table, sorted by name."""
    return sorted(set(table["metric"]) - set(metrics))


def intervals(table: pd.DataFrame, settings: EvaluateSettings) -> Intervals:
    """The intervals in which each mean of the clip's own cameras would lie were the frames drawn anew."""
    result: Intervals = {}
    own = table[table["split"] != VIEWS]
    for (split, method, metric), values in own.groupby(["split", "method", "metric"], sort=False)["value"]:
        # Training frames are spread over the clip: none of those that are scored is the next of another.
        found = bootstrap(values, settings, block=1 if split == TRAINING else None)
        if found is not None:
            ends = np.clip([found.low, found.high], *bounds(metric)).tolist()
            places = result.setdefault(split, {}).setdefault(method, {})
            places[metric] = [round(value, DECIMALS) for value in ends]
    return result


def differences(table: pd.DataFrame, metrics: Sequence[str], settings: EvaluateSettings) -> Differences:
    """Avatar minus each other method on the held-out frames that both have, frame by frame.

    Frames are hard or easy for all methods alike, so that differences are surer than means.
    """
    held_out = table[table["split"] == HELD_OUT].set_index("frame")
    by_method = dict(list(held_out.groupby(["method", "metric"])["value"]))
    result: Differences = {}
    for method in METHODS:
        for metric in metrics:
            own, other = by_method.get((AVATAR, metric)), by_method.get((method, metric))
            if method == AVATAR or own is None or other is None:
                continue
            found = bootstrap(own.reindex(other.index) - other, settings)
            if found is not None:
                ends = {name: round(value, DECIMALS) for name, value in dataclasses.asdict(found).items()}
                result.setdefault(method, {})[metric] = ends
    return result


def means_by_camera(table: pd.DataFrame, metrics: Sequence[str]) -> dict[str, Means]:
    """The means in each camera that is not the training frames'; empty where there is none.

    Where some held-out frames are another camera's, those of the training camera stand beside them.
    """
    cameras = sorted(set(table.loc[table["split"] == VIEWS, "view"]))
    if (table["view"] == OTHER_CAMERA).any():
        cameras += ["", OTHER_CAMERA]
    return {camera or "training camera": means(table[table["view"] == camera], metrics) for camera in cameras}


def bounds(metric: str) -> tuple[float, float]:
    """The least and the largest value that a metric can have, which a stretched interval knows nothing of."""
    if metric in ("identity_found", "unseen_share"):
        return 0.0, 1.0
    if metric.startswith(("ssim", "identity_cosine", "arcface_cosine")):
        return -1.0, 1.0
    return (-math.inf, PSNR_CAP) if metric.startswith("psnr") else (0.0, math.inf)


def bootstrap(values: pd.Series, settings: EvaluateSettings, block: int | None = None) -> Interval | None:
    """The interval of a mean over frames, as the settings ask for it; None without a defined value."""
    rounds, seed = settings.bootstrap_rounds, settings.bootstrap_seed
    return interval(values.to_numpy(float), rounds, seed, settings.confidence, block)


def summary_of_scores(
    table: pd.DataFrame, metrics: Sequence[str], settings: EvaluateSettings
) -> dict[str, Any]:
    """The statistics of ``summary.json``.

    ``means`` is split -> method -> metric -> mean over frames; ``intervals`` has the same keys and the two
    ends; ``differences`` is method -> metric -> mean, low and high of avatar minus method on held-out
    frames; ``cameras`` is camera -> split -> method -> metric -> mean, where held-out frames come from other
    cameras or there are a mannequin's.

    Args:
        table: the scores.
        metrics: those of the main table.
        settings: of the intervals.
    """
    further = further_metrics(table, metrics)
    return {
        "metrics": list(metrics),
        "further_metrics": further,
        "means": means(table, metrics),
        "intervals": intervals(table, settings),
        "confidence": settings.confidence,
        "differences": differences(table, [*metrics, *further], settings),
        "cameras": means_by_camera(table, metrics),
    }
