"""What the tests share: where third-party assets and the shared clips lie, if they are there."""

import os
from pathlib import Path

import pytest

from pipeline.workspace import REPOSITORY


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
