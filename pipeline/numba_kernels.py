"""The ways to compile a numba kernel, and the number of threads that kernels and torch compute on.

Compiled kernels are kept on disk: in ``__pycache__``, or where NUMBA_CACHE_DIR says, or where neither that
nor the user's own cache folder can be written, in a folder of the user's among temporary files. That cache
watches a kernel's own file and nothing else, so a kernel calls only kernels of its own file, and numbers from
elsewhere reach it as arguments. Where that cannot be (the flags below, ``tiles.TILE``), delete
``__pycache__`` after a change.
"""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import torch

_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def _cache_is_usable() -> bool:
    """True where numba can keep what it compiles; points it to the temporary files where it could not."""

    def probe() -> None:
        """Compiled never."""

    if _accepts(probe):
        return True
    folder = Path(tempfile.gettempdir()) / f"flexiavatar-numba-{os.getuid() if hasattr(os, 'getuid') else ''}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.lstat()
        # Compiled code of others would be run.
        if stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o022:
            numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
            return _accepts(probe)
    return False


def _accepts(probe: Callable[[], None]) -> bool:
    """Whether numba finds a folder to keep a function of this file in."""
    try:
        numba.njit(cache=True)(probe)
    except RuntimeError:
        return False
    return True


# Never fastmath=True: it implies "nnan" and "ninf" (no NaN, no infinity), under which the compiler deletes
# the tests for finite numbers that keep one bad Gaussian from spoiling an image.
_FLAGS = {"contract", "arcp", "nsz", "afn", "reassoc"}

_KEPT = _cache_is_usable()

# error_model="numpy": x / 0 is infinite, as in the arrays around it, and costs no branch.
kernel: _Decorator = numba.njit(cache=_KEPT, fastmath=_FLAGS, error_model="numpy")
"""Compiles a loop; sums may be added up in another order, and x / 0 is infinite."""

parallel_kernel: _Decorator = numba.njit(cache=_KEPT, fastmath=_FLAGS, error_model="numpy", parallel=True)
"""As ``kernel``, with ``numba.prange`` on several threads."""

checked_kernel: _Decorator = numba.njit(cache=_KEPT, fastmath=_FLAGS)
"""As ``kernel``, but x / 0 raises. The branch for it decides which loops become vectors, and
with that the last digits of sums, such as those of the structural similarity."""

checked_parallel_kernel: _Decorator = numba.njit(cache=_KEPT, fastmath=_FLAGS, parallel=True)
"""As ``checked_kernel``, with ``numba.prange`` on several threads."""

inline_kernel: _Decorator = numba.njit(fastmath=_FLAGS, inline="always")
"""A part of a kernel, compiled with it."""

exact_kernel: _Decorator = numba.njit(cache=_KEPT)
"""Compiles a loop that rounds as it is written."""


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Within this, torch and the kernels compute on ``count`` threads; 0 leaves them as they are.

    With one thread equal input gives equal bytes on any number of cores of one kind, gradients too. At
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
