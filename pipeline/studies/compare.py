"""The paper's table of a dataset, with what was measured here beside it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.config.datasets import Dataset, load_dataset, subjects_of
from pipeline.config.evaluation_protocol import ON, OWN, Protocol, chosen
from pipeline.config.request import Request
from pipeline.errors import UserError
from pipeline.run.job import open_job, shown
from pipeline.run.stage import usual
from pipeline.store.artifact import Artifact, Store
from pipeline.store.digest import write_atomically
from pipeline.studies.tables import pipe_table

MEAN = "mean"
DIGITS = {"psnr": 2, "ssim": 3, "lpips_alex": 2}
AVATAR, REFINED = "avatar", "avatar_refined"
OURS = {
    AVATAR: "here",
    REFINED: "here, test poses refined",
    "nearest_frame": "here, nearest training frame",
}

Summary = Mapping[str, Any]
"""One subject's ``means`` by method, ``protocol``, ``background``, ``render_mask``; and whether it is
``current``, made under these settings."""


def compare(dataset: str, request: Request) -> Path:
    """Prints the table of a dataset and writes it to ``artifacts/compare/<dataset>.md``.

    Raises:
        UserError: there is no such dataset, or a result of it is damaged.
    """
    workspace = request.workspace
    about, subjects = load_dataset(workspace, dataset), subjects_of(workspace, dataset)
    request = dataclasses.replace(request, subjects=())  # each is what its own file says
    summaries = {subject: summary_of(subject, request) for subject in subjects}
    found = {subject: one for subject, one in summaries.items() if one}
    text = comparison(about, subjects, found)
    path = workspace.artifacts / "compare" / f"{dataset}.md"
    write_atomically(path, text)
    print(f"{text}\nwritten to {shown(path)}")
    return path


def summary_of(subject: str, request: Request) -> Summary | None:
    """A subject's result that is asked for, else the one in use, else None."""
    job = open_job(subject, request)
    last = "evaluate" if "evaluate" in job.stages else usual(job.stages)[-1]
    try:
        current = job.find(last)
    except UserError:  # the footage is not here any more; the result may be
        current = None
    artifact = current or Store(job.workspace.artifacts).latest(subject, last)
    return {**read_summary(artifact), "current": current is not None} if artifact else None


def read_summary(artifact: Artifact) -> dict[str, Any]:
    """The means and the protocol that evaluate wrote; UserError where its file is damaged."""
    path = artifact.folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        return {
            "means": summary["means"]["test"],
            "protocol": str(summary.get("protocol", "")),
            "background": str(summary.get("background", "black")),
            "render_mask": str(summary.get("choices", {}).get("render_mask", OWN)),
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({error}): run the evaluate stage again") from None


def comparison(about: Dataset, subjects: Sequence[str], found: Mapping[str, Summary]) -> str:
    """The table as Markdown, with remarks below.

    Args:
        about: the dataset, with the published rows.
        subjects: all of it, the columns before the mean.
        found: subject -> what was measured, of those that have been run.
    """
    published = {column for row in about.rows for column in row.values}
    columns = [*(subject for subject in subjects if subject in published or subject in found), MEAN]
    rows = {f"{row.method} (published)": scores(row.values, subjects) for row in about.rows}
    for method, name in OURS.items():
        measured = {subject: one["means"][method] for subject, one in found.items() if method in one["means"]}
        if measured:
            values = {s: [means.get(metric) for metric in DIGITS] for s, means in measured.items()}
            part = "" if len(measured) == len(subjects) else f" ({len(measured)} of {len(subjects)} subjects)"
            name = f"**{name}**" if method == counted(about) else name
            rows[f"{name}{part}"] = scores(values, list(measured)).mul([1, 1, 100], axis=0)
    texts = pd.DataFrame({name: row.reindex(columns=columns).apply(cell) for name, row in rows.items()}).T
    texts.insert(0, "method", texts.index)
    under = f", {about.table}" if about.table else ""
    head = f"# {about.title}\n\nPSNR (dB) / SSIM / LPIPS x 100{under}\n"
    table = pipe_table(texts, numbers="left")
    return "\n".join([head, table, "", *(f"- {remark}" for remark in remarks(about, subjects, found)), ""])


def scores(values: Mapping[str, Sequence[float | None]], subjects: Sequence[str]) -> pd.DataFrame:
    """PSNR, SSIM and LPIPS by row, a column a subject, the mean where it is not given and all are known."""
    table = pd.DataFrame(values, index=list(DIGITS), dtype=float)
    if MEAN not in table and set(subjects) <= set(table):
        table[MEAN] = table[list(subjects)].mean(axis=1)
    return table


def cell(numbers: pd.Series) -> str:
    """``34.80 / 0.984 / 0.90``, or a dash."""
    if numbers.isna().all():
        return "-"
    return " / ".join("-" if pd.isna(n) else f"{n:.{DIGITS[metric]}f}" for metric, n in numbers.items())


def counted(about: Dataset) -> str:
    """The method that was measured as the published rows were: with test poses refined or not."""
    return REFINED if wanted(about).refine_test_poses == ON else AVATAR


def wanted(about: Dataset) -> Protocol:
    """The protocol that the dataset's own settings ask for."""
    return chosen(about.layer.tables.get("evaluate", {}))


def remarks(about: Dataset, subjects: Sequence[str], found: Mapping[str, Summary]) -> list[str]:
    """Sentences below the table: which row to compare, and what was not measured as the published numbers."""
    said = [f"Published numbers: {about.protocol}"] if about.protocol else []
    said += [f"Measured here: {one}" for one in sorted({one["protocol"] for one in found.values()} - {""})]
    not_alike = []
    if found and about.rows:
        said.append(f"The row to compare is '{OURS[counted(about)]}'")
        not_alike.append(("test poses were not refined", lambda one: counted(about) in one["means"]))
        if {"protocol", "background"} & set(about.layer.tables.get("evaluate", {})):
            protocol = wanted(about)
            mask = (
                "leave the render its own alpha"
                if protocol.render_mask == OWN
                else f"have the {protocol.render_mask}'s mask on both pictures"
            )
            not_alike += [
                (
                    f"the published numbers are on {protocol.background}",
                    lambda one: one["background"] == protocol.background,
                ),
                (f"the published numbers {mask}", lambda one: one["render_mask"] == protocol.render_mask),
            ]
    for reason, alike in not_alike:
        other = [subject for subject, one in found.items() if not alike(one)]
        said += [f"Not comparable, {reason}: {', '.join(other)}"] if other else []
    missing = [subject for subject in subjects if subject not in found]
    if missing:
        said.append(f"Not run: {', '.join(missing)}; doit run subject={','.join(missing)}")
    other = [subject for subject, one in found.items() if not one["current"]]
    if other:
        said.append(f"Under other settings than are asked for: {', '.join(other)}")
    return said
