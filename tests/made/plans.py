"""Plans for tests: everything on, but for what a test changes."""

from __future__ import annotations

from pipeline.clip.plan import EFFECTS, Decision, Plan


def plan_of(**on: bool) -> Plan:
    """A plan in which every effect is on but those that are given otherwise."""
    decisions = [Decision(name, on.get(name, True), 1.0, 0.5, "of a test", "made up") for name in EFFECTS]
    return Plan(tuple(decisions))
