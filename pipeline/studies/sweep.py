"""The settings that a tradeoff tries, in a fixed order, and which points nothing beats.

Not a full grid: the base, then every level of every sweep parameter alone, then combinations of the levels
that gained most for their time. A design is the tuple of levels that differ from the base; () is the base.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

SUBDIVISIONS = ("no subdivision", "one subdivision", "two subdivisions")
CHANCE = "chance"  # the parameter that buys nothing: another seed
GAUSSIANS, PRECISION = "number of Gaussians", "precision"
MOST_COMBINED = 6  # levels that combinations are made of: 15 pairs, 20 triples, ...


@dataclasses.dataclass(frozen=True)
class Level:
    """One value of a sweep parameter that is not the base's.

    Attributes:
        parameter: its name.
        before: the base's own value, for tables.
        label: this value, for tables.
        overrides: settings on top of the base's, as (name, text).
        factor: training time over the base's, as guessed until it has been measured.
    """

    parameter: str
    before: str
    label: str
    overrides: tuple[tuple[str, str], ...]
    factor: float = 1.0


Design = tuple[Level, ...]


def label_of(design: Design) -> str:
    """A design's name in tables."""
    return ", ".join(level.label for level in design) or "base"


def overrides_of(design: Design) -> dict[str, str]:
    """The settings that a design sets on top of the base's."""
    return {name: text for level in design for name, text in level.overrides}


SCALED = (
    # parameter, its setting, factors, what the number is a multiple of, exponent of training time, in words
    ("iterations", "train.iterations", (0.5, 2.0, 4.0), 1, 1.0, "{:,} iterations"),
    ("image size", "", (0.5, 1.5), 8, 0.5, "{} px"),
    ("fit effort", "fit.iterations", (0.25, 2.0), 1, 0.0, "fit of {} steps"),
)
SWITCHED = (
    # part, its setting, the value without it, the value that adds it (where it can be added), time factor
    ("pose heads", "plan.pose_heads", "off", None, 1.25),
    ("residual colours", "train.residual_from", 1, None, 1.05),
    ("visibility gate", "plan.visibility_gate", "off", None, 0.7),
    ("pose refinement", "plan.pose_refinement", "off", None, 1.0),
    ("face loss", "train.face", 0, 0.8, 1.2),
    ("LPIPS", "train.lpips", 0, 0.05, 1.2),
    ("generated views", "auxiliary.generator", "off", "auto", 1.1),
)


def sweep_levels(settings: Mapping[str, Any]) -> list[Level]:
    """Every level to try alone: each parameter's first before any parameter's second, the fastest first.

    Args:
        settings: stage -> settings of the base.
    """
    train = settings["train"]
    half, words, seed = train.half_precision, ("float32", "bfloat16"), train.seed
    precision = (("train.half_precision", str(not half).lower()),)
    parameters = [
        *_scaled(settings),
        _gaussians(train, settings["plan"]),
        [Level(PRECISION, words[half], words[not half], precision, 1.5)],
        *_switched(settings),
        [Level(CHANCE, f"seed {seed}", f"seed {seed + 1}", (("train.seed", str(seed + 1)),))],
    ]
    ranked = [(depth, level) for levels in parameters for depth, level in enumerate(levels)]
    return [level for _, level in sorted(ranked, key=lambda one: (one[0], one[1].factor))]


def _scaled(settings: Mapping[str, Any]) -> list[list[Level]]:
    """Parameters whose levels are multiples of the base's own number."""
    found = []
    for parameter, name, factors, multiple, exponent, words in SCALED:
        name = name or picture_setting(settings["ingest"])
        own = setting_of(settings, name)
        values = {factor: multiple * round(own * factor / multiple) for factor in factors}
        found.append([
            Level(parameter, words.format(own), words.format(value), ((name, str(value)),), factor**exponent)
            for factor, value in values.items()
            if value
        ])  # fmt: skip
    return found


