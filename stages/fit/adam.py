"""Adam on the registration objective: over the whole clip, coarse to fine.

Root, place and shape first; then pose and expression; then the offsets, which would otherwise absorb
what a wrong pose leaves.

Coarse to fine in time too: at first neighbouring frames move together, since a step is the sum of bumps
in time whose width shrinks to a single frame. Steps of single frames are as rough as Adam's signs, and
what their acceleration costs then drowns what the keypoints ask for (an elbow stayed 11 pixels off).
Steps of single frames from 30% on follow mannequins more closely (a nodding head's unseen shoulders went back
by 3 cm under this schedule), and avatars of real clips are half a decibel worse for them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from pipeline.clip.curves import Curve
from pipeline.finite import NotFiniteError, finite, rows_not_finite
from pipeline.numba_kernels import threads
from stages.fit.objective import RegistrationObjective
from stages.fit.parameters import PER_FRAME, Parameters
from stages.fit.windows import Window, bumps, windows

RATES = {
    "betas": 0.02, "global_orient": 0.02, "body_pose": 0.02, "jaw": 0.02, "eyes": 0.01, "hands": 0.03,
    "expression": 0.05, "transl": 0.01, "face_control": 5e-4, "joint_offset": 1e-3,
}  # fmt: skip
"""Adam's step for each group of parameters: radians, metres or units of the coefficients."""

ROOT_UNTIL, OFFSETS_FROM, ROBUST_FROM = 0.15, 0.4, 0.3
WARM_UP = 10  # iterations over which the steps grow to their full length
_POINTS = 16  # of the curve
REMEDY = "look at the keypoints and cameras, or try a smaller fit.learning_rate; nothing is published"
_NAMED = 5  # frames that a message names
BUMPS = ((0.0, 6.0), (0.3, 3.0), (0.6, 1.5), (0.85, 0.0))
"""From which share of the iterations on steps have which width in time: in 30ths of a second."""


StepCallback = Callable[[int, float, Callable[[], Parameters]], None]
"""Called with the number of steps done, the loss before the last, and what gives the parameters."""


def ignore(step: int, loss: float, now: Callable[[], Parameters]) -> None:
    """A ``StepCallback`` that does nothing."""


class Recorder:
    """A ``StepCallback`` that notes the loss after every step and keeps the curve of the fit.

    Attributes:
        curve: ``loss`` and ``pixels``, the mean reprojection error of all trusted points, at a few steps.
        seconds: (step, seconds since the start) of the same points, without the time they took themselves.
    """

    def __init__(self, objective: RegistrationObjective, steps: int, report: Callable[[str], None]) -> None:
        """Watch ``steps`` steps; ``report`` is called after each with a note on the loss."""
        self.curve, self.seconds = Curve(), [(0, 0.0)]
        self._objective, self._report = objective, report
        self._points = {round(steps * (k + 1) / _POINTS) for k in range(_POINTS)}
        self._idle, self._start = 0.0, time.monotonic()

    def begin(self, initial: Parameters) -> None:
        """The point before the first step."""
        self._point(0, {}, initial)
        self._idle, self._start = 0.0, time.monotonic()

    def __call__(self, step: int, loss: float, now: Callable[[], Parameters]) -> None:
        """Note a step, as a ``StepCallback`` does."""
        if step in self._points:
            self.seconds.append((step, time.monotonic() - self._start - self._idle))
            self._point(step, {"loss": loss}, now())
        self._report(f"loss {loss:.3f}")

    def _point(self, step: int, values: dict[str, float], parameters: Parameters) -> None:
        began = time.monotonic()
        error = self._objective.residuals(parameters)
        trusted = error[~torch.isnan(error)]
        pixels = {"pixels": float(trusted.mean())} if len(trusted) else {}
        self.curve.point(step, {**values, **pixels})
        self._idle += time.monotonic() - began


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


def stepped(
    base: Parameters, steps: Parameters, times: Tensor, width: float, window: Window
) -> tuple[Parameters, dict[str, Tensor]]:
    """A window's parameters after steps: ``base`` plus the steps spread in time.

    Args:
        base, steps: of the whole clip.
        times: [T], in the units of :mod:`pipeline.clip.clock`.
        width: of the bumps that spread the steps, in the same units.
        window: the frames that are posed.

    Returns:
        The parameters of the posed frames, and copies of the steps that they depend on, by name, which
        collect the gradients.
    """
    bump, first, last = bumps(times, width, window.low, window.high)
    moved, leaves = {}, {}
    for name, value in base.named().items():
        step = getattr(steps, name)
        leaf = (step[first:last] if name in PER_FRAME else step).detach().requires_grad_()
        leaves[name] = leaf
        if name in PER_FRAME:
            moved[name] = value[window.posed] + (bump @ leaf.flatten(1)).unflatten(1, leaf.shape[1:])
        else:
            moved[name] = value + leaf
    return Parameters(**moved), leaves


def gradients(
    objective: RegistrationObjective,
    base: Parameters,
    steps: Parameters,
    width: float,
    size: int,
    robust: bool,
    step: int,
) -> float:
    """Leave the gradient of the clip's loss in ``steps``, window by window; returns the loss."""
    total, times = 0.0, objective.times
    for leaf in steps.named().values():
        leaf.grad = torch.zeros_like(leaf)
    for window in windows(len(times), size):
        parameters, leaves = stepped(base, steps, times, width, window)
        loss = finite_loss(objective, parameters, robust, window, step)
        loss.backward()
        total += float(loss.detach())
        _, first, last = bumps(times, width, window.low, window.high)
        for name, leaf in leaves.items():
            if leaf.grad is not None:
                whole = getattr(steps, name).grad
                (whole[first:last] if name in PER_FRAME else whole).add_(leaf.grad)
    slopes = {name: leaf.grad for name, leaf in steps.named().items() if leaf.grad is not None}
    require_finite_gradient(objective, slopes, step)
    return total


