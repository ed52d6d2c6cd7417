"""Minimising the objective: Adam over the whole clip, coarse to fine.

Root, place and shape first; then pose and expression; then the offsets, which would otherwise absorb
what a wrong pose leaves.

Coarse to fine in time too: at first neighbouring frames move together, since a step is the sum of bumps
in time whose width shrinks to a single frame. Steps of single frames are as rough as Adam's signs, and
what their acceleration costs then drowns what the keypoints ask for (an elbow stayed 11 pixels off).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from pipeline.threads import threads
from stages.fit.objective import Objective
from stages.fit.parameters import Parameters

RATES = {
    "betas": 0.02, "global_orient": 0.02, "body_pose": 0.02, "jaw": 0.02, "eyes": 0.01, "hands": 0.03,
    "expression": 0.05, "transl": 0.01, "face_control": 5e-4, "joint_offset": 1e-3,
}  # fmt: skip
"""Adam's step for each group of parameters: radians, metres or units of the coefficients."""

ROOT_UNTIL, OFFSETS_FROM, ROBUST_FROM = 0.15, 0.4, 0.3
PER_FRAME = ("global_orient", "body_pose", "jaw", "eyes", "hands", "expression", "transl")
BUMPS = ((0.0, 6.0), (0.3, 3.0), (0.6, 1.5), (0.85, 0.0))
"""From which share of the iterations on steps have which width in time: standard deviation in frames."""


def rate(name: str, done: float, frozen: frozenset[str] = frozenset()) -> float:
    """The step of a group of parameters when the share ``done`` of the iterations is over.

    Full until 60%, then 0.3, and 0.1 from 85%; zero for the groups that are ``frozen``.
    """
    if name in frozen or (name in ("joint_offset", "face_control") and done < OFFSETS_FROM):
        return 0.0
    share = 1.0 if done < 0.6 else 0.3 if done < 0.85 else 0.1
    if done < ROOT_UNTIL and name not in ("global_orient", "transl", "betas"):
        share *= 0.2 if name == "body_pose" else 0.0
    return RATES[name] * share


def bumps(times: Tensor, width: float) -> Tensor:
    """What a step of each frame moves of every frame: [T], in frames -> [T, T], rows sum to 1."""
    if width == 0:
        return torch.eye(len(times))
    weight = torch.exp(-(times[:, None] - times).square() / (2 * width**2))
    return weight / weight.sum(1, keepdim=True)


def stepped(base: Parameters, steps: Parameters, bump: Tensor) -> Parameters:
    """Parameters after steps: ``base`` plus steps spread in time by ``bump`` where there is a time."""
    moved = {}
    for name, value in base.named().items():
        step = getattr(steps, name)
        moved[name] = value + ((bump @ step.flatten(1)).view_as(step) if name in PER_FRAME else step)
    return Parameters(**moved)


def optimise(
    objective: Objective,
    initial: Parameters,
    iterations: int,
    frozen: frozenset[str] = frozenset(),
    learning_rate: float = 1.0,
    report: Callable[[str], None] = lambda note: None,
) -> Parameters:
    """Fit a clip.

    Args:
        objective: its loss.
        initial: where to start.
        iterations: steps.
        frozen: names of groups of parameters that stay as they are.
        learning_rate: factor on every step.
        report: called after each step with a note on the loss.

    Raises:
        FloatingPointError: the loss is not finite.
    """
    base = initial.detached()
    with threads(1):
        for begin, end, width in _phases(iterations):
            bump = bumps(objective.times, width)
            steps = base.zeros().leaves()
            groups = [{"params": [leaf], "name": name} for name, leaf in steps.named().items()]
            adam = torch.optim.Adam(groups, betas=(0.9, 0.99))
            for step in range(begin, end):
                done = step / iterations
                for group in adam.param_groups:
                    group["lr"] = learning_rate * rate(group["name"], done, frozen)
                total = finite_sum(objective(stepped(base, steps, bump), robust=done > ROBUST_FROM), step)
                adam.zero_grad()
                total.backward()
                adam.step()
                report(f"loss {float(total.detach()):.3f}")
            base = stepped(base, steps, bump).detached()
    return base


def finite_sum(losses: Mapping[str, Tensor], step: int) -> Tensor:
    """The sum of the terms.

    Raises:
        FloatingPointError: it is not finite; the message names the terms.
    """
    total = torch.stack(list(losses.values())).sum()
    if not math.isfinite(float(total.detach())):
        bad = [name for name, loss in losses.items() if not torch.isfinite(loss)]
        raise FloatingPointError(f"the fit's loss is not finite at step {step}: {', '.join(bad)}")
    return total


def _phases(iterations: int) -> list[tuple[int, int, float]]:
    """First step, last step + 1 and width of each phase that has a step."""
    starts = [round(share * iterations) for share, _ in BUMPS] + [iterations]
    phases = [(starts[k], starts[k + 1], width) for k, (_, width) in enumerate(BUMPS)]
    return [phase for phase in phases if phase[0] < phase[1]]
