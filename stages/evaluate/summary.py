"""The result on one screen of the terminal, and how the tables name and round what they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline.metrics import EROSION
from stages.evaluate.refinement import Refinement
from stages.evaluate.scoring import AVATAR, HELD_OUT, MEAN, NEAREST, REFINED, TRAINING

Means = Mapping[str, Mapping[str, Mapping[str, float | None]]]
"""split -> method -> metric -> mean, see :func:`stages.evaluate.scoring.table`."""

LABELS = {
    (HELD_OUT, AVATAR): "avatar",
    (HELD_OUT, REFINED): "avatar, test poses refined",
    (HELD_OUT, MEAN): "mean training frame",
    (HELD_OUT, NEAREST): "nearest training frame",
    (TRAINING, AVATAR): "avatar, frames it was trained on",
}
"""(split, method) -> the row's name, in the order of the tables."""

METRIC_LABELS = {
    "psnr": "PSNR",
    "psnr_interior": "PSNR inside",
    "ssim": "SSIM",
    "lpips_alex": "LPIPS (Alex)",
    "lpips_vgg": "LPIPS (VGG)",
}

_DECIMALS = {"psnr": 2, "psnr_interior": 2}  # all others: 4


def show_summary(summary: Mapping[str, Any], report: str, console: Console | None = None) -> None:
    """Prints the result; the last line is the report's path.

    Args:
        summary: what ``summary.json`` holds.
        report: where the report will be found.
        console: standard output if None. On anything but a terminal it prints plain text.
    """
    console = console or Console()
    # Wide enough for the table wherever the output goes: a log file has no width of its own.
    console = console if console.is_terminal else Console(file=console.file, width=100, color_system=None)
    frames = summary["frames"]
    counts = f"{frames['train']} frames learnt from, {frames['test']} held out, on {summary['background']}"
    console.print(f"{summary['subject']}: {summary['gaussians']} Gaussians, {counts}", highlight=False)
    arrows = ("", "") if console.options.ascii_only else (" ↓", " ↑")
    console.print(_table(summary["means"], summary["metrics"], arrows))
    # soft_wrap: a path that is cut in two cannot be clicked or copied.
    console.print(f"report: {report}", soft_wrap=True, highlight=False, markup=False)


def protocol(background: str, refinement: Refinement) -> str:
    """What the numbers were measured on, for tables and for ``summary.json``."""
    text = (
        f"The person is composited on {background}, in every picture alike, and compared over the whole "
        "image at the stored size; each number is a mean over frames. PSNR is in dB; inside is within the "
        f"mask (alpha above 0.5) eroded by {EROSION} px, on black whatever the rest is on."
    )
    if not refinement.poses:
        return text
    return (
        f"{text} Test poses refined: rotation, expression and translation of each held-out frame were fitted "
        f"to that frame itself ({refinement.steps} steps), all else fixed; the row without it is at the pose "
        "of the fit."
    )


def rows(means: Means) -> list[tuple[str, str, Mapping[str, float | None]]]:
    """(split, method, metric -> mean) of what was scored, in the order of ``LABELS``."""
    scored = [(split, method) for split, method in LABELS if method in means.get(split, {})]
    return [(split, method, means[split][method]) for split, method in scored]


def number(metric: str, value: float | None) -> str:
    """A mean as the tables show it."""
    return "n/a" if value is None else f"{value:.{_DECIMALS.get(metric, 4)}f}"


def lower_is_better(metric: str) -> bool:
    """Whether a smaller value means more alike."""
    return metric.startswith("lpips")


def best(means: Means, metric: str) -> str | None:
    """The method that does best on the held-out frames; None where nothing is scored."""
    found = [(row[metric], method) for method, row in means.get(HELD_OUT, {}).items()]
    values = [(value, method) for value, method in found if value is not None]
    return (min if lower_is_better(metric) else max)(values)[1] if values else None


def _table(means: Means, metrics: Sequence[str], arrows: tuple[str, str]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("")
    for metric in metrics:
        table.add_column(METRIC_LABELS[metric] + arrows[not lower_is_better(metric)], justify="right")
    winners = {metric: best(means, metric) for metric in metrics}
    for split, method, row in rows(means):
        cells = []
        for metric in metrics:
            text = number(metric, row[metric])
            cells.append(f"[bold]{text}[/bold]" if split == HELD_OUT and winners[metric] == method else text)
        table.add_row(LABELS[split, method], *cells)
    return table
