"""The plan as a table that a person can read."""

from __future__ import annotations

import dataclasses

from pipeline.plan import EFFECTS, Plan


@dataclasses.dataclass(frozen=True)
class PlanRow:
    """One effect.

    Attributes:
        effect: its name.
        on, forced: whether it was built, and whether a setting said so.
        measured, threshold: numbers, the latter with its unit.
        why: one sentence.
    """

    effect: str
    on: bool
    forced: bool
    measured: str
    threshold: str
    why: str


def plan_rows(plan: Plan) -> list[PlanRow]:
    """The decisions in the order of the list of effects."""
    rows = []
    for effect in EFFECTS:
        one = plan[effect]
        threshold = f"{_number(one.threshold)} {one.unit}"
        rows.append(
            PlanRow(effect.replace("_", " "), one.on, one.forced, _number(one.measured), threshold, one.why)
        )
    return rows


def _number(value: float) -> str:
    return f"{value:.3g}"