def setting_of(settings: Mapping[str, Any], name: str) -> Any:
    """The value of a setting such as ``train.iterations``."""
    stage, _, field = name.partition(".")
    return getattr(settings[stage], field)


def picture_setting(ingest: Any) -> str:
    """The setting of a picture's size in pixels: footage is reduced, a mannequin is filmed at it."""
    return "ingest.mannequin_size" if ingest.mannequin else "ingest.long_side"


def _gaussians(train: Any, plan: Any) -> list[Level]:
    """Levels of subdivision whatever the pixels; the base's own is what the plan leaves of it."""
    own = 0 if plan.subdivision == "off" else train.subdivisions
    planned = own > 0 and plan.subdivision == "auto"  # then nobody knows yet which of them it is
    overrides = [(("train.subdivisions", str(count)), ("plan.subdivision", "on")) for count in range(3)]
    return [
        Level(GAUSSIANS, mesh_of(train, plan), label, overrides[count], 1.8 ** (count - own))
        for count, label in enumerate(SUBDIVISIONS)
        if planned or count != own
    ]


def mesh_of(train: Any, plan: Any) -> str:
    """The fineness of a run's mesh in words.

    Args:
        train, plan: the two stages' settings.
    """
    own = 0 if plan.subdivision == "off" else train.subdivisions
    return f"at most {SUBDIVISIONS[own]}" if own and plan.subdivision == "auto" else SUBDIVISIONS[own]


def _switched(settings: Mapping[str, Any]) -> list[list[Level]]:
    """Each part that the base has left out, and each that it lacks and could have added."""
    train, found = settings["train"], []
    idle = {  # parts that other settings of the base leave nothing to do
        "pose heads": train.pose_heads_from >= 1,
        "residual colours": not train.residual_parts,
        "visibility gate": not train.gate,
        "pose refinement": not train.refine_poses,
    }
    for part, setting, off, on, factor in SWITCHED:
        has, with_it, without = setting_of(settings, setting) != off, f"with {part}", f"without {part}"
        if has and not idle.get(part):
            found.append([Level(part, with_it, without, ((setting, str(off)),), 1 / factor)])
        elif not has and on is not None:
            with_it += f" ({on})" if on != "auto" else ""
            found.append([Level(part, without, with_it, ((setting, str(on)),), factor)])
    return found


def combinations(alone: pd.DataFrame, noise: float) -> list[Design]:
    """Pairs, then triples and more, of the levels that gained most for their time, the best first.

    Levels count that gain more than chance does, and those that nothing beats, for they save time.

    Args:
        alone: a row a level that was tried alone: ``level``; ``gain``, dB over the base; ``ratio``, training
            time over the base's. The first row is the base, of level None.
        noise: the gain in dB that chance has; NaN where it is not known.
    """
    alone = alone[alone["gain"].notna() & alone["ratio"].notna()]
    least = noise if math.isfinite(noise) else 0.0
    unbeaten = alone.index.isin(frontier(alone["ratio"], alone["gain"]))
    kept = alone[((alone["gain"] > least) | unbeaten) & alone["level"].notna()]
    worth = [gain_for_time(row.gain, row.ratio) for row in kept.itertuples()]
    best = kept["level"].iloc[pd.Series(worth, dtype=float).argsort(kind="stable")[::-1]][:MOST_COMBINED]
    return [
        design
        for size in range(2, MOST_COMBINED + 1)
        for design in itertools.combinations(best, size)
        if len({level.parameter for level in design}) == size
    ]


def gain_for_time(gain: float, ratio: float) -> float:
    """Quality gained for each e-fold of training time; a loss counts as it is.

    Args:
        gain: dB over the base.
        ratio: training time over the base's.
    """
    return gain / math.log(max(ratio, 1.02)) if gain > 0 else gain


def frontier(costs: pd.Series, qualities: pd.Series) -> Sequence[Any]:
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
