"""The command ``flexiavatar``, and what a wheel holds of the checkout."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from pipeline.config.workspace import REPOSITORY


def test_the_command_runs_a_stage_from_any_folder(toy, tmp_path):
    line = [sys.executable, "-m", "flexiavatar", "run", *toy.words(), "bend:ann"]
    done = subprocess.run(line, cwd=tmp_path, env=toy.environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert toy.published("bend", "ann")


def test_the_command_refuses_in_one_line(toy, tmp_path):
    line = [sys.executable, "-m", "flexiavatar", "run", "preset=nope"]
    done = subprocess.run(line, cwd=tmp_path, env=toy.environment(), capture_output=True, text=True)
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert "quick" in done.stdout + done.stderr, "it names the presets that there are"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """What a wheel of this checkout holds."""
    folder = tmp_path_factory.mktemp("wheel")
    line = [
        sys.executable,
        "setup.py",
        "-q",
        "egg_info",
        "-e",
        str(folder),
        "build_py",
        "-d",
        str(folder / "lib"),
    ]
    done = subprocess.run(line, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "lib"


def test_a_wheel_puts_one_package_into_an_environment(built):
    assert [path.name for path in built.iterdir()] == ["flexiavatar"]


def test_a_wheel_holds_all_that_the_checkout_runs_with(built):
    inner = built / "flexiavatar" / "checkout"
    kinds = (".py", ".toml", ".jinja", ".js", ".npz", ".md")
    for folder in ("pipeline", "stages", "data/presets", "data/subjects", "data/datasets", "data/body"):
        for path in (REPOSITORY / folder).rglob("*"):
            if path.suffix in kinds and "__pycache__" not in path.parts:
                name = path.relative_to(REPOSITORY)
                assert (inner / name).read_bytes() == path.read_bytes(), name
    assert (inner / "dodo.py").is_file() and (inner / "data" / "assets.toml").is_file()
    assert not (inner / "pyproject.toml").exists(), (
        "what has it is taken for a checkout, whose data is its own"
    )


def test_an_installed_command_keeps_its_data_where_the_user_stands(built, tmp_path):
    code = "from pipeline.config.workspace import open_workspace as w; print(w().artifacts, w().body_file)"
    environment = {**os.environ, "PYTHONPATH": str(built / "flexiavatar" / "checkout")}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    artifacts, body = done.stdout.split()
    assert artifacts == str(tmp_path / "data" / "artifacts")
    assert body.startswith(str(built))
