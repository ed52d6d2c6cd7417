import os
import shutil
import subprocess
import sys

import pytest

from pipeline.config.request import parse_request
from pipeline.config.workspace import REPOSITORY


class ToyProject:
    """A data folder with two subjects and the toy stages, driven through doit as a user does."""

    def __init__(self, root):
        self.root = root
        self.data = root / "data"
        self.store = self.data / "artifacts"

    def write(self):
        """Write the data folder."""
        for folder in ("subjects", "presets", "datasets", "body", "sources"):
            (self.data / folder).mkdir(parents=True)
        (self.data / "assets.toml").write_text("")
        (self.data / "presets" / "quick.toml").write_text('title = "quick"\n')
        (self.data / "presets" / "balanced.toml").write_text("[paint]\niterations = 7\n")
        (self.data / "datasets" / "pair.toml").write_text("[bend]\nangle = 5.0\n")
        for name in ("ann", "bob"):
            self.subject(name, f'title = "{name}"\n[source]\npath = "sources/{name}.txt"\n')
            (self.data / "sources" / f"{name}.txt").write_text(f"{name} ")
        return self

    def subject(self, name, text):
        (self.data / "subjects" / f"{name}.toml").write_text(text)

    def words(self):
        return [f"data={self.data}", "stages=tests.pipeline.toy_stages"]

    def request(self, *words):
        return parse_request([*self.words(), *words])

    def doit(self, *words, command="run", options=()):
        line = [sys.executable, "-m", "doit", command, *options, *self.words(), *words]
        return subprocess.run(
            line, cwd=REPOSITORY, capture_output=True, text=True, env=self.environment(), check=False
        )

    def stage(self, name, subject, *words):
        line = [sys.executable, "-m", "pipeline", name, "--subject", subject, *self.words(), *words]
        return subprocess.Popen(
            line,
            cwd=REPOSITORY,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.environment(),
        )

    def environment(self):
        return {**os.environ, "PYTHONPATH": str(REPOSITORY)}

    def ran(self):
        """The stages that ran since the last call."""
        log = self.data / "ran.log"
        lines = log.read_text().split() if log.exists() else []
        log.unlink(missing_ok=True)
        return lines

    def published(self, stage, subject):
        folder = self.store / subject / stage
        return sorted(
            path.name for path in folder.iterdir() if path.name != "latest" and not path.name.startswith(".")
        )


@pytest.fixture
def toy(tmp_path):
    return ToyProject(tmp_path).write()


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A project in which ann was made; read only."""
    toy = ToyProject(tmp_path_factory.mktemp("finished")).write()
    assert toy.doit("subject=ann").returncode == 0
    toy.ran()
    return toy


@pytest.fixture
def made(finished, tmp_path):
    """The same elsewhere, for a test to go on from: nothing in a store depends on where it lies."""
    shutil.copytree(finished.root, tmp_path / "project", symlinks=True)
    return ToyProject(tmp_path / "project")
