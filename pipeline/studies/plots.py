"""A study's plots. Points carry the numbers of the table's rows, so that a plot is read beside it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd
from adjustText import adjust_text
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator, StrMethodFormatter

BLUE, ORANGE, GREY, INK = "#2f6fb3", "#c8641b", "#9aa3ab", "#22262a"
LINES = ("#2f6fb3", "#c8641b", "#3f8f5f", "#8a5bb5", "#b5493f", "#6b7a86", "#b08a1e", "#2a9aa6")
SIZE = (5.4, 4.2)  # inches: text stays legible on a phone
REACH = 6.0  # times the dearest point, as far as a preset that was not run is drawn
MARKS: Mapping[str, Mapping] = {
    "beaten": {"marker": "o", "markersize": 5.5, "color": GREY, "zorder": 3},
    "frontier": {"marker": "o", "markersize": 5.5, "color": BLUE, "zorder": 3},
    "base": {"marker": "D", "markersize": 7, "color": INK, "zorder": 4},
    "preset": {"marker": "*", "markersize": 13, "color": ORANGE, "zorder": 5},
}
NUMBERS: Mapping[bool, Mapping] = {
    True: {"color": BLUE, "fontsize": 8, "fontweight": "bold", "zorder": 6},
    False: {"color": "#6b747c", "fontsize": 8, "fontweight": "normal", "zorder": 6},
}
"""The letters of a point's number, on the frontier or not."""


def scatter(
    path: Path,
    points: pd.DataFrame,
    frontier: Sequence[int],
    across: str,
    up: str,
    expected: Mapping[str, float] | None = None,
) -> None:
    """Points with their numbers over a logarithmic axis, the frontier joined, presets marked.

    Args:
        path: the PNG.
        points: indexed by the number that is shown, with ``x`` and ``y``, and optionally ``base`` (bool) and
            ``preset`` (a name, or empty); those with a number that is not finite are left out.
        frontier: the numbers of the points that nothing beats.
        across, up: labels of the axes.
        expected: preset -> its place on the x axis, of those whose y is not known; drawn if near.
    """
    points = points[points[["x", "y"]].abs().lt(math.inf).all(axis=1)]
    with _plot(path, across, up) as axes:
        entries = {}
        for number, point in points.iterrows():
            preset, base = point.get("preset") or "", bool(point.get("base"))
            kind = "preset" if preset else "base" if base else "frontier" if number in frontier else "beaten"
            (mark,) = axes.plot(point["x"], point["y"], linestyle="none", **MARKS[kind])
            entries[f"preset {preset}" if preset else kind] = mark
        edge = points[points.index.isin(frontier)].sort_values("x")
        (entries["frontier"],) = axes.plot(edge["x"], edge["y"], color=BLUE, linewidth=1.4, zorder=2)
        for name, x in (expected or {}).items():
            if x <= REACH * points["x"].max():
                axes.axvline(x, color=ORANGE, linewidth=1, linestyle=(0, (4, 3)), zorder=1)
                beside = axes.get_xaxis_transform()  # x in the data's units, y from 0 to 1
                axes.text(x, 0.02, f" {name}", color=ORANGE, fontsize=8, rotation=90, transform=beside)
        if points["x"].min() > 0:
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(FixedLocator(round_ticks(*axes.get_xlim())))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
        axes.figure.legend(
            entries.values(), entries, loc="outside lower center", ncols=4, frameon=False, fontsize=8.5
        )
        assert isinstance(axes.figure, Figure)  # it is no part of another
        axes.figure.draw_without_rendering()  # places the axes, which labels are moved in
        labels = [
            axes.text(point["x"], point["y"], str(number), **NUMBERS[number in frontier])
            for number, point in points.iterrows()
        ]
        if labels:
            places, arrows = (points[name].tolist() for name in "xy"), {"arrowstyle": "-", "color": GREY}
            looks = {"expand": (1.8, 1.9), "arrowprops": {**arrows, "linewidth": 0.6}}
            adjust_text(labels, *places, ax=axes, force_text=(0.3, 0.3), iter_lim=300, **looks)


def curves(path: Path, lines: Mapping[str, Sequence[tuple[float, float]]], across: str, up: str) -> None:
    """Lines; the first eight in colours with their names, the rest grey.

    Args:
        path: the PNG.
        lines: name -> points (x, y); the first ones stand out.
        across, up: labels of the axes.
    """
    shown = {name: line for name, line in lines.items() if line}
    with _plot(path, across, up) as axes:
        for place, (name, line) in enumerate(shown.items()):
            first = place < len(LINES)
            (drawn,) = axes.plot(*zip(*line, strict=True), marker=".", zorder=99 - place)
            drawn.set(color=LINES[place] if first else GREY, linewidth=1.7 if first else 0.9)
            drawn.set_label(name if first else "_")  # a name that the legend leaves out
        if shown:
            axes.figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=7.5)


def bars(path: Path, values: pd.Series, label: str, noise: float, higher_is_better: bool) -> None:
    """Horizontal bars around zero, chance shaded, losses in another colour than gains.

    Args:
        path: the PNG.
        values: by name, top down; those that are not finite are left out.
        label: of the axis.
        noise: how large a value must be to mean anything; NaN where that is not known.
        higher_is_better: whether a value above zero is a gain.
    """
    known = values[values.abs() < math.inf][::-1]
    with _plot(path, label, "", (SIZE[0], 0.9 + 0.36 * max(3, len(known)))) as axes:
        colors = [ORANGE if (value < 0) == higher_is_better else BLUE for value in known]
        drawn = axes.barh(known.index, known, color=colors, height=0.62, zorder=3)
        texts = [f"{round(value, 2) + 0.0:+.2f}" for value in known]
        axes.bar_label(drawn, texts, padding=3, fontsize=8, color=INK)
        axes.axvline(0, color=INK, linewidth=0.8, zorder=4)
        if math.isfinite(noise):
            axes.axvspan(-abs(noise), abs(noise), color=GREY, alpha=0.3, zorder=1)
        axes.margins(x=0.18)


@contextlib.contextmanager
def _plot(path: Path, across: str, up: str, size: tuple[float, float] = SIZE) -> Iterator[Axes]:
    """Empty axes with their labels; what has been drawn on them in the end is saved."""
    figure = Figure(figsize=size, dpi=170, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_xlabel(across, fontsize=9.5)
    axes.set_ylabel(up, fontsize=9.5)
    axes.tick_params(labelsize=8.5)
    axes.grid(color=GREY, alpha=0.3, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    yield axes
    figure.savefig(path, metadata={"Software": None})


def round_ticks(low: float, high: float) -> list[float]:
    """Round numbers in a range for a logarithmic axis: evenly spaced in a short one, else 1, 2, 5, 10, ..."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 5) if len(decades) < 5 else (1,)
    ticks = [step * 10.0**decade for decade in decades for step in steps]
    if high < 5 * low:
        ticks = list(MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(low, high))
    return [tick for tick in ticks if low <= tick <= high]
