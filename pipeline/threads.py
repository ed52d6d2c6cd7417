"""How many threads a stage's arithmetic takes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numba
import torch


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Within this, torch and the rasterizer compute on ``count`` threads; 0 leaves them as they are.

    At the sizes of a quick run one thread was faster than two on two cores (docs/results.md). With one
    thread equal input also gives equal bytes on any number of cores, gradients of indexing included.
    """
    # numba's pool sets OpenMP's number of threads, which is torch's too, when it starts: so start it first.
    numba.get_num_threads()
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
