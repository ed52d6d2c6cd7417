"""Datasets: settings that their subjects share, and what was published of them.

A dataset is one file, ``data/datasets/<name>.toml``::

    title = "INSTA: seven heads"
    obtain = "where to get it; each subject's folder goes to data/sources/insta/"
    protocol = "what the published numbers were measured on"
    [ingest]                                   # settings of any stage
    test_frames = 350
    [paper]                                    # optional: the published table
    table = "Table 4 (INSTA)"
    [[paper.rows]]
    method = "RGBAvatar"
    mean = [32.72, 0.953, 6.04]                # PSNR, SSIM, LPIPS times 100; or a subject's name
    [paper.faces]                              # optional: method -> face consistency, ArcFace's mean cosine
    RGBAvatar = 0.79

Its subjects are those whose own file says ``dataset = "insta"``: one file more in ``data/subjects`` is
one subject more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from pipeline.config.settings import Layer, near, read_toml
from pipeline.config.workspace import Workspace
from pipeline.errors import UserError

OWN = ("title", "obtain", "protocol", "paper")
"""What a dataset's file holds besides settings."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A published line of a table.

    Attributes:
        method: as the table names it.
        values: subject, or ``mean`` -> PSNR, SSIM, LPIPS times 100.
    """

    method: str
    values: Mapping[str, tuple[float, ...]]


@dataclasses.dataclass(frozen=True)
class Dataset:
    """What a dataset's file says.

    Attributes:
        name: as in ``dataset=NAME``.
        title: one line for people.
        obtain: where the data is to be had and where it goes.
        protocol: what the published numbers were measured on.
        layer: the settings.
        table: the published table's name.
        rows: its lines.
        faces: method -> published face consistency, the mean cosine of ArcFace's embeddings.
    """

    name: str
    title: str
    obtain: str
    protocol: str
    layer: Layer
    table: str
    rows: tuple[Row, ...]
    faces: Mapping[str, float] = dataclasses.field(default_factory=dict)


def known_datasets(workspace: Workspace) -> tuple[str, ...]:
    """The datasets that data/datasets names, sorted."""
    return tuple(sorted(path.stem for path in (workspace.definitions("datasets")).glob("*.toml")))


def load_dataset(workspace: Workspace, name: str) -> Dataset:
    """Read a dataset's file.

    Raises:
        UserError: there is none, or it is wrong.
    """
    path = workspace.definitions("datasets") / f"{name}.toml"
    known = known_datasets(workspace)
    if name not in known:
        raise UserError(f"dataset={name}: there is only {', '.join(known) or 'none'}{near(name, known)}")
    content = read_toml(path)
    paper = content.get("paper", {})
    try:
        rows = tuple(_row(row) for row in paper.get("rows", ()))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise UserError(f"{path}: a row of [[paper.rows]] is not method and lists of 3 numbers") from None
    try:
        faces = {str(method): float(cosine) for method, cosine in paper.get("faces", {}).items()}
    except (TypeError, ValueError, AttributeError):
        raise UserError(f"{path}: [paper.faces] is not methods and one number each") from None
    settings = {key: value for key, value in content.items() if key not in OWN}
    return Dataset(
        name=name,
        title=str(content.get("title", name)),
        obtain=str(content.get("obtain", "")),
        protocol=str(content.get("protocol", "")),
        layer=Layer(str(path), settings),
        table=str(paper.get("table", "")),
        rows=rows,
        faces=faces,
    )


def _row(row: Mapping[str, Any]) -> Row:
    values = {key: tuple(float(n) for n in value) for key, value in row.items() if key != "method"}
    if any(len(value) != 3 for value in values.values()):
        raise ValueError(row)
    return Row(str(row["method"]), values)


def subjects_of(workspace: Workspace, name: str) -> tuple[str, ...]:
    """The subjects of a dataset, sorted.

    Raises:
        UserError: there is no such dataset, or no subject of it.
    """
    load_dataset(workspace, name)
    files = sorted((workspace.definitions("subjects")).glob("*.toml"))
    found = tuple(file.stem for file in files if read_toml(file).get("dataset") == name)
    if not found:
        raise UserError(
            f'dataset={name}: no file in {workspace.definitions("subjects")} says dataset = "{name}"'
        )
    return found
