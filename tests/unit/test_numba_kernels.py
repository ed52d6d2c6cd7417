"""The number of threads is what was asked for, whatever library starts its pool when."""

import subprocess
import sys

import pytest

from pipeline.config.workspace import REPOSITORY

PROGRAM = """
import torch
from pipeline.numba_kernels import threads
from pipeline.avatar.head import Head
with threads(1):
    Head(4, 2, width=8, groups=2)(torch.ones(4, 4))  # numba's first parallel kernel
    print(torch.get_num_threads())
"""


@pytest.mark.slow
def test_numbas_pool_does_not_set_torchs_threads_when_it_starts():
    words = [sys.executable, "-c", PROGRAM]
    run = subprocess.run(words, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["1"]
