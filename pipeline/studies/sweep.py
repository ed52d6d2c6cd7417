"""The settings that a tradeoff tries alone, in a fixed order, and how large and fine the base's own are."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from pipeline.studies.variants import Settings, another_seed

SUBDIVISIONS = ("no subdivision", "one subdivision", "two subdivisions")
CHANCE = "chance"  # the parameter that buys nothing: another seed
GAUSSIANS, PRECISION, REPRESENTATION = "number of Gaussians", "precision", "representation"
EDGES = (1.5, 0.7)  # times the base's longest edge between Gaussians


@dataclasses.dataclass(frozen=True)
class Level:
    """One value of a sweep parameter that is not the base's.

    Attributes:
        parameter: its name.
        before: the base's own value, for tables.
        label: this value, for tables.
        overrides: settings on top of the base's.
        factor: training time over the base's, as guessed until it has been measured.
    """

    parameter: str
    before: str
    label: str
    overrides: Mapping[str, str] = dataclasses.field(hash=False)
    factor: float = 1.0


Design = tuple[Level, ...]


def label_of(design: Design) -> str:
    """A design's name in tables."""
    return ", ".join(level.label for level in design) or "base"


def overrides_of(design: Design) -> dict[str, str]:
    """The settings that a design sets on top of the base's."""
    return {name: text for level in design for name, text in level.overrides.items()}


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
    seed = another_seed(settings).overrides
    chance = Level(CHANCE, f"seed {settings['train'].seed}", f"seed {seed['train.seed']}", seed)
    levels = pd.DataFrame([*_scaled(settings), *_gaussians(settings), *_switched(settings), chance])
    levels["depth"] = levels.groupby("parameter").cumcount()
    rows = levels.sort_values(["depth", "factor"], kind="stable").drop(columns="depth")
    return [Level(*row) for row in rows.itertuples(index=False)]


def setting_of(settings: Settings, name: str) -> Any:
    """The value of a setting such as ``train.iterations``."""
    stage, _, field = name.partition(".")
    return getattr(settings[stage], field)


def picture_setting(settings: Settings) -> str:
    """The setting of a picture's size in pixels: footage is reduced, a mannequin is filmed at it."""
    return "ingest.mannequin_size" if settings["ingest"].mannequin else "ingest.long_side"


def is_triplane(settings: Settings) -> bool:
    """True where the avatar is a triplane."""
    return settings["train"].representation == "triplane"


def mesh_of(settings: Settings) -> str:
    """The fineness of a run's mesh in words."""
    if not is_triplane(settings):
        return f"edges of {settings['plan'].edge_pixels:g} px"
    plan = settings["plan"].subdivision
    own = 0 if plan == "off" else settings["train"].subdivisions
    return f"at most {SUBDIVISIONS[own]}" if own and plan == "auto" else SUBDIVISIONS[own]


def sizes_of(settings: Settings) -> str:
    """How large and how long a run is, in words."""
    train, side = settings["train"], setting_of(settings, picture_setting(settings))
    steps = f"{train.iterations:,} iterations"
    steps = steps if train.iterations else f"{train.effort:g} times the plan's steps"
    short = 0 < train.iterations < 1000
    small = "; small: a part that needs a long run shows less than it is worth" if short else ""
    return f"{steps}, {mesh_of(settings)}, pictures of {side} px{small}"


def _scaled(settings: Settings) -> Iterator[Level]:
    """Multiples of the base's own number."""
    for parameter, name, factors, multiple, exponent, words in SCALED:
        name = name or picture_setting(settings)
        own = setting_of(settings, name)
        if name == "train.effort" and settings["train"].iterations:
            continue  # it is without effect then
        for factor in factors:
            value = round(multiple * round(own * factor / multiple), 2)
            if value:
                override = {name: str(value)}
                yield Level(parameter, words.format(own), words.format(value), override, factor**exponent)


def _gaussians(settings: Settings) -> Iterator[Level]:
    """The density of the Gaussians; the other representation; and the other precision of heads.

    The density of bases is their longest edge, that of a triplane levels of subdivision.
    """
    mesh = mesh_of(settings)
    if not is_triplane(settings):
        for factor in EDGES:
            text = f"{round(settings['plan'].edge_pixels * factor, 1):g}"
            yield Level(GAUSSIANS, mesh, f"edges of {text} px", {"plan.edge_pixels": text}, factor**-1.0)
        yield Level(REPRESENTATION, "bases", "triplane", {"train.representation": "triplane"}, 5.0)
        return
    own = next(count for count, label in enumerate(SUBDIVISIONS) if mesh.endswith(label))
    for count, label in enumerate(SUBDIVISIONS):
        if label != mesh:  # "at most one": nobody knows yet whether it is none or one
            finer = {"train.subdivisions": str(count), "plan.subdivision": "on"}
            yield Level(GAUSSIANS, mesh, label, finer, 1.8 ** (count - own))
    half, words = settings["train"].half_precision, ("float32", "bfloat16")
    yield Level(PRECISION, words[half], words[not half], {"train.half_precision": str(not half).lower()}, 1.5)
    yield Level(REPRESENTATION, "triplane", "bases", {"train.representation": "bases"}, 0.2)


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
            yield Level(part, with_it, without, {setting: str(off)}, 1 / factor)
        elif not has and on is not None:
            with_it += f" ({on})" if on != "auto" else ""
            yield Level(part, without, with_it, {setting: str(on)}, factor)
