"""The paper's table of a dataset, with what was measured here beside it."""

from __future__ import annotations

import dataclasses
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.artifact import Artifact, Store
from pipeline.config.request import Request
from pipeline.datasets import Dataset, load_dataset, subjects_of
from pipeline.digest import write_atomically
from pipeline.errors import UserError
from pipeline.job import open_job, shown
from pipeline.protocols import ON, OWN, Protocol, chosen
from pipeline.stage import usual

MEAN = "mean"
METRICS = ("psnr", "ssim", "lpips_alex")
AVATAR, REFINED = "avatar", "avatar_refined"
OURS = {
    AVATAR: "here",
    REFINED: "here, test poses refined",
    "nearest_frame": "here, nearest training frame",
}
Values = tuple[float | None, ...]


def compare(dataset: str, request: Request) -> Path:
    """Prints the table of a dataset and writes it to ``artifacts/compare/<dataset>.md``.

    Raises:
        UserError: there is no such dataset, or a result of it is damaged.
    """
    workspace = request.workspace
    about = load_dataset(workspace, dataset)
    subjects = subjects_of(workspace, dataset)
    request = dataclasses.replace(request, subjects=())  # each is what its own file says
    found = {subject: result_of(subject, request) for subject in subjects}
    text = table(about, subjects, {subject: one[0] for subject, one in found.items()}, notes(about, found))
    path = workspace.artifacts / "compare" / f"{dataset}.md"
    write_atomically(path, text)
    print(text)
    print(f"written to {shown(path)}")
    return path


def result_of(subject: str, request: Request) -> tuple[dict[str, Any] | None, bool]:
    """A subject's ``summary.json``, and whether it is what is asked for.

    The result that is asked for, else the one in use, else None.
    """
    job = open_job(subject, request)
    last = "evaluate" if "evaluate" in job.stages else usual(job.stages)[-1]
    try:
        artifact = job.find(last)
    except UserError:  # the footage is not here any more; the result may be
        artifact = None
    current = artifact is not None
    artifact = artifact or Store(job.workspace.artifacts).latest(subject, last)
    return (read_summary(artifact), current) if artifact else (None, False)


def read_summary(artifact: Artifact) -> dict[str, Any]:
    """What evaluate wrote; UserError where it is damaged."""
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


def table(
    about: Dataset,
    subjects: Sequence[str],
    found: Mapping[str, dict[str, Any] | None],
    remarks: Sequence[str],
) -> str:
    """The table as Markdown.

    Args:
        about: the dataset, with the published rows.
        subjects: the columns before the mean.
        found: subject -> what was measured, or None.
        remarks: sentences below.
    """
    published = {column for row in about.rows for column in row.values}
    columns = [subject for subject in subjects if subject in published or found.get(subject)]
    lines = [
        f"# {about.title}",
        "",
        f"PSNR (dB) / SSIM / LPIPS x 100{f', {about.table}' if about.table else ''}",
        "",
        f"| method | {' | '.join([*columns, MEAN])} |",
        f"|---|{'---|' * (len(columns) + 1)}",
    ]
    for row in about.rows:
        lines.append(line(f"{row.method} (published)", with_mean(row.values, subjects), columns))
    for method, name in OURS.items():
        values = {subject: measured(found.get(subject), method) for subject in columns}
        known = {subject: value for subject, value in values.items() if value}
        if known:
            part = "" if len(known) == len(subjects) else f" ({len(known)} of {len(subjects)} subjects)"
            name = f"**{name}**" if method == counted(about) else name
            lines.append(line(f"{name}{part}", with_mean(known, list(known)), columns))
    return "\n".join([*lines, "", *(f"- {remark}" for remark in remarks), ""])


def counted(about: Dataset) -> str:
    """Which of our rows was measured as the published ones were: with test poses refined or not."""
    return REFINED if wanted(about).refine_test_poses == ON else AVATAR


def wanted(about: Dataset) -> Protocol:
    """What the dataset's own settings make the protocol."""
    return chosen(about.layer.tables.get("evaluate", {}))


def with_mean(values: Mapping[str, Values], subjects: Sequence[str]) -> dict[str, Values]:
    """The values with the mean over the subjects, where it is not given and all are known."""
    known = [values[subject] for subject in subjects if subject in values]
    if MEAN in values or len(known) < len(subjects):
        return dict(values)
    return {
        **values,
        MEAN: tuple(average([value[place] for value in known]) for place in range(len(METRICS))),
    }


def line(name: str, values: Mapping[str, Values], columns: Sequence[str]) -> str:
    """One row of the table."""
    cells = [cell(values.get(column)) for column in (*columns, MEAN)]
    return f"| {name} | {' | '.join(cells)} |"


def cell(values: Values | None) -> str:
    """``34.80 / 0.984 / 0.90``, or a dash."""
    if not values:
        return "-"
    digits = (2, 3, 2)
    return " / ".join("-" if v is None else f"{v:.{d}f}" for v, d in zip(values, digits, strict=True))


def measured(summary: Mapping[str, Any] | None, method: str) -> Values | None:
    """PSNR, SSIM and LPIPS times 100 of a method on the held-out frames."""
    means = (summary or {}).get("means", {}).get(method)
    if not means:
        return None
    psnr, ssim, lpips = (means.get(metric) for metric in METRICS)
    return psnr, ssim, None if lpips is None else 100 * lpips


def average(values: Sequence[float | None]) -> float | None:
    """The mean of what is known."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def otherwise(about: Dataset, found: Mapping[str, dict[str, Any]]) -> list[str]:
    """Which row to compare, and what was not measured as the published numbers were."""
    if not found or not about.rows:
        return []
    remarks = [f"The row to compare is '{OURS[counted(about)]}'"]
    unrefined = [subject for subject, one in found.items() if counted(about) not in one["means"]]
    if unrefined:
        remarks.append(f"Not comparable, test poses were not refined: {', '.join(unrefined)}")
    if {"protocol", "background"} & set(about.layer.tables.get("evaluate", {})):
        for choice, said in (
            ("background", "are on {}"),
            ("render_mask", "have the {}'s mask on both pictures"),
        ):
            word = getattr(wanted(about), choice)
            other = [subject for subject, one in found.items() if one[choice] != word]
            said = "leave the render its own alpha" if word == OWN else said.format(word)
            if other:
                remarks.append(f"Not comparable, the published numbers {said}: {', '.join(other)}")
    return remarks


def notes(about: Dataset, found: Mapping[str, tuple[dict[str, Any] | None, bool]]) -> list[str]:
    """What must be said beside the numbers."""
    remarks = [f"Published numbers: {about.protocol}"] if about.protocol else []
    protocols = {one["protocol"] for one, _ in found.values() if one and one["protocol"]}
    remarks += [f"Measured here: {protocol}" for protocol in sorted(protocols)]
    remarks += otherwise(about, {subject: one for subject, (one, _) in found.items() if one})
    missing = [subject for subject, (one, _) in found.items() if one is None]
    if missing:
        remarks.append(f"Not run: {', '.join(missing)}; doit run subject={','.join(missing)}")
    other = [subject for subject, (one, current) in found.items() if one is not None and not current]
    if other:
        remarks.append(f"Under other settings than are asked for: {', '.join(other)}")
    return remarks
