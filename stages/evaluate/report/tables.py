"""The tables of numbers as rows of text, and how they name and round what they hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from stages.evaluate.methods import AVATAR, CEILING, MEAN, MESH, NEAREST, REFINED
from stages.evaluate.scores import HELD_OUT, OTHER_CAMERA, TRAINING, VIEWS
from stages.evaluate.statistics import Means

LABELS = {
    (HELD_OUT, AVATAR): "avatar",
    (HELD_OUT, REFINED): "avatar, test poses refined",
    (HELD_OUT, MESH): "textured mesh",
    (HELD_OUT, NEAREST): "nearest training frame",
    (HELD_OUT, MEAN): "mean training frame",
    (HELD_OUT, CEILING): "the truth under a second mask",
    (TRAINING, AVATAR): "avatar, frames it was trained on",
}
"""(split, method) -> the row's name, in the order of the tables."""

METRIC_LABELS = {
    "psnr": "PSNR",
    "psnr_person": "PSNR person",
    "psnr_interior": "PSNR inside",
    "ssim": "SSIM",
    "lpips_alex": "LPIPS (Alex) x100",
    "lpips_vgg": "LPIPS (VGG) x100",
    "flicker": "flicker",
    "identity_distance": "face distance",
    "identity_cosine": "face cosine",
    "identity_found": "faces found",
    "arcface_cosine": "ArcFace's cosine (FC)",
}

_DECIMALS = {"ssim": 4, "identity_cosine": 3, "identity_distance": 3, "arcface_cosine": 4}  # all others: 2

REGION_METRICS = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
CONSISTENCY = ("flicker", "identity_distance", "identity_cosine", "identity_found", "arcface_cosine")

_COMPOSITES = {
    "psnr_black_own": "on black, its own alpha",
    "psnr_white_own": "on white, its own alpha",
    "psnr_black_truth": "on black, the truth's mask on both",
    "psnr_white_truth": "on white, the truth's mask on both",
}


@dataclasses.dataclass(frozen=True)
class NumberCell:
    """One number.

    Attributes:
        text: as it is shown.
        span: its interval, ``34.9 to 35.8``; empty where there is none.
        best: true where it is the best on held-out frames.
    """

    text: str
    span: str = ""
    best: bool = False


@dataclasses.dataclass(frozen=True)
class NumberRow:
    """A line: its label, its numbers, and a mark where it is the one to look at."""

    label: str
    cells: Sequence[NumberCell]
    main: bool = False


@dataclasses.dataclass(frozen=True)
class NumberTable:
    """Headings with their better direction, and lines."""

    head: Sequence[tuple[str, str]]
    rows: Sequence[NumberRow]

    def __bool__(self) -> bool:
        return bool(self.rows)


def main_table(summary: Mapping[str, Any]) -> NumberTable:
    """Every method on the metrics of the whole picture."""
    means, (psnr, *others) = summary["means"], summary["metrics"]
    metrics = [psnr, "psnr_person", *others]
    body = [_row(summary, split, method, metrics) for split, method, _ in rows(means)]
    return NumberTable([_heading(name) for name in metrics], body)


def region_tables(summary: Mapping[str, Any]) -> dict[str, NumberTable]:
    """Region -> every method on its crops; a region that was nowhere found is missing."""
    found = {}
    for region in ("face", "hands"):
        metrics = [
            f"{name}_{region}" for name in REGION_METRICS if f"{name}_{region}" in summary["further_metrics"]
        ]
        table = _some(summary, metrics)
        if table:
            found[region] = table
    return found


def consistency_table(summary: Mapping[str, Any]) -> NumberTable:
    """Flicker, and whose face it is where that was asked for."""
    return _some(summary, [name for name in CONSISTENCY if name in summary["further_metrics"]])


def composite_table(summary: Mapping[str, Any]) -> NumberTable:
    """The avatar's PSNR on held-out frames under every composite: what the protocol's choices are worth."""
    held_out = summary["means"].get(HELD_OUT, {})
    known = [name for name in _COMPOSITES if held_out.get(AVATAR, {}).get(name) is not None]
    used = "psnr_{background}_{render_mask}".format(**summary["choices"])
    methods = [method for method in (AVATAR, REFINED) if method in held_out]
    body = []
    for name in known:
        cells = [dataclasses.replace(_cell(summary, HELD_OUT, one, name), best=False) for one in methods]
        body.append(NumberRow(_COMPOSITES[name], cells, name == used))
    heads = {AVATAR: "PSNR", REFINED: "PSNR, test poses refined"}
    return NumberTable([(heads[method], "↑") for method in methods], body)


