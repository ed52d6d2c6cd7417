"""The report's tables of numbers, as rows of text."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from stages.evaluate.scoring import AVATAR, CEILING, HELD_OUT, MESH, OTHER_CAMERA, REFINED, VIEWS
from stages.evaluate.summary import LABELS, best, label, lower_is_better, number, rows

REGION_METRICS = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
LIKENESS = ("flicker", "identity_distance", "identity_cosine", "identity_found")

_COMPOSITES = {
    "psnr_black_own": "on black, its own alpha",
    "psnr_white_own": "on white, its own alpha",
    "psnr_black_truth": "on black, the truth's mask on both",
    "psnr_white_truth": "on white, the truth's mask on both",
}

_METHOD_LABELS = {AVATAR: "avatar", MESH: "textured mesh"}


@dataclasses.dataclass(frozen=True)
class Cell:
    """One number.

    Attributes:
        text: as it is shown.
        span: its interval, ``34.9 to 35.8``; empty where there is none.
        best: whether it is the best on held-out frames.
    """

    text: str
    span: str = ""
    best: bool = False


@dataclasses.dataclass(frozen=True)
class Row:
    """A line: what it is of, its numbers, and whether it is the one to look at."""

    label: str
    cells: Sequence[Cell]
    main: bool = False


@dataclasses.dataclass(frozen=True)
class Table:
    """Headings with their better direction, and lines."""

    head: Sequence[tuple[str, str]]
    rows: Sequence[Row]

    def __bool__(self) -> bool:
        return bool(self.rows)


def main_table(summary: Mapping[str, Any]) -> Table:
    """Every method on the metrics of the whole picture."""
    means, (psnr, *others) = summary["means"], summary["metrics"]
    metrics = [psnr, "psnr_person", *others]
    body = [_row(summary, split, method, metrics) for split, method, _ in rows(means)]
    return Table([_heading(name) for name in metrics], body)


def region_tables(summary: Mapping[str, Any]) -> dict[str, Table]:
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


def likeness_table(summary: Mapping[str, Any]) -> Table:
    """Flicker, and whose face it is where that was asked for."""
    return _some(summary, [name for name in LIKENESS if name in summary["further_metrics"]])


def composite_table(summary: Mapping[str, Any]) -> Table:
    """The avatar's PSNR on held-out frames under every composite: what the protocol's choices are worth."""
    held_out = summary["means"].get(HELD_OUT, {})
    known = [name for name in _COMPOSITES if held_out.get(AVATAR, {}).get(name) is not None]
    used = "psnr_{background}_{render_mask}".format(**summary["choices"])
    methods = [method for method in (AVATAR, REFINED) if method in held_out]
    body = []
    for name in known:
        cells = [dataclasses.replace(_cell(summary, HELD_OUT, one, name), best=False) for one in methods]
        body.append(Row(_COMPOSITES[name], cells, name == used))
    heads = {AVATAR: "PSNR", REFINED: "PSNR, test poses refined"}
    return Table([(heads[method], "↑") for method in methods], body)


def camera_table(summary: Mapping[str, Any]) -> Table:
    """The avatar and the textured mesh in cameras that the training frames do not have."""
    metrics = ("psnr", "psnr_person", "psnr_seen", "psnr_unseen", "unseen_share", "ssim")
    known = [name for name in metrics if any(name in row for row in _camera_rows(summary).values())]
    body = []
    for (view, method), means in _camera_rows(summary).items():
        cells = [Cell(number(name, means[name])) if name in means else Cell("") for name in known]
        body.append(Row(f"{view}: {_METHOD_LABELS[method]}", cells, method == AVATAR))
    heads = {
        "psnr_seen": ("PSNR seen surface", "↑"),
        "psnr_unseen": ("PSNR never-seen surface", "↑"),
        "unseen_share": ("never seen, share", ""),
    }
    return Table([heads.get(name, (label(name), "↑")) for name in known], body)


def _camera_rows(summary: Mapping[str, Any]) -> dict[tuple[str, str], Mapping[str, float | None]]:
    found = {}
    for view, table in summary["cameras"].items():
        split = VIEWS if VIEWS in table else HELD_OUT
        for method in (AVATAR, MESH):
            if method in table.get(split, {}):
                name = "cameras of the rig that training never had" if view == OTHER_CAMERA else view
                found[name, method] = table[split][method]
    return found


def _some(summary: Mapping[str, Any], metrics: Sequence[str]) -> Table:
    """The methods that were measured in any of some metrics."""
    body = []
    for split, method, row in rows(summary["means"]):
        if method != CEILING and any(row.get(name) is not None for name in metrics):
            body.append(_row(summary, split, method, metrics))
    return Table([_heading(name) for name in metrics], body)


def _row(summary: Mapping[str, Any], split: str, method: str, metrics: Sequence[str]) -> Row:
    cells = [_cell(summary, split, method, name) for name in metrics]
    return Row(LABELS[split, method], cells, (split, method) == (HELD_OUT, AVATAR))


def _cell(summary: Mapping[str, Any], split: str, method: str, metric: str) -> Cell:
    row = summary["means"][split][method]
    if metric not in row:
        return Cell("")
    value = row[metric]
    ends = summary["intervals"].get(split, {}).get(method, {}).get(metric)
    span = (
        f"{number(metric, ends[0])} to {number(metric, ends[1])}"
        if ends is not None and value is not None
        else ""
    )
    return Cell(number(metric, value), span, split == HELD_OUT and best(summary["means"], metric) == method)


def _heading(metric: str) -> tuple[str, str]:
    return label(metric), "↓" if lower_is_better(metric) else "↑"
