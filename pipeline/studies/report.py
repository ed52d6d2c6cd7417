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
from pipeline.studies.tables import Table, latex, markdown
from pipeline.studies.variants import Base, Overrides, Result, run_record

LIBRARIES = ("torch", "numba", "numpy")

Picture = tuple[Path, str]
"""A PNG and its caption."""


@dataclasses.dataclass(frozen=True)
class Page:
    """Everything that a study shows; its page ends with settings, times and versions.

    Attributes:
        title: of the page.
        lead: the one sentence that a reader can act on.
        lines: further sentences at the top.
        sections: in their order.
        base: of the study, whose settings are shown in full.
        changed: variant -> its overrides.
        results: by the name to show; failures are left out.
        seconds: of this call.
    """

    title: str
    lead: str
    lines: Sequence[str]
    sections: Sequence[Section]
    base: Base
    changed: Mapping[str, Overrides]
    results: Mapping[str, Result]
    seconds: float


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of the page: a heading, and below it sentences, plots and tables where there are any."""

    heading: str
    lines: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()


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
    done = {name: one for name, one in page.results.items() if not one.failure}
    told = environment.get_template("study.html.jinja").render(
        page=page,
        settings={stage: as_dict(own) for stage, own in page.base.settings.items()},
        done=done,
        runs={  # what variants share counts once
            one.folders[stage]: (one.seconds[stage], one.cpu_seconds[stage])
            for one in done.values()
            for stage in one.seconds
        },
        versions=versions_of(next(iter(done.values()))),
    )
    write_atomically(folder / "report.html", told)
    print(f"{text}\ntables, plots and page: {shown(folder)}")


def versions_of(result: Result) -> dict[str, str]:
    """Stages, libraries and machine of a result."""
    manifests = {stage: read_manifest(folder) or {} for stage, folder in result.folders.items()}
    record = run_record(result.folders["train"])
    return {
        **{stage: f"version {manifest.get('version', '?')}" for stage, manifest in manifests.items()},
        **{name: importlib.metadata.version(name) for name in LIBRARIES},
        "Python": platform.python_version(),
        "machine": f"{record.get('cores')} cores, {record.get('machine')}",
    }
