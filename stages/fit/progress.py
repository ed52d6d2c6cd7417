"""How the registration goes: a note after every step, and its curve."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from pipeline.curves import Curve
from stages.fit.objective import Objective
from stages.fit.parameters import Parameters

_POINTS = 16  # of the curve


class Recorder:
    """Watches an optimisation.

    Attributes:
        curve: ``loss`` and ``pixels``, the mean reprojection error of all trusted points, at a few steps.
        seconds: (step, seconds since the start) of the same points, without the time they took themselves.
    """

    def __init__(self, objective: Objective, steps: int, report: Callable[[str], None]) -> None:
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
        """As ``optimise.Watch``."""
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
