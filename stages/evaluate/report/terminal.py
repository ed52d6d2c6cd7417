"""The result on one screen of the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from stages.evaluate.report.tables import LABELS, best, label, lower_is_better, number, rows
from stages.evaluate.scores import HELD_OUT
from stages.evaluate.statistics import Means


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
    counts += f", protocol {summary['choices']['protocol']}"
    console.print(f"{summary['subject']}: {summary['gaussians']} Gaussians, {counts}", highlight=False)
    arrows = ("", "") if console.options.ascii_only else (" ↓", " ↑")
    console.print(_table(summary["means"], summary["metrics"], arrows))
    for sentence in summary["verdict"]:
        console.print(sentence, highlight=False, markup=False)
    # soft_wrap: a path that is cut in two cannot be clicked or copied.
    console.print(f"report: {report}", soft_wrap=True, highlight=False, markup=False)


def _table(means: Means, metrics: Sequence[str], arrows: tuple[str, str]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("")
    for metric in metrics:
        table.add_column(label(metric) + arrows[not lower_is_better(metric)], justify="right")
    winners = {metric: best(means, metric) for metric in metrics}
    for split, method, row in rows(means):
        cells = []
        for metric in metrics:
            text = number(metric, row.get(metric))
            cells.append(f"[bold]{text}[/bold]" if split == HELD_OUT and winners[metric] == method else text)
        table.add_row(LABELS[split, method], *cells)
    return table
