"""A study's page: one file with everything in it, readable on a phone and without a network."""

from __future__ import annotations

import base64
import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import jinja2

from pipeline.config.request import parse_request
from pipeline.digest import write_atomically
from pipeline.job import open_job
from pipeline.settings import as_dict
from pipeline.studies.tables import Table
from pipeline.study import Outcome


@dataclasses.dataclass(frozen=True)
class Picture:
    """A plot.

    Attributes:
        path: the PNG.
        caption: what it shows.
    """

    path: Path
    caption: str

    @property
    def uri(self) -> str:
        """Its content as a data URI."""
        return f"data:image/png;base64,{base64.b64encode(self.path.read_bytes()).decode('ascii')}"


Details = tuple[str, Sequence[tuple[str, str]]]
"""What is shown when asked for: a summary, and rows of a name and a value."""


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of the page: a heading, sentences, plots, tables, and what unfolds; any may be left out."""

    heading: str
    lines: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    details: Sequence[Details] = ()


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


def write_page(path: Path, page: Page) -> None:
    """Writes the page."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    write_atomically(path, environment.get_template("study.html.jinja").render(page=page))


def settings_section(
    own: Mapping[str, str], subject: str, changed: Mapping[str, Mapping[str, str]]
) -> Section:
    """The study's own settings in full, and what each variant changes.

    Args:
        own: the study's words.
        subject: whose.
        changed: variant -> its words.
    """
    job = open_job(subject, parse_request(own, subject))
    each = [
        (name, " ".join(f"{key}={value}" for key, value in words.items()) or "–")
        for name, words in changed.items()
    ]
    details: list[Details] = [("what each variant changes", each)]
    for stage, settings in job.settings.items():
        rows = [(f"{stage}.{name}", str(value)) for name, value in as_dict(settings).items()]
        details.append((f"{stage}: the study's own", rows))
    return Section("Settings", details=details)


def total_time(outcomes: Iterable[Outcome]) -> str:
    """A sentence on what everything that the outcomes stand on took, each result counted once."""
    wall: dict[Path, float] = {}
    processor: dict[Path, float] = {}
    for one in outcomes:
        for stage, folder in one.folders.items():
            wall[folder] = one.seconds.get(stage, 0.0)
            processor[folder] = one.cpu_seconds.get(stage, 0.0)
    cpu = sum(value for value in processor.values() if math.isfinite(value))
    return (
        f"The {len(wall)} results that this stands on took {sum(wall.values()) / 60:,.0f} wall-clock "
        f"minutes, {cpu / 60:,.0f} minutes of processor time."
    )


def timings_section(outcomes: Mapping[str, Outcome], seconds: float, versions: Mapping[str, str]) -> Section:
    """What each run's stages took, the study's own time, and the versions."""
    rows = []
    for name, outcome in outcomes.items():
        took = ", ".join(f"{stage} {value:.0f}" for stage, value in outcome.seconds.items())
        rows.append((name, took))
    return Section(
        "Time and versions",
        [
            f"{total_time(outcomes.values())} This call took {seconds:,.0f} s: what the store held was not "
            "made again. Wall-clock seconds of each stage are those of the run that made its result, "
            "whatever else the machine was doing then."
        ],
        details=[("wall-clock seconds of each variant's stages", rows), ("versions", list(versions.items()))],
    )
