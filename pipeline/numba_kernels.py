"""The ways to compile a numba kernel, and the number of threads that kernels and torch compute on.

Compiled kernels are kept on disk (in ``__pycache__``, or where NUMBA_CACHE_DIR says). That cache watches a
kernel's own file and nothing else, so a kernel calls only kernels of its own file, and numbers from elsewhere
reach it as arguments. Where that cannot be (the flags below, ``tiles.TILE``), delete ``__pycache__`` after a
change.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numba
import torch

_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

# Never fastmath=True: it implies "nnan" and "ninf" (no NaN, no infinity), under which the compiler deletes
# the tests for finite numbers that keep one bad Gaussian from spoiling an image.
_FLAGS = {"contract", "arcp", "nsz", "afn", "reassoc"}

# error_model="numpy": x / 0 is infinite, as in the arrays around it, and costs no branch.
kernel: _Decorator = numba.njit(cache=True, fastmath=_FLAGS, error_model="numpy")
"""Compiles a loop; sums may be added up in another order, and x / 0 is infinite."""

parallel_kernel: _Decorator = numba.njit(cache=True, fastmath=_FLAGS, error_model="numpy", parallel=True)
"""As ``kernel``, with ``numba.prange`` on several threads."""

checked_kernel: _Decorator = numba.njit(cache=True, fastmath=_FLAGS)
"""As ``kernel``, but x / 0 raises. The branch for it decides which loops become vectors, and
with that the last digits of sums, such as those of the structural similarity."""

checked_parallel_kernel: _Decorator = numba.njit(cache=True, fastmath=_FLAGS, parallel=True)
"""As ``checked_kernel``, with ``numba.prange`` on several threads."""

inline_kernel: _Decorator = numba.njit(fastmath=_FLAGS, inline="always")
"""A part of a kernel, compiled with it."""

exact_kernel: _Decorator = numba.njit(cache=True)
"""Compiles a loop that rounds as it is written."""


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Within this, torch and the kernels compute on ``count`` threads; 0 leaves them as they are.

    With one thread equal input gives equal bytes on any number of cores, gradients of indexing included. At
    the sizes of a quick run two are 1.5 times as fast on two cores (docs/log/2026-11.md).
    """
    # numba's pool sets OpenMP's number of threads, which is torch's too, when it starts: so start it first.
    numba.get_num_threads()
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def use_torch_threads() -> None:
    """Give numba as many threads as torch has: two pools of different sizes wait for each other."""
    numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
