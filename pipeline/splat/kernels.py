"""How the numba kernels of this package are compiled.

They are kept on disk once compiled (in ``__pycache__``, or where NUMBA_CACHE_DIR says). That cache watches a
kernel's own file and nothing else, so a kernel calls only kernels of its own file, and numbers from elsewhere
reach it as arguments. Where that cannot be (the flags below, ``tiles.TILE``), delete ``__pycache__`` after a
change.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

# Never fastmath=True: it implies "nnan" and "ninf" (no NaN, no infinity), under which the compiler deletes
# the tests for finite numbers that keep one bad Gaussian from spoiling an image.
_FASTMATH = {"contract", "arcp", "nsz", "afn", "reassoc"}

# error_model="numpy": x / 0 is infinite, as in the arrays around it, and costs no branch.
kernel: _Decorator = njit(cache=True, fastmath=_FASTMATH, error_model="numpy")
parallel_kernel: _Decorator = njit(cache=True, fastmath=_FASTMATH, error_model="numpy", parallel=True)
