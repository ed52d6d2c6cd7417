"""The plan: which effects a scene calls for, each with the number that decided it.

The plan stage looks at what ingest and fit published and writes ``plan.json``; later stages build only
what it names. Two effects have to be decided earlier, by the stages that they belong to: structure from
motion by ingest and face registration by fit. The plan gathers those, so that all stand in one table.

``plan.json`` is ``{"decisions": [...]}``, one object an effect, with the fields of :class:`Decision`,
sorted by effect.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, get_args

from pipeline.config.choices import BodyPart
from pipeline.errors import UserError
from pipeline.files.json_files import write_json
from pipeline.untrusted import parse_json

GATHERED = ("structure_from_motion", "face_registration")
"""Decided by ingest and by fit, which publish what the plan needs to know of it."""

DECIDED = (
    "face_residual",
    "left_hand_residual",
    "right_hand_residual",
    "face_loss",
    "subdivision",
    "gaussians",
    "pose_heads",
    "visibility_gate",
    "auxiliary_views",
    "pose_refinement",
    "test_time_refinement",
)
"""Decided by the plan stage, which has a setting (``on``, ``off`` or ``auto``) of each name."""

COUNTED = ("steps",)
"""A number for training that is neither on nor off; ``train.iterations`` is asked instead where it is set."""

SEEN_PARTS = tuple(f"seen_{part}" for part in get_args(BodyPart))
"""One for each part of the body: is it ever seen? Measured as the share of training frames that show it."""

EFFECTS = (*GATHERED, *DECIDED, *COUNTED, *SEEN_PARTS)

AZIMUTH_STEP = 30  # degrees, of the bins in which auxiliary_views counts what was never seen

_REMEDY = "run the plan stage again"


@dataclasses.dataclass(frozen=True)
class Decision:
    """One effect, on or off.

    Attributes:
        effect: one of ``EFFECTS``.
        on: whether it is built.
        measured: the number that was looked at.
        threshold: what it was compared with.
        unit: of both, in a few words.
        why: one sentence for people.
        forced: whether a setting decided instead of the number.
        values: what else was measured. Of ``auxiliary_views``: the azimuths that no training frame
            saw, centres of bins of ``AZIMUTH_STEP`` degrees. Azimuth 0 is a camera in front of the
            person, 90 one on the person's left, 180 one behind. Of ``subdivision``: how many levels the
            pixels call for. Of ``gaussians``: how many each of ``pipeline.body.PARTS`` gets; edges are split
            down to the threshold. Of ``steps``: how many optimiser steps.
    """

    effect: str
    on: bool
    measured: float
    threshold: float
    unit: str
    why: str
    forced: bool = False
    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Refuses an effect that does not exist and numbers that are not finite."""
        if self.effect not in EFFECTS:
            raise ValueError(f"there is no effect '{self.effect}'")
        if not all(math.isfinite(number) for number in (self.measured, self.threshold, *self.values)):
            raise ValueError(f"{self.effect}: its numbers must be finite")


@dataclasses.dataclass(frozen=True)
class Plan:
    """Every decision, one an effect."""

    decisions: tuple[Decision, ...]

    def __post_init__(self) -> None:
        """Refuses a plan in which an effect is missing or stands twice."""
        names = [decision.effect for decision in self.decisions]
        if sorted(names) != sorted(EFFECTS):
            odd = sorted({*EFFECTS} - {*names}) or sorted(name for name in names if names.count(name) > 1)
            raise ValueError(f"a plan has one decision an effect, and {', '.join(odd)} has not")

    def __getitem__(self, effect: str) -> Decision:
        """The decision on an effect; KeyError where there is no such effect."""
        for decision in self.decisions:
            if decision.effect == effect:
                return decision
        raise KeyError(effect)

    def on(self, effect: str) -> bool:
        """True where an effect is built."""
        return self[effect].on


def write_plan(path: Path, plan: Plan) -> None:
    """Writes ``plan.json``; equal plans give equal bytes."""
    ordered = sorted(plan.decisions, key=lambda decision: decision.effect)
    write_json(path, {"decisions": [dataclasses.asdict(decision) for decision in ordered]})


def read_plan(path: Path) -> Plan:
    """Reads ``plan.json``.

    Raises:
        UserError: it is missing, malformed, lacks an effect or names one that does not exist.
    """
    content = parse_json(path, _REMEDY)
    rows = content.get("decisions") if isinstance(content, dict) and set(content) == {"decisions"} else None
    if not isinstance(rows, list):
        raise UserError(f"{path}: must hold a list of decisions and nothing else: {_REMEDY}")
    try:
        return Plan(tuple(_decision(row) for row in rows))
    except ValueError as error:
        raise UserError(f"{path}: {error}: {_REMEDY}") from None


def _decision(row: Any) -> Decision:
    names = [field.name for field in dataclasses.fields(Decision)]
    if not isinstance(row, dict) or sorted(row) != sorted(names):
        raise ValueError(f"the fields of a decision are {', '.join(names)}")
    numbers = row["values"]
    if not isinstance(numbers, list) or not all(
        map(_is_number, (*numbers, row["measured"], row["threshold"]))
    ):
        raise ValueError("measured, threshold and values must be numbers")
    if not all(isinstance(row[name], str) for name in ("effect", "unit", "why")):
        raise ValueError("effect, unit and why must be text")
    if not all(isinstance(row[name], bool) for name in ("on", "forced")):
        raise ValueError("on and forced must be true or false")
    return Decision(**{**row, "values": tuple(numbers)})


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
