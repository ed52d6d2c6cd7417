"""A study's files: tables as Markdown, LaTeX and Parquet, and one page that needs no network."""

from __future__ import annotations

import base64
import dataclasses
import importlib.metadata
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

from pipeline.config.settings import as_dict
from pipeline.run.job import shown
from pipeline.store.artifact import MANIFEST
from pipeline.store.digest import write_atomically
from pipeline.studies.sweep import mesh_of, picture_setting, setting_of
from pipeline.studies.tables import Table, latex, markdown
from pipeline.studies.variants import Overrides, Result, run_record

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


def publish(folder: Path, page: Page, tables: Sequence[Table], values: pd.DataFrame) -> None:
    """Writes ``table.md``, ``table.tex``, ``table.parquet`` and ``report.html``, and prints the tables.

    Args:
        folder: where they go.
        page: the report.
        tables: for Markdown and LaTeX.
        values: for Parquet, as ``Table.values`` gives them.
    """
    text = "\n".join([f"{page.lead}\n", *map(markdown, tables)])
    write_atomically(folder / "table.md", text)
    write_atomically(folder / "table.tex", "\n".join(map(latex, tables)))
    values.to_parquet(folder / "table.parquet", index=False, compression="zstd")
    write_page(folder / "report.html", page)
    print(f"{text}\ntables, plots and page: {shown(folder)}")


def write_page(path: Path, page: Page) -> None:
    """Writes the page, plots included."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.filters["base64"] = lambda file: base64.b64encode(file.read_bytes()).decode("ascii")
    write_atomically(path, environment.get_template("study.html.jinja").render(page=page))


def settings_section(settings: Mapping[str, Any], changed: Mapping[str, Overrides]) -> Section:
    """The base's settings in full, and what each variant overrides.

    Args:
        settings: stage -> settings of the base.
        changed: variant -> its overrides.
    """
    each = [(name, " ".join(f"{k}={v}" for k, v in own.items()) or "–") for name, own in changed.items()]
    own = {
        f"{stage}: the study's own": [(f"{stage}.{name}", str(value)) for name, value in as_dict(one).items()]
        for stage, one in settings.items()
    }
    return Section("Settings", details=[("what each variant changes", each), *own.items()])


def timings_section(results: Mapping[str, Result], seconds: float) -> Section:
    """What each variant's stages took, this call's own time, and the versions.

    Args:
        results: by the name to show; failures are left out.
        seconds: of this call.
    """
    done = {name: one for name, one in results.items() if not one.failure}
    rows = [
        (str(name), ", ".join(f"{stage} {took:.0f}" for stage, took in one.seconds.items()))
        for name, one in done.items()
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
    versions = list(versions_of(next(iter(done.values()))).items())
    details = [("wall-clock seconds of each variant's stages", rows), ("versions", versions)]
    return Section("Time and versions", [line], details=details)


def versions_of(result: Result) -> dict[str, str]:
    """Stages, libraries and machine of a result."""
    found = {}
    for stage, folder in result.folders.items():
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        found[stage] = f"version {manifest.get('version', '?')}"
    found |= {name: importlib.metadata.version(name) for name in LIBRARIES}
    record = run_record(result.folders["train"])
    machine = f"{record.get('cores')} cores, {record.get('machine')}"
    return {**found, "Python": platform.python_version(), "machine": machine}


def sizes_of(settings: Mapping[str, Any]) -> str:
    """A sentence on how large and how long the base's run is, for captions.

    Args:
        settings: stage -> settings of the base.
    """
    train, side = settings["train"], setting_of(settings, picture_setting(settings["ingest"]))
    own = f"{train.iterations:,} iterations, {mesh_of(train, settings['plan'])}, pictures of {side} px"
    small = (
        ""
        if train.iterations >= 1000
        else "; small: a part that needs a long run shows less than it is worth"
    )
    return f"Sizes: {own}{small}."
