"""A study's plots. Points carry the numbers of the table's rows, so that a plot is read beside it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREY, INK = "#2f6fb3", "#c8641b", "#9aa3ab", "#22262a"
LINES = ("#2f6fb3", "#c8641b", "#3f8f5f", "#8a5bb5", "#b5493f", "#6b7a86", "#b08a1e", "#2a9aa6")
SIZE = (5.4, 4.2)  # inches: text stays legible on a phone
DPI = 170
REACH = 6.0  # times the dearest point, as far as a mark is drawn


@dataclasses.dataclass(frozen=True)
class Dot:
    """A point of a scatter plot.

    Attributes:
        number: of its row in the table.
        x, y: what is plotted; left out where one is not finite.
        on_frontier: whether nothing beats it.
        base: whether it is the study's own settings.
        preset: the preset that it is; empty if none.
    """

    number: int
    x: float
    y: float
    on_frontier: bool = False
    base: bool = False
    preset: str = ""


@dataclasses.dataclass(frozen=True)
class Axis:
    """What is plotted.

    Attributes:
        label: with its unit.
        log: whether it is logarithmic.
    """

    label: str
    log: bool = False


def scatter(
    path: Path, dots: Sequence[Dot], across: Axis, up: Axis, marks: Mapping[str, float] | None = None
) -> None:
    """Points with their numbers, the frontier joined, presets marked.

    Args:
        path: the PNG.
        dots: the points.
        across, up: the axes.
        marks: preset -> where it would lie across, of those whose quality is not known; if near.
    """
    known = [dot for dot in dots if math.isfinite(dot.x) and math.isfinite(dot.y)]
    figure, axes = _figure(across, up)
    for dot in known:
        axes.plot(dot.x, dot.y, **_style(dot))
    edge = sorted((dot for dot in known if dot.on_frontier), key=lambda dot: dot.x)
    axes.plot([dot.x for dot in edge], [dot.y for dot in edge], color=BLUE, linewidth=1.4, zorder=2)
    farthest = REACH * max((dot.x for dot in known), default=0.0)
    for name, x in (marks or {}).items():
        if x > farthest:
            continue
        axes.axvline(x, color=ORANGE, linewidth=1, linestyle=(0, (4, 3)), zorder=1)
        axes.text(x, 0.02, f" {name}", color=ORANGE, fontsize=8, rotation=90, transform=_mixed(axes))
    _ticks(axes, across, up, known)
    _numbers(axes, known)
    _legend(axes, known)
    _save(figure, path)


def _style(dot: Dot) -> dict:
    if dot.preset:
        return {"marker": "*", "markersize": 13, "color": ORANGE, "linestyle": "none", "zorder": 5}
    if dot.base:
        return {"marker": "D", "markersize": 7, "color": INK, "linestyle": "none", "zorder": 4}
    color = BLUE if dot.on_frontier else GREY
    return {"marker": "o", "markersize": 5.5, "color": color, "linestyle": "none", "zorder": 3}


def _numbers(axes: Axes, dots: Sequence[Dot]) -> None:
    """Each dot's number beside it, where it hides neither another's nor a dot, as far as that can be had."""
    axes.figure.canvas.draw()
    place = axes.transData.transform
    spots = [tuple(place((dot.x, dot.y))) for dot in dots]
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in spots]
    scale = axes.figure.dpi / 72
    for dot, (x, y) in sorted(zip(dots, spots, strict=True), key=lambda pair: not pair[0].on_frontier):
        width, height = 5.2 * scale * len(str(dot.number)), 8 * scale
        room = (7 if dot.base or dot.preset else 5) * scale
        best = min(
            _around(x, y, width, height, room), key=lambda box: sum(_overlap(box, one) for one in taken)
        )
        taken.append(best)
        color = BLUE if dot.on_frontier else "#6b747c"
        weight = "bold" if dot.on_frontier else "normal"
        axes.annotate(
            str(dot.number),
            tuple(axes.transData.inverted().transform((best[0], best[1]))),
            color=color,
            fontsize=8,
            fontweight=weight,
            zorder=6,
        )


Box = tuple[float, float, float, float]


def _around(x: float, y: float, width: float, height: float, gap: float) -> list[Box]:
    """Boxes for a label around a spot: right, left, above, below, and the corners."""
    corners = [
        (x + gap, y - height / 2),
        (x - gap - width, y - height / 2),
        (x - width / 2, y + gap),
        (x - width / 2, y - gap - height),
        (x + gap, y + gap),
        (x + gap, y - gap - height),
        (x - gap - width, y + gap),
        (x - gap - width, y - gap - height),
    ]
    return [(left, low, left + width, low + height) for left, low in corners]


def _overlap(one: Box, other: Box) -> float:
    across = min(one[2], other[2]) - max(one[0], other[0])
    up = min(one[3], other[3]) - max(one[1], other[1])
    return max(0.0, across) * max(0.0, up)


def _legend(axes: Axes, dots: Sequence[Dot]) -> None:
    from matplotlib.lines import Line2D

    entries = [Line2D([], [], marker="o", color=BLUE, linewidth=1.4, markersize=5.5, label="frontier")]
    if not all(dot.on_frontier for dot in dots):
        entries.append(
            Line2D([], [], marker="o", color=GREY, linestyle="none", markersize=5.5, label="beaten")
        )
    if any(dot.base and not dot.preset for dot in dots):
        entries.append(Line2D([], [], marker="D", color=INK, linestyle="none", markersize=7, label="base"))
    for dot in dots:
        if dot.preset:
            label = f"preset {dot.preset}"
            entries.append(
                Line2D([], [], marker="*", color=ORANGE, linestyle="none", markersize=12, label=label)
            )
    axes.figure.legend(
        handles=entries, loc="outside lower center", ncols=min(4, len(entries)), frameon=False, fontsize=8.5
    )


def curves(path: Path, lines: Mapping[str, Sequence[tuple[float, float]]], across: Axis, up: Axis) -> None:
    """Lines in one plot; up to eight in colours with their names, the rest grey.

    Args:
        path: the PNG.
        lines: name -> points; the first ones stand out.
        across, up: the axes.
    """
    figure, axes = _figure(across, up)
    shown = {name: line for name, line in lines.items() if line}
    for place, (name, line) in enumerate(reversed(shown.items())):
        place = len(shown) - 1 - place  # the first on top of the others
        first = place < len(LINES)
        xs, ys = zip(*line, strict=True)
        axes.plot(
            xs,
            ys,
            color=LINES[place] if first else GREY,
            alpha=1 if first else 0.55,
            linewidth=1.7 if first else 0.9,
            marker="o",
            markersize=3 if first else 1.8,
            label=name if first else None,
            zorder=3 if first else 2,
        )
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(
            handles[::-1], labels[::-1], loc="outside lower center", ncols=2, frameon=False, fontsize=7.5
        )
    _ticks(axes, across, up, [Dot(0, x, y) for line in shown.values() for x, y in line])
    _save(figure, path)


def bars(
    path: Path,
    values: Mapping[str, float],
    label: str,
    noise: float = math.nan,
    higher_is_better: bool = True,
) -> None:
    """Horizontal bars around zero, what lies within chance shaded; losses in another colour than gains.

    Args:
        path: the PNG.
        values: name -> value, top down; those that are not finite are left out.
        label: of the axis.
        noise: how large a value must be to mean anything; NaN where that is not known.
        higher_is_better: whether a value above zero is a gain.
    """
    known = {name: value for name, value in values.items() if math.isfinite(value)}
    figure, axes = _figure(Axis(label), Axis(""), (SIZE[0], 0.9 + 0.36 * max(3, len(known))))
    names = list(known)[::-1]
    colors = [ORANGE if (known[name] < 0) == higher_is_better else BLUE for name in names]
    axes.barh(range(len(names)), [known[name] for name in names], color=colors, height=0.62, zorder=3)
    axes.set_yticks(range(len(names)), names, fontsize=8.5)
    axes.axvline(0, color=INK, linewidth=0.8, zorder=4)
    if math.isfinite(noise):
        axes.axvspan(-abs(noise), abs(noise), color=GREY, alpha=0.3, zorder=1)
    for place, name in enumerate(names):
        text = f"{round(known[name], 2) + 0.0:+.2f}"
        side = "left" if known[name] >= 0 else "right"
        axes.annotate(
            text,
            (known[name], place),
            xytext=(3 if side == "left" else -3, 0),
            textcoords="offset points",
            ha=side,
            va="center",
            fontsize=8,
            color=INK,
        )
    axes.margins(x=0.18)
    _save(figure, path)


def _figure(across: Axis, up: Axis, size: tuple[float, float] = SIZE) -> tuple[Figure, Axes]:
    # Slow to import, and only plots need it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_xlabel(across.label, fontsize=9.5)
    axes.set_ylabel(up.label, fontsize=9.5)
    axes.tick_params(labelsize=8.5)
    axes.grid(color=GREY, alpha=0.3, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def _ticks(axes: Axes, across: Axis, up: Axis, dots: Sequence[Dot]) -> None:
    """Logarithmic axes with plain numbers on them, of which there are enough to read."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

    for axis, about, values in (
        (axes.xaxis, across, [dot.x for dot in dots]),
        (axes.yaxis, up, [dot.y for dot in dots]),
    ):
        if not about.log or not values or min(values) <= 0:
            continue
        (axes.set_xscale if axis is axes.xaxis else axes.set_yscale)("log")
        axis.set_major_locator(FixedLocator(plain_ticks(*axis.get_view_interval())))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        axis.set_minor_formatter(NullFormatter())


def plain_ticks(low: float, high: float, most: int = 7) -> list[float]:
    """Round numbers in a range for a logarithmic axis: as many as fit, the roundest first."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ladders = ((1, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9), (1, 1.5, 2, 3, 4, 6, 8), (1, 2, 3, 5), (1, 3), (1,))
    ticks: list[float] = []
    for ladder in ladders:
        ticks = [step * 10.0**decade for decade in decades for step in ladder]
        ticks = [tick for tick in ticks if low <= tick <= high]
        if len(ticks) <= most:
            break
    return ticks


def _mixed(axes: Axes):
    from matplotlib.transforms import blended_transform_factory

    return blended_transform_factory(axes.transData, axes.transAxes)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, metadata={"Software": None})
