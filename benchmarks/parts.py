"""A clock that tells the parts of a training step apart, in the backward pass too.

The forward pass of a part is what runs between entering and leaving it. Autograd runs the backward pass in
the reverse order, so marks that change nothing are put on a part's inputs and outputs: when the gradient
passes the outputs' mark the part's backward begins, and when it passes the inputs' mark it ends.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn


class PartClock:
    """Seconds of each part.

    Attributes:
        spent: part -> seconds.
    """

    def __init__(self, rest: str, now: Callable[[], float] = time.perf_counter):
        """Stands still until ``start``.

        Args:
            rest: the part that time outside of every other part counts as.
            now: seconds, of ``frame.CLOCKS``.
        """
        self.rest, self.spent, self._now = rest, dict[str, float](), now
        self._part: str | None = None
        self._since = 0.0

    def start(self) -> None:
        """Forgets everything and starts."""
        self.spent.clear()
        self._part, self._since = self.rest, self._now()

    def stop(self) -> None:
        """Counts what has passed."""
        self.enter(None)

    def enter(self, part: str | None) -> None:
        """From now on time counts as this part's."""
        now = self._now()
        if self._part is not None:
            self.spent[self._part] = self.spent.get(self._part, 0.0) + now - self._since
        self._part, self._since = part, now

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its forward and backward time counted as this part's."""

        def run(*arguments: Any) -> Any:
            marked = self._mark(self.rest, arguments)
            self.enter(part)
            result = self._mark(part, function(*marked))
            self.enter(self.rest)
            return result

        return run

    def watch(self, part: str, *modules: nn.Module) -> None:
        """Counts the modules' time as this part's, from now on and for good."""
        for module in modules:
            module.forward = self.timed(part, module.forward)  # type: ignore[method-assign]

    def _mark(self, part: str, value: Any) -> Any:
        """The value, with marks on its tensors that enter ``part`` when gradients pass them."""
        if isinstance(value, Tensor):
            return _Mark.apply(value, self, part) if value.requires_grad else value
        if isinstance(value, tuple):
            return tuple(self._mark(part, one) for one in value)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
            return dataclasses.replace(value, **{n: self._mark(part, v) for n, v in fields.items()})
        return value


class _Mark(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, clock: PartClock, part: str) -> Tensor:
        ctx.clock, ctx.part = clock, part
        ctx.set_materialize_grads(False)
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        ctx.clock.enter(ctx.part)
        return gradient, None, None
