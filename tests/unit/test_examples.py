"""The examples of the library's docstrings and of the README run as they stand."""

import doctest
import importlib
import shutil

import pytest
import torch

from pipeline.avatar import Architecture, Avatar, save_avatar
from pipeline.body import Poses, load_body, mean_identity, write_poses
from pipeline.config.workspace import REPOSITORY

BODY_FILE = "data/body/open_body.npz"
MODULES = sorted(
    ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
    for path in (REPOSITORY / "pipeline").rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A folder with the body and, where the README's example looks for it, a small avatar in grey."""
    folder = tmp_path_factory.mktemp("project")
    (folder / BODY_FILE).parent.mkdir(parents=True)
    shutil.copy(REPOSITORY / BODY_FILE, folder / BODY_FILE)
    body = load_body(folder / BODY_FILE)
    sizes = Architecture(plane_resolution=8, plane_channels=4, width=16, groups=4, subdivisions=0)
    train = folder / "data" / "artifacts" / "smile" / "train" / "latest"
    train.mkdir(parents=True)
    avatar = Avatar(body, mean_identity(body), torch.arange(0, len(body.v_template), 50), sizes)
    save_avatar(train / "avatar.safetensors", avatar)
    still = Poses((0,), torch.zeros(1, 55, 3), torch.zeros(1, 10), torch.zeros(1, 3))
    write_poses(train / "poses.parquet", still)
    return folder


def run(tests, capsys):
    """The number of examples that ran; what failed is the message."""
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for test in tests:
        runner.run(test)
    assert not runner.failures, capsys.readouterr().out
    return runner.tries


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_run(name, project, monkeypatch, capsys):
    monkeypatch.chdir(project)
    avatar_file = project / "data" / "artifacts" / "smile" / "train" / "latest" / "avatar.safetensors"
    found = doctest.DocTestFinder().find(
        importlib.import_module(name), extraglobs={"avatar_file": avatar_file}
    )
    assert run(found, capsys) > 0


def test_the_example_of_the_readme_runs(project, monkeypatch, capsys):
    monkeypatch.chdir(project)
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8").replace("```", "\n")
    assert run([doctest.DocTestParser().get_doctest(text, {}, "README.md", "README.md", 0)], capsys) > 0
