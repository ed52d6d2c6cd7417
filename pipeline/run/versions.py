"""What made a result: the versions of this project and of the packages that its numbers come from."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
import tomllib

from pipeline.config.workspace import REPOSITORY

PACKAGES = (
    "torch",
    "numpy",
    "numba",
    "opencv-contrib-python-headless",
    "av",
    "roma",
    "gsplat",
)
"""Those whose version can change a number; what is not installed is left out."""

NAME = "flexiavatar"


def versions() -> dict[str, str]:
    """Name -> version: this project, its commit if it is a checkout, Python, and ``PACKAGES``."""
    found = {NAME: own_version(), "commit": commit(), "python": platform.python_version()}
    found |= {package: package_version(package) for package in PACKAGES}
    return {name: version for name, version in found.items() if version}


def package_version(package: str) -> str:
    """An installed package's version; empty where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def own_version() -> str:
    """This project's version: of the checkout that runs, else of the installed package."""
    try:
        return tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"][
            "version"
        ]
    except (OSError, KeyError, tomllib.TOMLDecodeError):
        return package_version(NAME)


def commit() -> str:
    """The checkout's commit, with ``+`` where files were changed since; empty where there is none."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(REPOSITORY), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""