def optimise(
    objective: RegistrationObjective,
    initial: Parameters,
    iterations: int,
    frozen: frozenset[str] = frozenset(),
    learning_rate: float = 1.0,
    minibatch: int = 256,
    on_step: StepCallback = ignore,
) -> Parameters:
    """Fit a clip.

    Args:
        frozen: names of groups of parameters that stay as they are.
        learning_rate: factor on every step.
        minibatch: frames that are posed at a time, which bounds the memory and changes nothing else.
        on_step: called after each step.

    Raises:
        NotFiniteError: the loss or its gradient is not finite.
    """
    base = initial.detached()
    # Adam keeps its memory from phase to phase: begun anew, its first steps have the full length in every
    # direction at once, and threw the body off its points by 180 pixels.
    steps = base.zeros()
    adam = torch.optim.Adam(
        [{"params": [leaf], "name": name} for name, leaf in steps.named().items()], betas=(0.9, 0.99)
    )
    with threads(1):
        for begin, end, width in _phases(iterations):
            for step in range(begin, end):
                for group in adam.param_groups:
                    share = rate(group["name"], step / iterations, frozen)
                    group["lr"] = learning_rate * share * min(1.0, (step + 1) / WARM_UP)
                robust = step / iterations > ROBUST_FROM
                now = functools.partial(_moved, base, steps, objective.times, width, minibatch)
                objective.find_outlines(step, iterations, now)
                loss = gradients(objective, base, steps, width, minibatch, robust, step)
                adam.step()
                on_step(step + 1, loss, now)
            base = _moved(base, steps, objective.times, width, minibatch)
            for leaf in steps.named().values():
                leaf.zero_()
    return base


def _moved(base: Parameters, steps: Parameters, times: Tensor, width: float, size: int) -> Parameters:
    """The whole clip's parameters after steps, window by window."""
    parts = []
    for window in windows(len(times), size):
        parameters = stepped(base, steps, times, width, window)[0].detached()
        parts.append(parameters.rows(window.own.start, window.own.stop))
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in PER_FRAME}
    return dataclasses.replace(parts[0], **joined).orthonormal()


def _phases(iterations: int) -> list[tuple[int, int, float]]:
    """First step, last step + 1 and width of each phase that has a step."""
    starts = [round(share * iterations) for share, _ in BUMPS] + [iterations]
    phases = [(starts[k], starts[k + 1], width) for k, (_, width) in enumerate(BUMPS)]
    return [phase for phase in phases if phase[0] < phase[1]]


def finite_sum(losses: Mapping[str, Tensor], step: int, frames: str = "") -> Tensor:
    """The sum of the terms.

    Args:
        losses: by name.
        step: of the optimisation, for the message.
        frames: which frames they are of.

    Raises:
        NotFiniteError: it is not finite; the message names the terms.
    """
    total = torch.stack(list(losses.values())).sum()
    if not math.isfinite(float(total.detach())):
        bad = ", ".join(name for name, loss in losses.items() if not torch.isfinite(loss)) or "their sum"
        what = f"its loss is not finite at step {step}: {bad}{frames}"
        raise NotFiniteError(f"the fit stopped: {what}; {REMEDY}")
    return total


def finite_loss(
    objective: RegistrationObjective, parameters: Parameters, robust: bool, window: Window, step: int
) -> Tensor:
    """The loss of a window, a number.

    Raises:
        NotFiniteError: it is not finite; the message names the terms and the frames.
    """
    losses = objective(parameters, robust, window)
    try:
        return finite_sum(losses, step)
    except NotFiniteError:
        finite_sum(losses, step, _named(objective, frames_at_fault(objective, parameters, window)))
        raise


def require_finite_gradient(
    objective: RegistrationObjective, gradient: Mapping[str, Tensor], step: int
) -> None:
    """Refuse a gradient that is not finite, which Adam would carry into every later step.

    Raises:
        NotFiniteError: names the parameters and the frames.
    """
    if finite(gradient.values()):
        return
    for name, value in gradient.items():
        if not bool(value.isfinite().all()):
            rows = rows_not_finite(value) if name in PER_FRAME else []
            raise NotFiniteError(
                f"the fit stopped: the gradient of {name} is not finite at step {step}"
                f"{_named(objective, rows)}; {REMEDY}"
            )


@torch.no_grad()
def frames_at_fault(objective: RegistrationObjective, parameters: Parameters, window: Window) -> list[int]:
    """The rows of the clip, of a window's posed frames, whose parameters or pixels are not finite."""
    pixels = objective.predict(parameters, window).pixels
    tensors = [getattr(parameters, name) for name in PER_FRAME] + [pixels]
    return sorted({window.low + row for tensor in tensors for row in rows_not_finite(tensor)})


def _named(objective: RegistrationObjective, rows: list[int]) -> str:
    numbers = [str(int(objective.observations.frames[row])) for row in rows]
    more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return f", in frame {', '.join(numbers[:_NAMED])}{more}" if numbers else ""
