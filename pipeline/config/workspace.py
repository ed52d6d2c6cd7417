"""Where things lie on disk, named once and passed down."""

from __future__ import annotations

import dataclasses
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]


@dataclasses.dataclass(frozen=True)
class Workspace:
    """The folders that a run reads from and writes to.

    Attributes:
        data: the definitions that come with the project (subjects, datasets, presets, assets.toml, body).
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
        return self.data / "body"


def open_workspace(
    data: str | Path | None = None,
    artifacts: str | Path | None = None,
    assets: str | Path | None = None,
    body: str | Path | None = None,
    stages: str = "stages",
) -> Workspace:
    """A workspace with the defaults of this checkout for everything that is not given."""
    data = Path(data or REPOSITORY / "data").resolve()
    return Workspace(
        data=data,
        artifacts=Path(artifacts or data / "artifacts").resolve(),
        assets=Path(assets or data / "assets").resolve(),
        body_file=Path(body or data / "body" / "open_body.npz").resolve(),
        stages=stages,
    )
