"""The result on one screen of the terminal, and how the tables name and round what they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline.metrics import EROSION
from pipeline.protocols import PROTOCOLS, TRUTH, Protocol
from stages.evaluate.refinement import Refinement
from stages.evaluate.scoring import AVATAR, CEILING, HELD_OUT, MEAN, MESH, NEAREST, REFINED, TRAINING

Means = Mapping[str, Mapping[str, Mapping[str, float | None]]]
"""split -> method -> metric -> mean, see :func:`stages.evaluate.scoring.table`."""

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
}

_DECIMALS = {"ssim": 4, "identity_cosine": 3, "identity_distance": 3}  # all others: 2


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


def protocol(choices: Protocol, refinement: Refinement, name: str = "") -> str:
    """What the numbers were measured on, for tables and for ``summary.json``.

    Args:
        choices: what was chosen.
        refinement: of the test poses.
        name: of the protocol.
    """
    return " ".join(
        part for part in (_named(name, choices), *_composited(choices), _refined(refinement)) if part
    )


def _named(name: str, choices: Protocol) -> str:
    if not name:
        return ""
    changed = "" if PROTOCOLS[name] == choices else ", some of its choices changed"
    return f"Protocol {name}{changed}."


def _composited(choices: Protocol) -> list[str]:
    cut = (
        "No more is left of any picture than the truth's mask holds: what the avatar draws beyond it counts "
        "for nothing."
        if choices.render_mask == TRUTH
        else "The truth is cut out by its mask, the avatar by its own alpha."
    )
    return [
        f"The person is composited on {choices.background}, in every picture alike, and compared over the "
        "whole image at the stored size; each number is a mean over frames.",
        cut,
        "PSNR is in dB; person is the mask (alpha above 0.5), inside the mask eroded by "
        f"{EROSION} px, both on black whatever the rest is on.",
    ]


def _refined(refinement: Refinement) -> str:
    if not refinement.poses:
        return ""
    return (
        "Test poses refined: rotation, expression and translation of each held-out frame were fitted "
        f"to that frame itself ({refinement.steps} steps), all else fixed; the row without it is at the pose "
        "of the fit."
    )


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
    """Whether a smaller value means more alike."""
    return metric.startswith("lpips") or metric in ("flicker", "identity_distance")


def best(means: Means, metric: str) -> str | None:
    """The method that does best on the held-out frames, the truth aside; None where nothing is scored."""
    contestants = {method: row for method, row in means.get(HELD_OUT, {}).items() if method != CEILING}
    found = [(row.get(metric), method) for method, row in contestants.items()]
    values = [(value, method) for value, method in found if value is not None]
    return (min if lower_is_better(metric) else max)(values)[1] if values else None


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
