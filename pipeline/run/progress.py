"""A progress display whose time left knows that later steps may cost more than those behind."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence

QUIET_SECONDS = 10.0  # between two lines where there is no terminal


class TimeLeft:
    """The seconds that the steps ahead will take, from the seconds that those behind took.

    Steps of equal cost are one phase. A phase that has been measured is expected to go on at its own speed;
    one that lies ahead, at its cost times the speed of all that was measured.
    """

    def __init__(self, costs: Sequence[float]):
        """Starts with nothing done.

        Args:
            costs: relative cost of each step, positive; only their ratios count.
        """
        self._costs = tuple(costs)
        self._done = 0
        self._ahead = Counter(self._costs)
        self._seconds: dict[float, float] = {}
        self._steps: dict[float, int] = {}

    def skip(self, count: int) -> None:
        """Counts steps as done without a word of their time."""
        self._ahead.subtract(self._costs[self._done : self._done + count])
        self._done += count

    def measured(self, count: int, seconds: float) -> None:
        """Counts the time of the next ``count`` steps.

        The first of a phase only opens it: kernels are compiled then, which happens once.
        """
        if self._done < len(self._costs):
            cost = self._costs[self._done]
            opened = cost in self._steps
            self._steps[cost] = self._steps[cost] + count if opened else 0
            self._seconds[cost] = self._seconds[cost] + seconds if opened else 0.0
        self.skip(count)

    def seconds(self) -> float | None:
        """Seconds that the steps ahead will take; None while nothing was measured."""
        spent = sum(self._seconds.values())
        work = sum(cost * count for cost, count in self._steps.items())
        if not work:
            return None

        def of_a_step(cost: float) -> float:
            count = self._steps.get(cost, 0)
            return self._seconds[cost] / count if count else cost * spent / work

        return sum(count * of_a_step(cost) for cost, count in self._ahead.items())


class Progress:
    """A bar on a terminal; elsewhere a line at most every ten seconds. Both tell the time left."""

    def __init__(
        self,
        total: int,
        label: str,
        costs: Sequence[float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Shows nothing yet.

        Args:
            total: steps.
            label: stands before the count.
            costs: relative cost of each step; equal where not given.
            clock: seconds.
        """
        from tqdm import tqdm

        self.total, self.label, self.done = total, label, 0
        self._left = TimeLeft((1.0,) * total if costs is None else costs)
        self._clock = clock
        self._shown = self._last = clock()
        self.bar = None
        if sys.stderr.isatty():
            layout = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
            self.bar = tqdm(total=total, desc=label, dynamic_ncols=True, bar_format=layout)

    def skip(self, steps: int) -> None:
        """Counts steps as done that an earlier process did; they say nothing of this one's speed."""
        self.done += steps
        self._left.skip(steps)
        self._last = self._clock()
        if self.bar is not None:
            self.bar.update(steps)

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Counts ``steps`` more as done; ``note`` is shown beside the time left."""
        now = self._clock()
        self._left.measured(steps, now - self._last)
        self.done, self._last = self.done + steps, now
        words = ", ".join(word for word in (self._time_left(), note) if word)
        if self.bar is not None:
            self.bar.set_postfix_str(words, refresh=False)
            self.bar.update(steps)
        elif now - self._shown >= QUIET_SECONDS:
            self._shown = now
            print(f"{self.label}: {self.done}/{self.total}, {words}".rstrip(", "), flush=True)

    def _time_left(self) -> str:
        seconds = self._left.seconds()
        return "" if seconds is None else f"{seconds:.0f} s left"

    def close(self) -> None:
        """Takes the bar away."""
        if self.bar is not None:
            self.bar.close()
