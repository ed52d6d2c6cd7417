"""The plan as a table that a person can read."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from pipeline.plan import EFFECTS, Plan


@dataclasses.dataclass(frozen=True)
class PlanRow:
    """One effect.

    Attributes:
        effect: its name.
        on, forced: whether it was built, and whether a setting said so.
        measured, threshold: numbers, the latter with its unit.
        why: one sentence.
        saved: what leaving it out saved, where it was measured.
    """

    effect: str
    on: bool
    forced: bool
    measured: str
    threshold: str
    why: str
    saved: str


def plan_rows(plan: Plan, savings: Mapping[str, Mapping[str, float]]) -> list[PlanRow]:
    """The decisions in the order of the list of effects.

    Args:
        plan: of the subject.
        savings: effect -> ``seconds`` or ``gaussians`` that were saved.
    """
    rows = []
    for effect in EFFECTS:
        one = plan[effect]
        threshold = f"{_number(one.threshold)} {one.unit}"
        rows.append(
            PlanRow(
                effect.replace("_", " "), one.on, one.forced, _number(one.measured), threshold, one.why,
                saved(savings.get(effect, {})),
            )
        )  # fmt: skip
    return rows


def saved(cost: Mapping[str, float]) -> str:
    """A measured cost in words; empty where none was measured."""
    if "gaussians" in cost:
        return f"{cost['gaussians']:.0f} body vertices without a Gaussian"
    return f"{cost['seconds']:.1f} s of training" if "seconds" in cost else ""


def _number(value: float) -> str:
    return f"{value:.3g}"
