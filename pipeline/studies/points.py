"""The points of a tradeoff in one table, which of them nothing beats, and what to combine."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipeline.studies.measure import Numbers, score_table
from pipeline.studies.sweep import CHANCE, Design
from pipeline.studies.variants import Result

MOST_COMBINED = 6  # levels that combinations are made of: 15 pairs, 20 triples, ...


def point_table(
    designs: Mapping[Design, Result],
    presets: Mapping[str, Result] | None = None,
    speeds: Mapping[Path, Numbers] | None = None,
) -> pd.DataFrame:
    """The points of a tradeoff, numbered from 1, in the order of their making.

    Args:
        designs: the base's first.
        presets: by name; they come last.
        speeds: as ``AvatarMeter.speeds`` gives them.

    Returns:
        The columns of ``score_table``; ``label``, as ``1. base``; ``design``, None of a preset; ``preset``,
        empty of others; ``times``, training cost over the base's; ``gain``, dB over the base; ``chance``,
        true of another seed, which is no choice; and ``short``, dB under the frontier, of the others.
    """
    presets = presets or {}
    results = enumerate([*designs.values(), *presets.values()], 1)
    points = score_table(dict(results), speeds or {})
    points["label"] = [f"{number}. {result.variant}" for number, result in points["result"].items()]
    points["design"] = pd.Series([*designs, *[None] * len(presets)], points.index, dtype=object)
    points["preset"] = [*[""] * len(designs), *presets]
    points["chance"] = [bool(design) and design[0].parameter == CHANCE for design in points["design"]]
    points["times"] = points["train_s"] / max(points["train_s"].iloc[0], 1e-9)
    points["gain"] = points["psnr"] - points["psnr"].iloc[0]
    choices = points[~points["chance"]]
    points["short"] = shortfalls(choices["train_s"], choices["psnr"])
    return points


def noise_of(points: pd.DataFrame) -> float:
    """How far another seed's PSNR is off, dB; NaN where none was reached."""
    return points.loc[points["chance"], "gain"].abs().max()


def combinations(points: pd.DataFrame) -> list[Design]:
    """Pairs, then triples and more, of the levels that gained most for their time, the best first.

    Levels count that gain more than chance does, and those that nothing beats, for they save time.

    Args:
        points: the base and what was tried so far, as ``point_table`` gives them.
    """
    noise = noise_of(points)
    alone = points[~points["chance"] & points["design"].map(len).le(1)].dropna(subset=["gain", "times"])
    unbeaten = alone.index.isin(frontier(alone["times"], alone["gain"]))
    gaining = alone["gain"] > (noise if math.isfinite(noise) else 0.0)
    kept = alone[(gaining | unbeaten) & alone["design"].map(bool)]
    best = kept["design"][worth_of(kept).sort_values(kind="stable").index[::-1]][:MOST_COMBINED]
    return [
        tuple(levels)
        for size in range(2, MOST_COMBINED + 1)
        for levels in itertools.combinations(itertools.chain(*best), size)
        if len({level.parameter for level in levels}) == size
    ]


def worth_of(points: pd.DataFrame) -> pd.Series:
    """Quality gained for each e-fold of training time; a loss counts as it is.

    Args:
        points: ``gain``, dB over the base; ``times``, training time over the base's.
    """
    worth = points["gain"] / np.log(points["times"].clip(lower=1.02))
    return worth.where(points["gain"] > 0, points["gain"])


def frontier(costs: pd.Series, qualities: pd.Series) -> list[Any]:
    """The labels of the points that no other dominates, the cheapest first.

    A point dominates another if it costs no more and is no worse, and one of the two is strict. Of points
    that are equal in both, the first one stands for all. Points with a number that is not finite never count.

    Args:
        costs: less is better.
        qualities: more is better; of the same index.
    """
    points = pd.DataFrame({"cost": costs, "quality": qualities}).astype(float)
    points = points[points.abs().lt(math.inf).all(axis=1)]
    points = points.sort_values(["cost", "quality"], ascending=[True, False], kind="stable")
    before = points["quality"].cummax().shift(fill_value=-math.inf)
    return points.index[points["quality"] > before].tolist()


def shortfalls(costs: pd.Series, qualities: pd.Series) -> pd.Series:
    """The quality that each point lacks against the best of those that cost no more; 0 on the frontier."""
    best = costs.map(lambda cost: qualities[costs <= cost].max())
    return (best - qualities).clip(lower=0.0)
