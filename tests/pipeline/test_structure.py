"""The rules that keep the house in order, checked on the code itself."""

import ast
import subprocess
import sys

import pytest

from pipeline.config.request import parse_request
from pipeline.config.subjects import known_subjects
from pipeline.config.workspace import REPOSITORY
from pipeline.run.job import open_job
from pipeline.run.stage import load_stages


def imports(path):
    """Every module name that a file imports, wherever it does so."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide what belongs to whom"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def sources(folder):
    return sorted((REPOSITORY / folder).rglob("*.py"))


def test_pipeline_never_imports_stages():
    for path in sources("pipeline"):
        assert not [name for name in imports(path) if name.split(".")[0] == "stages"], path


def test_only_the_dag_imports_studies():
    for folder in ("pipeline", "stages", "benchmarks", "tools"):
        for path in sources(folder):
            others = [name for name in imports(path) if name.startswith("pipeline.studies")]
            assert not others or path.parent.name == "studies", path


def test_no_stage_imports_another():
    for path in sources("stages"):
        own = path.relative_to(REPOSITORY / "stages").parts[0]
        others = [name for name in imports(path) if name.startswith("stages.") and name.split(".")[1] != own]
        assert not others, f"{path} imports {others}"


def test_a_stage_is_declared_by_the_name_of_its_folder():
    for name, stage in load_stages().items():
        assert stage.name == name and (REPOSITORY / "stages" / name / "run.py").is_file()


def test_the_dag_loads_nothing_heavy():
    heavy = ("torch", "numpy", "cv2", "numba", "pyarrow", "scipy", "pandas", "matplotlib")
    code = f"import sys, dodo; print([name for name in {heavy} if name in sys.modules])"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("folder", ["pipeline", "stages", "benchmarks", "tools", "tests"])
def test_files_stay_short(folder):
    long = {
        str(path): lines
        for path in sources(folder)
        if (lines := path.read_text(encoding="utf-8").count("\n")) > 420
    }
    assert not long


def test_every_preset_and_subject_of_the_project_is_valid():
    for preset in sorted((REPOSITORY / "data" / "presets").glob("*.toml")):
        request = parse_request([f"preset={preset.stem}"])
        for subject in known_subjects(request.workspace):
            assert set(open_job(subject, request).settings) == set(load_stages())
