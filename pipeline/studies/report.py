"""A study's files: tables as Markdown, LaTeX and Parquet, and one page that needs no network."""

from __future__ import annotations

import base64
import dataclasses
import importlib.metadata
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import pandas as pd

from pipeline.config.settings import as_dict
from pipeline.run.job import shown
from pipeline.store.artifact import read_manifest
from pipeline.store.digest import write_atomically
from pipeline.studies.sweep import mesh_of, picture_setting, setting_of
from pipeline.studies.tables import Table, latex, markdown
from pipeline.studies.variants import Base, Overrides, Result, Settings, run_record

LIBRARIES = ("torch", "numba", "numpy")

Picture = tuple[Path, str]
"""A PNG and its caption."""


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of the page; any of it may be left out.

    Attributes:
        heading: above it.
        lines: sentences.
        pictures: plots.
        tables: numbers.
        details: a summary, and the rows (name, value) that it unfolds to.
    """

    heading: str
    lines: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    details: Sequence[tuple[str, Sequence[tuple[str, str]]]] = ()


@dataclasses.dataclass(frozen=True)
class Page:
    """Everything that a page shows.

    Attributes:
        title: of the page.
        lead: the one sentence that a reader can act on.
        lines: further sentences at the top.
        sections: in their order.
    """

    title: str
    lead: str
    lines: Sequence[str]
    sections: Sequence[Section]


def study_folder(data: Path, kind: str, name: str) -> Path:
    """The folder for a study's tables, plots and page; it is made."""
    folder = data / "studies" / kind / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def publish(folder: Path, page: Page, values: pd.DataFrame) -> None:
    """Writes ``table.md``, ``table.tex``, ``table.parquet`` and ``report.html``, and prints the tables.

    Args:
        folder: where they go.
        page: the report.
        values: for Parquet, as ``Table.values`` gives them.
    """
    tables = [table for section in page.sections for table in section.tables]
    text = "\n".join([f"{page.lead}\n", *map(markdown, tables)])
    write_atomically(folder / "table.md", text)
    write_atomically(folder / "table.tex", "\n".join(map(latex, tables)))
    values.to_parquet(folder / "table.parquet", index=False, compression="zstd")
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.filters["base64"] = lambda file: base64.b64encode(file.read_bytes()).decode("ascii")
    write_atomically(folder / "report.html", environment.get_template("study.html.jinja").render(page=page))
    print(f"{text}\ntables, plots and page: {shown(folder)}")


def closing_sections(
    base: Base, changed: Mapping[str, Overrides], results: Mapping[str, Result], seconds: float
) -> tuple[Section, Section]:
    """The base's settings in full and what each variant overrides; what it all took, and the versions.

    Args:
        base: of the study.
        changed: variant -> its overrides.
        results: by the name to show; failures are left out.
        seconds: of this call.
    """
    each = [(name, " ".join(f"{k}={v}" for k, v in own.items()) or "–") for name, own in changed.items()]
    own = [
        (f"{stage}: the study's own", [(f"{stage}.{n}", str(value)) for n, value in as_dict(one).items()])
        for stage, one in base.settings.items()
    ]
    settings = Section("Settings", details=[("what each variant changes", each), *own])
    done = {name: one for name, one in results.items() if not one.failure}
    rows = [
        (name, ", ".join(f"{s} {took:.0f}" for s, took in one.seconds.items())) for name, one in done.items()
    ]
    once = {  # what variants share counts once
        one.folders[stage]: (one.seconds[stage], one.cpu_seconds[stage])
        for one in done.values()
        for stage in one.seconds
    }
    wall, cpu = (sum(times) / 60 for times in zip(*once.values(), strict=True))
    line = (
        f"The {len(once)} results that this stands on took {wall:,.0f} wall-clock minutes, {cpu:,.0f} "
        f"minutes of processor time. This call took {seconds:,.0f} s: what the store held was not remade. "
        "Wall-clock seconds are those of the run that made a result, whatever else the machine was doing."
    )
    versions = versions_of(next(iter(done.values())))
    details = [("wall-clock seconds of each variant's stages", rows), ("versions", versions)]
    return settings, Section("Time and versions", [line], details=details)


def versions_of(result: Result) -> list[tuple[str, str]]:
    """Stages, libraries and machine of a result."""
    manifests = {stage: read_manifest(folder) or {} for stage, folder in result.folders.items()}
    record = run_record(result.folders["train"])
    return [
        *((stage, f"version {manifest.get('version', '?')}") for stage, manifest in manifests.items()),
        *((name, importlib.metadata.version(name)) for name in LIBRARIES),
        ("Python", platform.python_version()),
        ("machine", f"{record.get('cores')} cores, {record.get('machine')}"),
    ]


def sizes_of(settings: Settings) -> str:
    """How large and how long the base's run is, in words."""
    train, side = settings["train"], setting_of(settings, picture_setting(settings["ingest"]))
    steps, small = f"{train.effort:g} times the plan's steps", ""
    if train.iterations:
        steps = f"{train.iterations:,} iterations"
        small = "; small: a part that needs a long run shows less than it is worth"
    small = small if train.iterations < 1000 else ""
    return f"{steps}, {mesh_of(settings)}, pictures of {side} px{small}"
