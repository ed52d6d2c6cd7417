"""Plots of the curves of fit and train and of the visibility scores, which suit light and dark pages."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipeline.clip.curves import CurvePoints

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PSNR = "psnr"
_NO_LOSS = (_PSNR, "gaussians", "learning_rate")
_IMAGE_TERMS = {"l1": "L1", "ssim": "SSIM"}
_INK = "#808080"  # legible on white and on near-black
_COLORS = ("#3b82c4", "#d07f2c", "#5a9e6f")


def plot_training(lines: Mapping[str, CurvePoints]) -> list[str]:
    """Held-out PSNR and the loss terms against iterations, an SVG element each; none without lines.

    The same lines give the same text. Every loss term but L1 and SSIM is part of the regularisers.
    """
    losses = _loss_lines(lines)
    held_out = {"held out": lines[_PSNR]} if lines.get(_PSNR) else {}
    return [_plot(title, group) for title, group in (("PSNR, dB", held_out), ("loss", losses)) if group]


def plot_registration(lines: Mapping[str, CurvePoints], seconds: Mapping[int, float]) -> list[str]:
    """The registration's reprojection error against seconds, an SVG; none without both.

    Args:
        lines: fit's curve.
        seconds: iteration -> seconds since its start, as recorded beside it.
    """
    pixels = [(seconds[step], value) for step, value in lines.get("pixels", []) if step in seconds]
    return [_plot("reprojection error, px", {"all trusted points": pixels}, "seconds")] if pixels else []


def _loss_lines(lines: Mapping[str, CurvePoints]) -> dict[str, CurvePoints]:
    """L1, SSIM, and everything else of the objective added up."""
    found = {label: lines[name] for name, label in _IMAGE_TERMS.items() if lines.get(name)}
    rest: dict[int, float] = {}
    for name, line in lines.items():
        if name not in _IMAGE_TERMS and name not in _NO_LOSS:
            for iteration, value in line:
                rest[iteration] = rest.get(iteration, 0.0) + value
    return {**found, "regularisers": sorted(rest.items())} if rest else found


def plot_visibility(scores: np.ndarray, tau: float) -> list[str]:
    """The histogram of visibility scores with the gate's threshold on it, an SVG; none without scores.

    Args:
        scores: [V] in [0, 1].
        tau: the threshold; 0 for none.
    """
    if not scores.any():
        return []
    counts, edges = np.histogram(scores, np.linspace(0, 1, 65))
    steps = [(float(edge), float(count)) for edge, count in zip(edges, counts, strict=False)]
    group = {"body vertices": [*steps, (1.0, float(counts[-1]))]}
    if tau:
        group[f"tau* = {tau:.2f}"] = [(tau, 0.8), (tau, float(counts.max()))]
    return [_plot("how often each vertex is seen", group, "score")]


def _plot(title: str, group: Mapping[str, Sequence[tuple[float, float]]], across: str = "iteration") -> str:
    # Slow to import, and only this function draws.
    import matplotlib
    from matplotlib.figure import Figure

    # Without a salt every drawing has ids of its own, and equal runs would differ.
    with matplotlib.rc_context({"svg.hashsalt": f"flexiavatar {title}", "font.size": 9}):
        figure = Figure(figsize=(4.6, 2.9), layout="constrained")
        _fill(figure.add_subplot(), title, group, across)
        text = io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]


def _fill(axes: Axes, title: str, group: Mapping[str, Sequence[tuple[float, float]]], across: str) -> None:
    from matplotlib.ticker import MaxNLocator

    for color, (label, line) in zip(_COLORS, group.items(), strict=False):
        places, values = zip(*line, strict=True)
        if across == "score":
            style = "steps-post" if label == "body vertices" else "default"
            axes.plot(places, np.maximum(values, 0.8), color=color, drawstyle=style, label=label)
            continue
        axes.plot(places, values, color=color, linewidth=1.8, marker="o", markersize=3, label=label)
    if title == "loss" and all(value > 0 for line in group.values() for _, value in line):
        axes.set_yscale("log")
    if across == "score":
        axes.set_yscale("log")
    axes.set_title(title, loc="left", color=_INK, fontsize=10)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=across != "score"))
    axes.set_xlabel(across, color=_INK)
    axes.tick_params(which="both", colors=_INK)
    axes.grid(color=_INK, alpha=0.25, linewidth=0.6)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(_INK)
    axes.legend(frameon=False, labelcolor=_INK)