def camera_table(summary: Mapping[str, Any]) -> NumberTable:
    """The avatar and the textured mesh in cameras that the training frames do not have."""
    metrics = ("psnr", "psnr_person", "psnr_seen", "psnr_unseen", "unseen_share", "ssim")
    known = [name for name in metrics if any(name in row for row in _camera_rows(summary).values())]
    body = []
    for (view, method), means in _camera_rows(summary).items():
        cells = [NumberCell(number(name, means[name])) if name in means else NumberCell("") for name in known]
        body.append(NumberRow(f"{view}: {LABELS[HELD_OUT, method]}", cells, method == AVATAR))
    heads = {
        "psnr_seen": ("PSNR seen surface", "↑"),
        "psnr_unseen": ("PSNR never-seen surface", "↑"),
        "unseen_share": ("never seen, share", ""),
    }
    return NumberTable([heads.get(name, (label(name), "↑")) for name in known], body)


def _camera_rows(summary: Mapping[str, Any]) -> dict[tuple[str, str], Mapping[str, float | None]]:
    found = {}
    for view, table in summary["cameras"].items():
        split = VIEWS if VIEWS in table else HELD_OUT
        for method in (AVATAR, MESH):
            if method in table.get(split, {}):
                name = "cameras of the rig that training never had" if view == OTHER_CAMERA else view
                found[name, method] = table[split][method]
    return found


def _some(summary: Mapping[str, Any], metrics: Sequence[str]) -> NumberTable:
    """The methods that were measured in any of some metrics."""
    body = []
    for split, method, row in rows(summary["means"]):
        if method != CEILING and any(row.get(name) is not None for name in metrics):
            body.append(_row(summary, split, method, metrics))
    return NumberTable([_heading(name) for name in metrics], body)


def _row(summary: Mapping[str, Any], split: str, method: str, metrics: Sequence[str]) -> NumberRow:
    cells = [_cell(summary, split, method, name) for name in metrics]
    return NumberRow(LABELS[split, method], cells, (split, method) == (HELD_OUT, AVATAR))


def _cell(summary: Mapping[str, Any], split: str, method: str, metric: str) -> NumberCell:
    row = summary["means"][split][method]
    if metric not in row:
        return NumberCell("")
    value = row[metric]
    ends = summary["intervals"].get(split, {}).get(method, {}).get(metric)
    span = (
        f"{number(metric, ends[0])} to {number(metric, ends[1])}"
        if ends is not None and value is not None
        else ""
    )
    return NumberCell(
        number(metric, value), span, split == HELD_OUT and best(summary["means"], metric) == method
    )


def _heading(metric: str) -> tuple[str, str]:
    return label(metric), "↓" if lower_is_better(metric) else "↑"


def rows(means: Means) -> list[tuple[str, str, Mapping[str, float | None]]]:
    """(split, method, metric -> mean) of what was scored, in the order of ``LABELS``."""
    scored = [(split, method) for split, method in LABELS if method in means.get(split, {})]
    return [(split, method, means[split][method]) for split, method in scored]


def number(metric: str, value: float | None) -> str:
    """A mean as the tables show it; LPIPS times 100."""
    if value is None:
        return "n/a"
    base = metric.partition("_")[0]
    shown = 100 * value if base == "lpips" else value
    return f"{shown:.{_DECIMALS.get(metric, _DECIMALS.get(base, 2))}f}"


def label(metric: str) -> str:
    """A metric's name in the tables: also of crops, such as ``psnr_face``."""
    if metric in METRIC_LABELS:
        return METRIC_LABELS[metric]
    base, _, part = metric.rpartition("_")
    return f"{label(base)} {part}" if base else metric


def lower_is_better(metric: str) -> bool:
    """True where a smaller value means more alike."""
    return metric.startswith("lpips") or metric in ("flicker", "identity_distance")


def best(means: Means, metric: str) -> str | None:
    """The method that does best on the held-out frames, the truth aside; None where nothing is scored."""
    contestants = {method: row for method, row in means.get(HELD_OUT, {}).items() if method != CEILING}
    found = [(row.get(metric), method) for method, row in contestants.items()]
    values = [(value, method) for value, method in found if value is not None]
    return (min if lower_is_better(metric) else max)(values)[1] if values else None
