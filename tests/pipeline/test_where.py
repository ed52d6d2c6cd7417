"""Where it is run: from other folders, with odd names and files, on stored subjects that nobody describes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from pipeline.config.subjects import require_footage
from pipeline.config.workspace import REPOSITORY, open_workspace
from pipeline.errors import UserError
from pipeline.run.job import open_job


def one_line(done):
    """The single line that a refused command ends with."""
    assert done.returncode != 0
    said = (done.stdout + done.stderr).strip()
    assert "Traceback" not in said
    return said.splitlines()[-1]


def test_relative_paths_are_meant_from_where_the_user_stands(toy, tmp_path):
    (tmp_path / "away").mkdir()
    (tmp_path / "away" / "clip.txt").write_text("carl ")
    words = [f"data={os.path.relpath(toy.data, tmp_path / 'away')}", "stages=tests.pipeline.toy_stages"]
    line = [sys.executable, "-m", "doit", "run", "-f", str(REPOSITORY / "dodo.py"), *words]
    line += ["subject=carl", "source=clip.txt"]
    done = subprocess.run(line, cwd=tmp_path / "away", env=toy.environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert toy.published("paint", "carl")


def test_a_stage_runs_from_a_folder_that_has_a_package_of_the_same_name(toy, tmp_path):
    (tmp_path / "pipeline").mkdir()
    (tmp_path / "pipeline" / "__init__.py").write_text("raise SystemExit('not this one')\n")
    line = [
        sys.executable,
        "-m",
        "doit",
        "run",
        "-f",
        str(REPOSITORY / "dodo.py"),
        *toy.words(),
        "subject=ann",
    ]
    done = subprocess.run(
        line, cwd=tmp_path, env={**toy.environment(), "PYTHONSAFEPATH": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("task", ["paint:nobody", "verify:nobody", "prune:nobody"])
def test_a_task_of_someone_unknown_says_what_is_missing(toy, task):
    said = one_line(toy.doit(task))
    assert "subject=nobody" in said and "source=CLIP.mp4" in said


@pytest.mark.slow
def test_stored_subjects_are_checked_and_deleted_though_nothing_describes_them(toy):
    assert toy.doit("subject=ann").returncode == 0
    (toy.data / "subjects" / "ann.toml").unlink()
    (toy.data / "subjects" / "bob.toml").unlink()
    for task in ("verify:ann", "prune:ann", "verify", "prune"):
        done = toy.doit(task)
        assert done.returncode == 0, done.stdout + done.stderr
    assert "ann" in toy.doit("verify").stdout
    assert toy.doit("subject=ann", command="clean").returncode == 0
    assert not any((toy.store / "ann").rglob("manifest.json"))


@pytest.mark.parametrize(
    ("subject", "source", "expected"),
    [("x" * 300, "README.md", "at most 100 letters"), ("me", "/dev/null", "neither a file nor a folder"),
     ("me", "{}/fifo", "neither a file nor a folder"), ("me", "{}/link", "neither a file nor a folder")],
)  # fmt: skip
def test_odd_subjects_and_sources_are_refused_in_one_line(toy, tmp_path, subject, source, expected):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    done = toy.doit(f"subject={subject}", f"source={source.format(tmp_path)}")
    assert done.returncode != 0 and "Traceback" not in done.stdout + done.stderr
    assert expected in done.stdout + done.stderr


def test_an_empty_data_folder_has_the_projects_own_definitions(tmp_path):
    workspace = open_workspace(data=tmp_path)
    assert workspace.artifacts == tmp_path / "artifacts" and workspace.assets == tmp_path / "assets"
    assert workspace.body_file.is_file() and workspace.body.is_dir()
    assert workspace.definitions("presets") == REPOSITORY / "data" / "presets"
    (tmp_path / "presets").mkdir()
    assert workspace.definitions("presets") == tmp_path / "presets"


def test_data_that_is_no_folder_is_refused_in_one_line(toy, tmp_path):
    line = [sys.executable, "-m", "doit", "run", f"data={tmp_path / 'nowhere'}"]
    done = subprocess.run(line, cwd=REPOSITORY, env=toy.environment(), capture_output=True, text=True)
    assert "is no folder" in one_line(done)


def test_the_footage_of_a_subject_must_be_a_file_or_a_folder(toy, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    job = open_job("me", toy.request("subject=me", f"source={tmp_path / 'pipe'}"))
    with pytest.raises(UserError, match="neither a file nor a folder"):
        require_footage(job.workspace, job.subject)


KERNEL = """
import numba
from pipeline.numba_kernels import exact_kernel
from pipeline.metrics import ssim_kernel
print(numba.config.CACHE_DIR or "its own")
"""


def test_kernels_compile_where_neither_checkout_nor_home_can_be_written(tmp_path):
    """The packages lie in a folder whose __pycache__ are files, and HOME is no folder."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(REPOSITORY / "pipeline", tmp_path / "pipeline", ignore=ignored)
    for folder in [path for path in tmp_path.rglob("*") if path.is_dir()]:
        (folder / "__pycache__").write_text("")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    places = {"HOME": "/dev/null/no", "XDG_CACHE_HOME": "/dev/null/no", "TMPDIR": str(temporary)}
    environment = {**os.environ, **places, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    line = [sys.executable, "-P", "-c", KERNEL]
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().startswith(str(temporary))
