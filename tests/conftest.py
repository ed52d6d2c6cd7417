"""What the tests share: the open body, a small subject, where assets and shared clips lie, if anywhere."""

import os
from pathlib import Path

import pytest

from pipeline.config.workspace import REPOSITORY

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # a worker a core is crowded; read when torch is loaded
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # hundreds of processes are started that import the same
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


@pytest.fixture(scope="session", autouse=True)
def body_read_once():
    """Stages that read a fitted clip get the open body that was read before: reading takes half a second."""
    from pipeline.clip import fitted_clip  # here, as the lines above come before torch's threads
    from tests.made.body import BODY_FILE, open_body

    read = fitted_clip.load_body
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitted_clip, "load_body", lambda path: open_body() if path == BODY_FILE else read(path))
        yield


@pytest.fixture(scope="session")
def body():
    """The open body."""
    from tests.made.body import open_body

    return open_body()


@pytest.fixture(scope="session")
def landmarks():
    """Where keypoints lie on the open body."""
    from tests.made.body import open_landmarks

    return open_landmarks()


@pytest.fixture(scope="session")
def model(body, landmarks):
    """The open body and its landmarks, as registration takes them."""
    return body, landmarks


@pytest.fixture(scope="session")
def subject(tmp_path_factory) -> Path:
    """The painted subject in the folders of ingest, fit and plan. Read only: all tests look at this one."""
    from tests.made.portrait import write_subject

    folder = tmp_path_factory.mktemp("subject")
    write_subject(folder)
    return folder
