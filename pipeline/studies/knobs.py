"""The knobs of a study of what accuracy costs: each with its levels, around the study's own settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

LEVELS = ("no subdivision", "one subdivision", "two subdivisions")
CHANCE = "chance"  # the knob that buys nothing: another seed


@dataclasses.dataclass(frozen=True)
class Level:
    """One setting of a knob.

    Attributes:
        label: for tables and plots.
        words: what differs from the study's own settings; none for the level that these have.
        factor: how many times longer training is thought to take than at the study's own level, until
            a point of it has been made.
    """

    label: str
    words: Mapping[str, str] = dataclasses.field(default_factory=dict)
    factor: float = 1.0


@dataclasses.dataclass(frozen=True)
class Knob:
    """What can be turned.

    Attributes:
        name: for tables.
        levels: the study's own first.
        combines: whether a level of it may be joined with other knobs'.
    """

    name: str
    levels: tuple[Level, ...]
    combines: bool = True


def knobs_of(settings: Mapping[str, Any]) -> tuple[Knob, ...]:
    """The knobs around a base.

    Args:
        settings: stage -> its settings object, of the study's own words.
    """
    train, fit, ingest = settings["train"], settings["fit"], settings["ingest"]
    knobs = [
        _iterations(train),
        _gaussians(train, settings["plan"]),
        _image(ingest),
        _fit_effort(fit),
        _switch("precision", train.half_precision, ("bfloat16", "float32"), "train.half_precision", 1.5),
        *_effects(settings),
        Knob(
            CHANCE,
            (Level(f"seed {train.seed}"), _level(f"seed {train.seed + 1}", seed=train.seed + 1)),
            False,
        ),
    ]
    return tuple(knob for knob in knobs if len(knob.levels) > 1)


def _level(label: str, factor: float = 1.0, stage: str = "train", **words: Any) -> Level:
    return _worded(label, factor, stage, words)


def _worded(label: str, factor: float, stage: str, words: Mapping[str, Any]) -> Level:
    return Level(label, {f"{stage}.{name}": _text(value) for name, value in words.items()}, factor)


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def curve_words(iterations: int) -> dict[str, Any]:
    """So that a run has five points on its curve at least, and is resumed with little lost."""
    return {"held_out_every": max(1, min(250, iterations // 5))}


def _iterations(train: Any) -> Knob:
    def level(count: int, factor: float) -> Level:
        return _level(f"{count:,} iterations", factor, iterations=count, **curve_words(count))

    counts = [(max(1, round(train.iterations * factor)), factor) for factor in (0.5, 2.0, 4.0)]
    return Knob("iterations", (Level(f"{train.iterations:,} iterations"), *(level(*one) for one in counts)))


def _gaussians(train: Any, plan: Any) -> Knob:
    """Levels of subdivision whatever the pixels; the study's own is what the plan leaves of it."""
    own = 0 if plan.subdivision == "off" else train.subdivisions
    planned = own > 0 and plan.subdivision == "auto"  # then nobody knows yet which of them it is
    others = [
        Level(
            LEVELS[level],
            {"train.subdivisions": str(level), "plan.subdivision": "on"},
            1.8 ** (level - own),
        )
        for level in range(len(LEVELS))
        if planned or level != own
    ]
    return Knob("number of Gaussians", (Level(mesh_of(train, plan)), *others))


def mesh_of(train: Any, plan: Any) -> str:
    """How fine a run's mesh becomes, in words.

    Args:
        train, plan: the two stages' settings.
    """
    own = 0 if plan.subdivision == "off" else train.subdivisions
    return f"at most {LEVELS[own]}" if own and plan.subdivision == "auto" else LEVELS[own]


def _image(ingest: Any) -> Knob:
    # A mannequin is filmed at the size that it has; footage is reduced.
    side, field = (
        (ingest.mannequin_size, "mannequin_size") if ingest.mannequin else (ingest.long_side, "long_side")
    )

    def level(factor: float) -> Level:
        size = 8 * round(side * factor / 8)
        return _worded(f"{size} px", factor**0.5, "ingest", {field: size})

    return Knob("image size", (Level(f"{side} px"), level(0.5), level(1.5)))


def _fit_effort(fit: Any) -> Knob:
    counts = [round(fit.iterations * factor) for factor in (0.25, 2.0)]
    others = [_level(f"fit of {count} steps", 1.0, "fit", iterations=count) for count in counts if count]
    return Knob("fit effort", (Level(f"fit of {fit.iterations} steps"), *others))


def _switch(name: str, on: bool, labels: tuple[str, str], word: str, factor: float) -> Knob:
    """A truth value: what it is, and the other."""
    own, other = labels if on else labels[::-1]
    return Knob(name, (Level(own), Level(other, {word: _text(not on)}, factor)))


def _effects(settings: Mapping[str, Any]) -> list[Knob]:
    """Each effect that the base has without it, and each that it lacks with it."""
    plan, train = settings["plan"], settings["train"]

    def without(name: str, effect: str, factor: float) -> Knob | None:
        if getattr(plan, effect) == "off":
            return None
        return Knob(
            name, (Level(f"with {name}"), _level(f"without {name}", factor, "plan", **{effect: "off"}))
        )

    knobs = [
        without("pose heads", "pose_heads", 0.8) if train.pose_heads_from < 1 else None,
        _residuals(train),
        without("visibility gate", "visibility_gate", 1.5) if train.gate else None,
        without("pose refinement", "pose_refinement", 1.0) if train.refine_poses else None,
        _weight("face loss", train.face, "face", 0.8, 1.2),
        _weight("LPIPS", train.lpips, "lpips", 0.05, 1.2),
        _views(settings["auxiliary"]),
    ]
    return [knob for knob in knobs if knob is not None]


def _residuals(train: Any) -> Knob | None:
    if train.residual_from == 1 or not train.residual_parts:
        return None
    name = "residual colours"
    return Knob(name, (Level(f"with {name}"), _level(f"without {name}", 0.95, residual_from=1)))


def _weight(name: str, now: float, field: str, weight: float, factor: float) -> Knob:
    """A term of the objective: out if it is in, in with ``weight`` if it is out."""
    other = (
        _worded(f"without {name}", 1 / factor, "train", {field: 0})
        if now
        else _worded(f"with {name} ({weight:g})", factor, "train", {field: weight})
    )
    return Knob(name, (Level(f"{'with' if now else 'without'} {name}"), other))


def _views(auxiliary: Any) -> Knob:
    on = auxiliary.generator != "off"
    words = {"auxiliary.generator": "off" if on else "auto"}
    labels = ("with generated views", "without generated views")
    own, other = labels if on else labels[::-1]
    return Knob("generated views", (Level(own), Level(other, words, 1.1)))
