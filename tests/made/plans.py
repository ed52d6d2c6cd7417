"""Plans for tests: everything on, but for what a test changes."""

from __future__ import annotations

from pipeline.clip.plan import EFFECTS, Decision, Plan


def plan_of(**on: bool) -> Plan:
    """A plan in which every effect is on but those that are given otherwise."""
    numbers = {"gaussians": (3.0, 1000.0, ()), "steps": (5.0, 5.0, (8.0,))}  # no edge is as long
    decisions = []
    for name in EFFECTS:
        measured, threshold, values = numbers.get(name, (1.0, 0.5, ()))
        on_or_off = on.get(name, True)
        decisions.append(
            Decision(name, on_or_off, measured, threshold, "of a test", "made up", values=values)
        )
    return Plan(tuple(decisions))
