"""What the tests share: where third-party assets and the shared clips lie, if they are there."""

import os
from pathlib import Path

import pytest

from pipeline.config.workspace import REPOSITORY

if "PYTEST_XDIST_WORKER" in os.environ:  # a worker a core; tests that are about threads ask for two
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # for the processes that tests start
    import numba
    import torch

    numba.get_num_threads()  # its pool sets torch's number of threads when it starts (pipeline.numba_kernels)
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def assets_folder() -> Path:
    """Where assets lie; FLEXIAVATAR_TEST_ASSETS names another folder than data/assets."""
    return Path(os.environ.get("FLEXIAVATAR_TEST_ASSETS", REPOSITORY / "data" / "assets"))


@pytest.fixture(scope="session")
def shared_folder() -> Path:
    """The developers' shared folder beside the checkout; the test is skipped where there is none."""
    folder = REPOSITORY.parent / "shared"
    if not folder.is_dir():
        pytest.skip("there is no ../shared here")
    return folder
