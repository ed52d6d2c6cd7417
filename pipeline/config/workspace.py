"""Where things lie on disk, named once and passed down."""

from __future__ import annotations

import dataclasses
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
"""The checkout, or the folder of the installed package that is laid out like one."""

BUILT_IN = REPOSITORY / "data"
"""The definitions that come with the project."""


@dataclasses.dataclass(frozen=True)
class Workspace:
    """The folders that a run reads from and writes to.

    Attributes:
        data: what a user keeps: artifacts and assets where nothing else is said, and own definitions. Its
            folders subjects, datasets, presets and body and its assets.toml stand for those of the project.
        artifacts: the versioned store.
        assets: what third parties ship, fetched once.
        body_file: the body model; the open body unless the user supplies an SMPL-X file.
        stages: the package whose sub-packages declare the stages.
    """

    data: Path
    artifacts: Path
    assets: Path
    body_file: Path
    stages: str = "stages"

    @property
    def body(self) -> Path:
        """The folder with the open body and the landmarks of every known body."""
        return self.definitions("body")

    def definitions(self, name: str) -> Path:
        """A folder or file of definitions: the user's where it is there, else the project's."""
        return definitions(self.data, name)


def definitions(data: Path, name: str) -> Path:
    """A folder or file of definitions: that of ``data`` where it is there, else the project's."""
    own = data / name
    return own if own.exists() else BUILT_IN / name


def default_data() -> Path:
    """The folder that is meant without data=: the checkout's, or ``data`` where the user stands."""
    return BUILT_IN if (REPOSITORY / "pyproject.toml").is_file() else Path.cwd() / "data"


def open_workspace(
    data: str | Path | None = None,
    artifacts: str | Path | None = None,
    assets: str | Path | None = None,
    body: str | Path | None = None,
    stages: str = "stages",
) -> Workspace:
    """A workspace with the defaults for everything that is not given."""
    data = Path(data or default_data()).resolve()
    return Workspace(
        data=data,
        artifacts=Path(artifacts or data / "artifacts").resolve(),
        assets=Path(assets or data / "assets").resolve(),
        body_file=Path(body or definitions(data, "body") / "open_body.npz").resolve(),
        stages=stages,
    )
