"""docs/stability.md names only tests that exist, and every file of this folder that has tests."""

import ast
import re
from pathlib import Path

from pipeline.config.workspace import REPOSITORY
from tests.stability.properties import PROPERTIES

TABLE = REPOSITORY / "docs" / "stability.md"
TESTS = REPOSITORY / "tests"
NAME = re.compile(r"`((?:\w+/)*test_\w+\.py)(?:::(\w+)(?:\[([^\]`]+)\])?)?`")


def rows() -> list[list[str]]:
    """The cells of every row of every table, headings and rules left out."""
    lines = [line for line in TABLE.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    return [row for row in cells if not set("".join(row)) <= set("-: ")]


def named() -> list[tuple[str, str, str]]:
    """(file, test, case) of every test that the document names."""
    return NAME.findall(TABLE.read_text(encoding="utf-8"))


def functions_in(path: Path) -> set[str]:
    """The names of a file's test functions, without importing it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_the_table_names_tests_that_exist():
    found = named()
    assert len(found) > 80
    for file, test, case in found:
        path = TESTS / file if "/" in file else TESTS / "stability" / file
        assert path.is_file(), file
        if test:
            assert test.startswith("test_") and test in functions_in(path), f"{file}::{test}"
        if test == "test_property":
            assert case in PROPERTIES, case


def test_every_row_names_a_test():
    for row in rows():
        if len(row) == 4 and row[3] != "test":
            assert NAME.search(row[3]), row


def test_every_file_with_tests_is_in_the_table():
    files = {file for file, _, _ in named()}
    for path in sorted((TESTS / "stability").glob("test_*.py")):
        assert path.name in files, path.name


def test_every_property_is_in_the_table():
    assert {case for _, test, case in named() if test == "test_property"} == set(PROPERTIES)
