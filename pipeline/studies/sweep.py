"""The settings that a tradeoff tries, in a fixed order, and which points nothing beats.

Not a full grid: the base, then every level of every sweep parameter alone, then combinations of the levels
that gained most for their time. A design is the tuple of levels that differ from the base; () is the base.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from pipeline.studies.variants import Settings, another_seed

SUBDIVISIONS = ("no subdivision", "one subdivision", "two subdivisions")
CHANCE = "chance"  # the parameter that buys nothing: another seed
GAUSSIANS, PRECISION, REPRESENTATION = "number of Gaussians", "precision", "representation"
EDGES = (1.5, 0.7)  # times the base's longest edge between Gaussians
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
    ("steps", "train.iterations", (0.5, 2.0, 4.0), 1, 1.0, "{:,} iterations"),
    ("steps", "train.effort", (0.5, 2.0, 4.0), 0.01, 1.0, "{:g} times the plan's steps"),
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


def sweep_levels(settings: Settings) -> list[Level]:
    """Every level to try alone: each parameter's first before any parameter's second, the fastest first."""
    levels = [
        *_scaled(settings),
        *_gaussians(settings),
        *_kinds(settings),
        *_switched(settings),
        _chance(settings),
    ]
    parameters = pd.Series([level.parameter for level in levels])
    depths = parameters.groupby(parameters).cumcount()
    return [level for _, level in sorted(zip(depths, levels, strict=True), key=lambda x: (x[0], x[1].factor))]


def _scaled(settings: Settings) -> Iterator[Level]:
    """Multiples of the base's own number."""
    for parameter, name, factors, multiple, exponent, words in SCALED:
        name = name or picture_setting(settings["ingest"])
        own = setting_of(settings, name)
        if name == "train.effort" and settings["train"].iterations:
            continue  # it is without effect then
        for factor in factors:
            value = round(multiple * round(own * factor / multiple), 2)
            if value:
                overrides = ((name, str(value)),)
                yield Level(parameter, words.format(own), words.format(value), overrides, factor**exponent)


def setting_of(settings: Settings, name: str) -> Any:
    """The value of a setting such as ``train.iterations``."""
    stage, _, field = name.partition(".")
    return getattr(settings[stage], field)


def picture_setting(ingest: Any) -> str:
    """The setting of a picture's size in pixels: footage is reduced, a mannequin is filmed at it."""
    return "ingest.mannequin_size" if ingest.mannequin else "ingest.long_side"


def _kinds(settings: Settings) -> Iterator[Level]:
    """The other representation, and the other precision where heads have one."""
    train = settings["train"]
    if is_triplane(settings):
        words = ("float32", "bfloat16")
        overrides = (("train.half_precision", str(not train.half_precision).lower()),)
        yield Level(PRECISION, words[train.half_precision], words[not train.half_precision], overrides, 1.5)
        yield Level(REPRESENTATION, "triplane", "bases", (("train.representation", "bases"),), 0.2)
    else:
        yield Level(REPRESENTATION, "bases", "triplane", (("train.representation", "triplane"),), 5.0)


def is_triplane(settings: Settings) -> bool:
    """True where the avatar is a triplane."""
    return settings["train"].representation == "triplane"


def _gaussians(settings: Settings) -> Iterator[Level]:
    """The density of the Gaussians: of bases the longest edge, of a triplane levels of subdivision."""
    if not is_triplane(settings):
        own = settings["plan"].edge_pixels
        for factor in EDGES:
            text = f"{round(own * factor, 1):g}"
            overrides = (("plan.edge_pixels", text),)
            yield Level(GAUSSIANS, mesh_of(settings), f"edges of {text} px", overrides, factor**-1.0)
        return
    mesh = mesh_of(settings)
    own = next(count for count, label in enumerate(SUBDIVISIONS) if mesh.endswith(label))
    for count, label in enumerate(SUBDIVISIONS):
        if label != mesh:  # "at most one": nobody knows yet whether it is none or one
            finer = (("train.subdivisions", str(count)), ("plan.subdivision", "on"))
            yield Level(GAUSSIANS, mesh, label, finer, 1.8 ** (count - own))


def mesh_of(settings: Settings) -> str:
    """The fineness of a run's mesh in words."""
    if not is_triplane(settings):
        return f"edges of {settings['plan'].edge_pixels:g} px"
    plan = settings["plan"].subdivision
    own = 0 if plan == "off" else settings["train"].subdivisions
    return f"at most {SUBDIVISIONS[own]}" if own and plan == "auto" else SUBDIVISIONS[own]


def _switched(settings: Settings) -> Iterator[Level]:
    """Each part that the base has left out, and each that it lacks and could have added."""
    train = settings["train"]
    idle = {  # parts that other settings of the base leave nothing to do
        "pose heads": train.pose_heads_from >= 1,
        "residual colours": not train.residual_parts or not is_triplane(settings),
        "visibility gate": not train.gate,
        "pose refinement": not train.refine_poses,
    }
    for part, setting, off, on, factor in SWITCHED:
        has, with_it, without = setting_of(settings, setting) != off, f"with {part}", f"without {part}"
        if has and not idle.get(part):
            yield Level(part, with_it, without, ((setting, str(off)),), 1 / factor)
        elif not has and on is not None:
            with_it += f" ({on})" if on != "auto" else ""
            yield Level(part, without, with_it, ((setting, str(on)),), factor)


def _chance(settings: Settings) -> Level:
    """Another seed."""
    overrides = tuple(another_seed(settings).overrides.items())
    return Level(CHANCE, f"seed {settings['train'].seed}", f"seed {overrides[0][1]}", overrides)


def noise_of(points: pd.DataFrame) -> float:
    """How far another seed's PSNR is off, dB; NaN where none was reached."""
    return points.loc[points["chance"], "gain"].abs().max()


def combinations(points: pd.DataFrame) -> list[Design]:
    """Pairs, then triples and more, of the levels that gained most for their time, the best first.

    Levels count that gain more than chance does, and those that nothing beats, for they save time.

    Args:
        points: the base and what was tried so far: ``design``; ``gain``, dB over the base; ``times``,
            training time over the base's; ``chance``, true of another seed.
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
