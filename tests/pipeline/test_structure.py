"""The rules that keep the house in order, checked on the code itself."""

import ast
import collections
import graphlib
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


def modules():
    """Name -> path of every module of pipeline and stages; a package is its ``__init__``."""
    found = {}
    for path in [*sources("pipeline"), *sources("stages")]:
        parts = path.relative_to(REPOSITORY).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def runtime_imports(node):
    """Modules and names that run-time code imports, inside functions too; not what types alone ask for."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            yield from (f"{child.module}.{alias.name}" for alias in child.names)
        yield from runtime_imports(child)


def import_graph(found):
    """Module -> the modules that it imports, and the packages of these that it is not itself within."""
    graph = {}
    for name, path in found.items():
        graph[name] = set()
        for imported in runtime_imports(ast.parse(path.read_text(encoding="utf-8"))):
            target = imported if imported in found else imported.rpartition(".")[0]
            ancestors = {target.rsplit(".", up)[0] for up in range(1, target.count(".") + 1)}
            outside = {one for one in ancestors if not f"{name}.".startswith(f"{one}.")}
            graph[name] |= ({target} | outside) & set(found) - {name}
    return graph


def test_no_circles():
    graph = import_graph(modules())
    assert sum(map(len, graph.values())) > 500
    graphlib.TopologicalSorter(graph).prepare()  # CycleError names the circle


def test_a_circle_is_found(tmp_path):
    found = {name: tmp_path / name for name in ("one", "two")}
    found["one"].write_text("def late():\n    import two\n")
    found["two"].write_text("from one import late\n")
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter(import_graph(found)).prepare()


def test_class_names_are_unique():
    homes = collections.defaultdict(list)
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(name)
    assert len(homes) > 100
    assert not {name: places for name, places in homes.items() if len(places) > 1}


def test_the_root_of_pipeline_stays_small():
    assert len(list((REPOSITORY / "pipeline").glob("*.py"))) <= 10


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
