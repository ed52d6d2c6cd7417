"""Checks of a fit's numbers: what is not finite is named by term or parameter, step and frames."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from pipeline.finite import NotFiniteError, finite, rows_not_finite
from stages.fit.objective import Objective
from stages.fit.parameters import PER_FRAME, Parameters
from stages.fit.windows import Window

REMEDY = "look at the keypoints and cameras, or try a smaller fit.learning_rate; nothing is published"
_NAMED = 5  # frames that a message names


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
    objective: Objective, parameters: Parameters, robust: bool, window: Window, step: int
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


def require_finite_gradient(objective: Objective, gradient: Mapping[str, Tensor], step: int) -> None:
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
def frames_at_fault(objective: Objective, parameters: Parameters, window: Window) -> list[int]:
    """The rows of the clip, of a window's posed frames, whose parameters or pixels are not finite."""
    pixels = objective.predict(parameters, window).pixels
    tensors = [getattr(parameters, name) for name in PER_FRAME] + [pixels]
    return sorted({window.low + row for tensor in tensors for row in rows_not_finite(tensor)})


def _named(objective: Objective, rows: list[int]) -> str:
    numbers = [str(int(objective.observations.frames[row])) for row in rows]
    more = f" and {len(numbers) - _NAMED} more" if len(numbers) > _NAMED else ""
    return f", in frame {', '.join(numbers[:_NAMED])}{more}" if numbers else ""
