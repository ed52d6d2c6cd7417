"""A study's tables: numbers in a data frame, shown as Markdown, LaTeX and HTML cells, kept as Parquet."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping

import pandas as pd

HERE, PAPER = "here", "paper"
MEAN = "mean"  # in place of a subject, for a mean over subjects
NOTE, MAIN = "note", "main"  # columns of a table's rows that are no numbers


@dataclasses.dataclass(frozen=True)
class Metric:
    """A number as tables show it.

    Attributes:
        label: of its column's head, plain text.
        digits: after the point.
        better: ``higher``, ``lower``, or empty where neither is.
        factor: what it is shown times.
    """

    label: str
    digits: int = 2
    better: str = ""
    factor: float = 1.0

    def text(self, value: float) -> str:
        """A number as it is shown."""
        return f"{self.factor * value:,.{self.digits}f}" if math.isfinite(value) else "–"

    def best(self, values: pd.Series) -> pd.Series:
        """Whether each number is the best of two or more; what looks equal is equally good."""
        end = {"higher": values.max(), "lower": values.min()}.get(self.better, math.nan)
        return values.map(self.text).eq(self.text(end)) & values.notna() & (values.count() > 1)


IMAGE = {
    "psnr": Metric("PSNR", 2, "higher"),
    "ssim": Metric("SSIM", 4, "higher"),
    "lpips_alex": Metric("LPIPS×100", 2, "lower", 100.0),
}
METRICS: Mapping[str, Metric] = {
    **IMAGE,
    **{
        f"{key}_{region}": dataclasses.replace(metric, label=f"{region} {metric.label}")
        for region in ("face", "hands")
        for key, metric in IMAGE.items()
    },
    **{f"{PAPER} {key}": dataclasses.replace(m, label=f"{PAPER}: {m.label}") for key, m in IMAGE.items()},
    "gaussians": Metric("Gaussians", 0),
    "asset_mib": Metric("asset MB", 2, "lower"),
    "animation_ms": Metric("animation ms", 1, "lower"),
    "rendering_ms": Metric("rendering ms", 1, "lower"),
    "total_ms": Metric("total ms", 1, "lower"),
    "fps": Metric("frames/s", 1, "higher"),
    "psnr_interior": Metric("inside", 2, "higher"),
    "train_s": Metric("training s", 0, "lower"),
    "times": Metric("× base", 2),
    "gain": Metric("gain dB", 2),
    "whole_s": Metric("whole job s", 0, "lower"),
    "short": Metric("short of frontier dB", 2),
    "seconds": Metric("seconds", 2),
    "pixels": Metric("px", 3, "lower"),
    "millimetres": Metric("mm to the truth", 2, "lower"),
}
"""Key of a number, as Parquet has it -> the way that tables show it; the paper's own has ``paper`` before."""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: in Parquet and in LaTeX's label.
        title: above it.
        caption: below it: sizes, and how it was measured.
        rows: indexed by label; a column for each number, in their order, by its key in ``METRICS``; and
            optionally ``note`` (text beside a row) and ``main`` (whether it stands out).
        first: the head of the rows' labels.
        ranked: whether the best of each column is marked.
    """

    name: str
    title: str
    caption: str
    rows: pd.DataFrame
    first: str = "variant"
    ranked: bool = True

    @property
    def numbers(self) -> pd.DataFrame:
        """The rows' numbers, NaN where there is none."""
        return self.rows.drop(columns=[NOTE, MAIN], errors="ignore").astype(float)

    @functools.cached_property
    def texts(self) -> pd.DataFrame:
        """The numbers as they are shown, under their heads."""
        return pd.DataFrame({self._head(name): c.map(METRICS[name].text) for name, c in self.numbers.items()})

    @functools.cached_property
    def best(self) -> pd.DataFrame:
        """Whether each number is its column's best; of the shape of ``texts``."""
        best = {self._head(name): METRICS[name].best(column) for name, column in self.numbers.items()}
        return pd.DataFrame(best) & self.ranked

    def _head(self, name: str) -> str:
        """A column's label with its arrow."""
        arrows = {"higher": " ↑", "lower": " ↓"} if self.ranked else {}
        return METRICS[name].label + arrows.get(METRICS[name].better, "")

    @property
    def notes(self) -> list[str]:
        """A note a row, empty where there is none."""
        return self.rows.get(NOTE, pd.Series("", self.rows.index)).fillna("").tolist()

    @property
    def main(self) -> list[bool]:
        """Whether each row stands out."""
        return self.rows.get(MAIN, pd.Series(False, self.rows.index)).eq(True).tolist()

    def values(self, subject: str) -> pd.DataFrame:
        """A row a finite number: ``table``, ``row``, ``subject``, ``metric``, ``source``, ``value``."""
        long = self.numbers.rename_axis(index="row", columns="metric").stack().rename("value").reset_index()
        long = long[long["value"].notna()]
        paper = long["metric"].str.startswith(PAPER)
        long["metric"] = long["metric"].str.removeprefix(f"{PAPER} ")
        long["subject"], long["source"] = paper.map({True: MEAN, False: subject}), HERE
        long.loc[paper, "source"] = PAPER
        return long.assign(table=self.name)[["table", "row", "subject", "metric", "source", "value"]]


def markdown(table: Table) -> str:
    """The table as GitHub's Markdown, title and caption first."""
    shown = table.texts.mask(table.best, "**" + table.texts + "**")
    labels = [f"**{label}**" if main else label for label, main in zip(shown.index, table.main, strict=True)]
    shown.insert(0, table.first, labels)
    if any(table.notes):
        shown[NOTE] = table.notes
    above = "\n\n".join(filter(None, (f"### {table.title}", table.caption)))
    return f"{above}\n\n{pipe_table(shown)}\n"


def pipe_table(texts: pd.DataFrame, numbers: str = "right") -> str:
    """Texts as a Markdown table without its index; the first column and notes lie left.

    Args:
        texts: of the cells.
        numbers: where the other columns lie.
    """
    ends = str.maketrans({"\\": "\\\\", "|": "\\|", "\n": " "})  # what would end a cell
    align = ["left" if place == 0 or name == NOTE else numbers for place, name in enumerate(texts)]
    cells = texts.map(lambda text: text.translate(ends)).rename(columns=lambda name: name.translate(ends))
    return cells.to_markdown(index=False, disable_numparse=True, colalign=align)


LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "×": r"$\times$",
    "–": "--", "²": "$^2$", "\n": " ",
})  # fmt: skip
"""The letters that LaTeX would take for something else, and those that its standard fonts lack."""


def escaped(text: str) -> str:
    """A text as LaTeX shows it."""
    return text.translate(LATEX)


def latex(table: Table) -> str:
    """The table for LaTeX with booktabs; notes stand below it."""
    bold = {True: "textbf:--rwrap;", False: ""}
    styled = table.texts.style.format(escaped).format_index(escaped).format_index(escaped, axis=1)
    styled.apply(lambda _: table.best.map(bold.get), axis=None)
    styled.apply_index(lambda _: [bold[main] for main in table.main])
    text = styled.to_latex(
        hrules=True,
        position="t",
        position_float="centering",
        column_format="l" + "r" * len(table.texts.columns),
        caption=escaped(f"{table.title}. {table.caption}"),
        label=f"tab:{table.name}",
    )
    notes = [
        rf"\par\smallskip {{\footnotesize {escaped(f'{label}: {note}')}.}}"
        for label, note in zip(table.rows.index, table.notes, strict=True)
        if note
    ]
    return text.replace(r"\end{table}", "\n".join([*notes, r"\end{table}"]))
