"""The paper's table of a dataset, with what was measured here beside it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from pipeline.config.datasets import Dataset, load_dataset, subjects_of
from pipeline.config.evaluation_protocol import ON, OWN, Protocol, chosen
from pipeline.config.request import Request
from pipeline.errors import UserError
from pipeline.run.job import open_job, shown
from pipeline.run.stage import usual
from pipeline.store.artifact import Store
from pipeline.store.digest import write_atomically
from pipeline.studies.tables import MEAN, pipe_table
from pipeline.studies.variants import read_summary

SCORES = {"psnr": (2, 1), "ssim": (3, 1), "lpips_alex": (2, 100)}  # digits after the point, and a factor
FACES = {"arcface_cosine": (4, 1)}
AVATAR, REFINED = "avatar", "avatar_refined"
OURS = {
    AVATAR: "here",
    REFINED: "here, test poses refined",
    "nearest_frame": "here, nearest training frame",
}


@dataclasses.dataclass(frozen=True)
class Measured:
    """One subject's result.

    Attributes:
        means: method -> metric -> mean over the held-out frames, of the metrics that have one.
        protocol, background, render_mask: how it was measured.
        current: whether it was made under the settings that are asked for.
    """

    means: Mapping[str, Mapping[str, float]]
    protocol: str = ""
    background: str = "black"
    render_mask: str = OWN
    current: bool = True


def compare(dataset: str, request: Request) -> Path:
    """Prints the table of a dataset and writes it to ``artifacts/compare/<dataset>.md``.

    Raises:
        UserError: there is no such dataset, or a result of it is damaged.
    """
    workspace = request.workspace
    about, subjects = load_dataset(workspace, dataset), subjects_of(workspace, dataset)
    request = dataclasses.replace(request, subjects=())  # each is what its own file says
    measured = {subject: measured_of(subject, request) for subject in subjects}
    text = comparison(about, subjects, {subject: one for subject, one in measured.items() if one})
    path = workspace.artifacts / "compare" / f"{dataset}.md"
    write_atomically(path, text)
    print(f"{text}\nwritten to {shown(path)}")
    return path


def measured_of(subject: str, request: Request) -> Measured | None:
    """A subject's result that is asked for, else the one in use, else None."""
    job = open_job(subject, request)
    last = "evaluate" if "evaluate" in job.stages else usual(job.stages)[-1]
    try:
        current = job.find(last)
    except UserError:  # the footage is not here any more; the result may be
        current = None
    artifact = current or Store(job.workspace.artifacts).latest(subject, last)
    if artifact is None:
        return None
    summary = read_summary(artifact.folder)
    mask = summary.get("choices", {}).get("render_mask", OWN)
    protocol, background = str(summary.get("protocol", "")), str(summary.get("background", "black"))
    return Measured(summary["means"], protocol, background, str(mask), current=current is not None)


def comparison(about: Dataset, subjects: Sequence[str], found: Mapping[str, Measured]) -> str:
    """The table as Markdown, with remarks below, and a table of face consistency where any is known.

    Args:
        about: the dataset, with the published rows.
        subjects: all of it, the columns before the mean.
        found: subject -> what was measured, of those that have been run.
    """
    published: dict[str, dict[str, Sequence[float]]] = {row.method: dict(row.values) for row in about.rows}
    for row in published.values():
        if MEAN not in row and set(subjects) <= set(row):
            row[MEAN] = pd.DataFrame(row)[list(subjects)].mean(axis=1).tolist()
    under = f", {about.table}" if about.table else ""
    head = f"# {about.title}\n\nPSNR (dB) / SSIM / LPIPS x 100{under}\n"
    said = [f"- {remark}" for remark in remarks(about, subjects, found)]
    lines = [head, *method_table(SCORES, subjects, published, found, counted(about)), *said, ""]

    cosines = {method: {MEAN: [cosine]} for method, cosine in about.faces.items()}
    table = method_table(FACES, subjects, cosines, found)
    if table:
        head = "## Face consistency\n\nThe cosine of ArcFace's embeddings of the rendered and the true face\n"
        unknown = ["- Not measured here: evaluate.arcface=FILE names ArcFace's ONNX file", ""]
        known = any(FACES.keys() & of.keys() for one in found.values() for of in one.means.values())
        lines += [head, *table, *([] if known else unknown)]
    return "\n".join(lines)


