"""How long kernels are compiled: the first run after an installation pays for that, and no other.

numba keeps what it compiles on disk. A study that compares runs by their seconds would charge the first of
them for all, so training tells these seconds apart.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from numba.core import event


class CompileTimer(event.Listener):
    """Adds up what is compiled while it listens; what is read from numba's cache does not count.

    Args:
        say: told once that numba compiles, when it begins to; nobody if None.

    Attributes:
        seconds: of wall-clock time.
        cpu_seconds: of the process's time.
    """

    def __init__(self, say: Callable[[str], None] | None = None) -> None:
        self._say = say
        self.seconds = self.cpu_seconds = 0.0
        self._depth = 0  # a kernel's callees are compiled within it

    def on_start(self, event: event.Event) -> None:
        """A kernel's compilation begins."""
        if self._depth == 0:
            if self._say is not None:
                self._say("numba compiles kernels, as after every installation or change of them")
                self._say = None
            self._wall, self._cpu = time.monotonic(), time.process_time()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """It is over."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.monotonic() - self._wall
            self.cpu_seconds += time.process_time() - self._cpu


@contextlib.contextmanager
def compile_timer(say: Callable[[str], None] | None = None) -> Iterator[CompileTimer]:
    """Listens within this; ``say`` is told when something is compiled."""
    timer = CompileTimer(say)
    with event.install_listener("numba:compile", timer):
        yield timer
