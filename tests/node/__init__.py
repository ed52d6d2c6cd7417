"""npm's packages in tests: scripts beside this run in node; without node or a package their tests skip.

``npm install gltf-validator three`` in the checkout's folder is all it takes; git does not see it.
"""

import functools
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from pipeline.config.workspace import REPOSITORY

_PLACES = (
    REPOSITORY,
    *(Path(place).parent for place in os.environ.get("NODE_PATH", "").split(os.pathsep) if place),
)


@functools.cache
def folder_with(package: str) -> Path | None:
    """The folder whose node_modules has a package; None where none has, or there is no node."""
    if shutil.which("node") is None:
        return None
    return next((place for place in _PLACES if (place / "node_modules" / package).is_dir()), None)


def run_script(script: str, package: str, *arguments: str) -> dict:
    """What a script prints, read as JSON; skips the test where its package is not there."""
    folder = folder_with(package)
    if folder is None:
        pytest.skip(f"needs node and the package {package}: npm install {package}")
    command = ["node", str(Path(__file__).parent / script), str(folder), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)