def method_table(
    metrics: Mapping[str, tuple[int, float]],
    subjects: Sequence[str],
    published: Mapping[str, Mapping[str, Sequence[float]]],
    found: Mapping[str, Measured],
    marked: str = "",
) -> list[str]:
    """The lines of a table of ``34.80 / 0.984 / 0.90``: a row a method, a column a subject and their mean.

    Args:
        metrics: name -> digits after the point, and a factor of what was measured.
        subjects, found: as for ``comparison``.
        published: method -> subject or mean -> a number a metric.
        marked: the method of ``OURS`` that stands out.
    """
    rows = {f"{method} (published)": row for method, row in published.items()}
    for method, name in OURS.items():
        ours = {
            subject: [factor * one.means[method].get(key, math.nan) for key, (_, factor) in metrics.items()]
            for subject, one in found.items()
            if metrics.keys() & one.means.get(method, {}).keys()
        }
        if ours:
            part = "" if len(ours) == len(subjects) else f" ({len(ours)} of {len(subjects)} subjects)"
            name = f"**{name}**" if method == marked else name
            rows[f"{name}{part}"] = {**ours, MEAN: pd.DataFrame(ours).mean(axis=1).tolist()}
    digits = [digits for digits, _ in metrics.values()]
    columns = [*(subject for subject in subjects if any(subject in row for row in rows.values())), MEAN]
    texts = pd.DataFrame("-", pd.Index(rows, name="method"), columns)
    for name, row in rows.items():
        for column in row.keys() & set(columns):
            cells = zip(row[column], digits, strict=True)
            texts.loc[name, column] = " / ".join("-" if math.isnan(n) else f"{n:.{d}f}" for n, d in cells)
    return [pipe_table(texts.reset_index(), numbers="left"), ""] if rows else []


def counted(about: Dataset) -> str:
    """The method that was measured as the published rows were: with test poses refined or not."""
    return REFINED if wanted(about).refine_test_poses == ON else AVATAR


def wanted(about: Dataset) -> Protocol:
    """The protocol that the dataset's own settings ask for."""
    return chosen(about.layer.tables.get("evaluate", {}))


def remarks(about: Dataset, subjects: Sequence[str], found: Mapping[str, Measured]) -> list[str]:
    """Sentences below the table: which row to compare, and what was not measured as the published numbers."""
    said = [f"Published numbers: {about.protocol}"] if about.protocol else []
    said += [f"Measured here: {one}" for one in sorted({one.protocol for one in found.values()} - {""})]

    def name_those(remark: str, exempt: Callable[[Measured], bool]) -> None:
        others = [subject for subject, one in found.items() if not exempt(one)]
        said.extend([f"{remark}: {', '.join(others)}"] if others else [])

    if found and about.rows:
        asked, unlike = wanted(about), "Not comparable, the published numbers"
        said.append(f"The row to compare is '{OURS[counted(about)]}'")
        name_those("Not comparable, test poses were not refined", lambda one: counted(about) in one.means)
        if {"protocol", "background"} & set(about.layer.tables.get("evaluate", {})):
            own = asked.render_mask == OWN
            mask = (
                "leave the render its own alpha"
                if own
                else f"have the {asked.render_mask}'s mask on both pictures"
            )
            name_those(f"{unlike} are on {asked.background}", lambda one: one.background == asked.background)
            name_those(f"{unlike} {mask}", lambda one: one.render_mask == asked.render_mask)
    missing = [subject for subject in subjects if subject not in found]
    said += [f"Not run: {', '.join(missing)}; doit run subject={','.join(missing)}"] if missing else []
    name_those("Under other settings than are asked for", lambda one: one.current)
    return said
