"""Prints the lowest versions of what this project depends on, as pip's constraints, for ``.ci/lowest``.

    python tools/lowest_versions.py > lowest.txt

Only what runs with the project is pinned, not what it is tested with.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def lowest_versions(requirements: list[str]) -> list[str]:
    """A constraint ``name==version`` for each requirement with a lower bound, in order.

    >>> lowest_versions(["numpy>=2.0", "torch>=2.13,<2.14", "some"])
    ['numpy==2.0.*', 'torch==2.13.*']
    """
    found = []
    for text in requirements:
        requirement = Requirement(text)
        bounds = [one.version for one in requirement.specifier if one.operator in (">=", "==")]
        found += [f"{requirement.name}=={bound}.*" for bound in bounds]
    return found


if __name__ == "__main__":
    print(
        "\n".join(
            lowest_versions(tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["dependencies"])
        )
    )
