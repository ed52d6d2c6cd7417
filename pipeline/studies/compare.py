"""The paper's table of a dataset, with what was measured here beside it."""

from __future__ import annotations

import dataclasses
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
from pipeline.studies.variants import held_out_means, read_summary

DIGITS = {"psnr": 2, "ssim": 3, "lpips_alex": 2}
FACES = "arcface_cosine"
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
        means: method -> metric -> mean over the held-out frames, None where it has none.
        protocol, background, render_mask: how it was measured.
        current: whether it was made under the settings that are asked for.
    """

    means: Mapping[str, Mapping[str, float | None]]
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
    return Measured(held_out_means(summary), protocol, background, str(mask), current=current is not None)


def comparison(about: Dataset, subjects: Sequence[str], found: Mapping[str, Measured]) -> str:
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
        means = {subject: one.means[method] for subject, one in found.items() if method in one.means}
        if means:
            part = "" if len(means) == len(subjects) else f" ({len(means)} of {len(subjects)} subjects)"
            name = f"**{name}**" if method == counted(about) else name
            values = {subject: [one.get(metric) for metric in DIGITS] for subject, one in means.items()}
            rows[f"{name}{part}"] = scores(values, list(means)).mul([1, 1, 100], axis=0)
    texts = pd.DataFrame({name: row.reindex(columns=columns).apply(cell) for name, row in rows.items()}).T
    texts.insert(0, "method", texts.index)
    under = f", {about.table}" if about.table else ""
    head = f"# {about.title}\n\nPSNR (dB) / SSIM / LPIPS x 100{under}\n"
    table = pipe_table(texts, numbers="left")
    said = [f"- {remark}" for remark in remarks(about, subjects, found)]
    return "\n".join([head, table, "", *said, "", *faces(about, subjects, found)])


def faces(about: Dataset, subjects: Sequence[str], found: Mapping[str, Measured]) -> list[str]:
    """The lines of the table of face consistency (ArcFace's mean cosine); none where nothing is known."""
    rows = {f"{method} (published)": {MEAN: cosine} for method, cosine in about.faces.items()}
    for method, name in OURS.items():
        means = {subject: one.means.get(method, {}).get(FACES) for subject, one in found.items()}
        known = {subject: mean for subject, mean in means.items() if mean is not None}
        if known:
            part = "" if len(known) == len(subjects) else f" ({len(known)} of {len(subjects)} subjects)"
            rows[f"{name}{part}"] = known | {MEAN: sum(known.values()) / len(known)}
    if not rows:
        return []
    columns = [*(subject for subject in subjects if any(subject in row for row in rows.values())), MEAN]
    texts = [
        {"method": name, **{one: f"{row[one]:.4f}" if one in row else "-" for one in columns}}
        for name, row in rows.items()
    ]
    head = "## Face consistency\n\nThe cosine of ArcFace's embeddings of the rendered and the true face\n"
    missing = len(rows) == len(about.faces)
    said = ["- Not measured here: evaluate.arcface=FILE names ArcFace's ONNX file", ""] if missing else []
    return [head, pipe_table(pd.DataFrame(texts), numbers="left"), "", *said]


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
