"""A study's tables: numbers in a data frame, shown as Markdown, LaTeX and HTML cells, kept as Parquet."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import pandas as pd

HERE, PAPER = "here", "paper"
MEAN = "mean"  # in place of a subject, for a mean over subjects
NOTHING = "–"
NOTE, MAIN = "note", "main"  # further columns of a table's rows


@dataclasses.dataclass(frozen=True)
class Column:
    """A number of each row.

    Attributes:
        key: its name in Parquet.
        label: of the head, plain text.
        digits: after the point.
        better: ``higher``, ``lower``, or empty where neither is.
        factor: what it is shown times.
        source: ``here``, or ``paper`` for the figures that it published.
    """

    key: str
    label: str
    digits: int = 2
    better: str = ""
    factor: float = 1.0
    source: str = HERE

    @property
    def name(self) -> str:
        """The column's name in a table's rows."""
        return self.key if self.source == HERE else f"{self.source} {self.key}"

    @property
    def head(self) -> str:
        """The label with its arrow, and with the source where that is the paper."""
        arrow = {"higher": " ↑", "lower": " ↓"}.get(self.better, "")
        return f"{'paper: ' if self.source == PAPER else ''}{self.label}{arrow}"

    def text(self, value: float) -> str:
        """A number as it is shown."""
        return f"{self.factor * value:,.{self.digits}f}" if math.isfinite(value) else NOTHING

    def best(self, values: pd.Series) -> str | None:
        """The best number's text, for what looks equal is equally good; None if neither end is better."""
        if not self.better or values.count() < 2:
            return None
        return self.text(values.max() if self.better == "higher" else values.min())


@dataclasses.dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: in Parquet and in LaTeX's label.
        title: above it.
        caption: below it: sizes, and how it was measured.
        columns: in their order.
        rows: indexed by label, with a column for each of ``columns`` by its name, and optionally ``note``
            (text beside a row) and ``main`` (whether it stands out).
        first: the head of the rows' labels.
    """

    name: str
    title: str
    caption: str
    columns: Sequence[Column]
    rows: pd.DataFrame
    first: str = "variant"

    @property
    def numbers(self) -> pd.DataFrame:
        """The rows' numbers, NaN where there is none."""
        return self.rows.reindex(columns=[column.name for column in self.columns]).astype(float)

    @property
    def texts(self) -> pd.DataFrame:
        """The numbers as they are shown, under their heads."""
        return pd.DataFrame({c.head: self.numbers[c.name].map(c.text) for c in self.columns}, self.rows.index)

    @property
    def best(self) -> pd.DataFrame:
        """Whether each number is its column's best; of the shape of ``texts``."""
        return pd.DataFrame(
            {c.head: self.texts[c.head] == c.best(self.numbers[c.name]) for c in self.columns}
        )

    @property
    def notes(self) -> list[str]:
        """A note a row, empty where there is none."""
        return self.rows[NOTE].fillna("").tolist() if NOTE in self.rows else [""] * len(self.rows)

    @property
    def main(self) -> list[bool]:
        """Whether each row stands out."""
        return self.rows[MAIN].eq(True).tolist() if MAIN in self.rows else [False] * len(self.rows)

    def values(self, subject: str) -> pd.DataFrame:
        """A row a finite number: ``table``, ``row``, ``subject``, ``metric``, ``source``, ``value``."""
        found = [
            (self.name, label, subject if c.source == HERE else MEAN, c.key, c.source, value)
            for label, numbers in self.numbers.iterrows()
            for c, value in zip(self.columns, numbers, strict=True)
            if math.isfinite(value)
        ]
        return pd.DataFrame(found, columns=["table", "row", "subject", "metric", "source", "value"])


def markdown(table: Table) -> str:
    """The table as GitHub's Markdown, title and caption first."""
    shown = table.texts.where(~table.best, "**" + table.texts + "**")
    shown.insert(
        0, table.first, [f"**{x}**" if m else x for x, m in zip(shown.index, table.main, strict=True)]
    )
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
    texts = texts.map(_in_a_cell).rename(columns=_in_a_cell)
    align = ["left" if place == 0 or name == NOTE else numbers for place, name in enumerate(texts)]
    return texts.to_markdown(index=False, disable_numparse=True, colalign=align)


def _in_a_cell(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")


LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "×": r"$\times$",
    "–": "--", "²": "$^2$", "\n": " ",
})  # fmt: skip
"""The letters that LaTeX would take for something else, and those that its standard fonts lack."""


def latex(table: Table) -> str:
    """The table for LaTeX with booktabs; notes stand below it."""
    bold = "textbf:--rwrap;"
    shown = table.texts.map(lambda text: text.translate(LATEX))
    shown = shown.rename(
        columns=lambda head: head.translate(LATEX), index=lambda label: label.translate(LATEX)
    )
    best = pd.DataFrame(table.best.to_numpy(), shown.index, shown.columns)
    styled = shown.style.apply(lambda _: best.map({True: bold, False: ""}.get), axis=None)
    styled = styled.apply_index(lambda _: [bold if main else "" for main in table.main])
    text = styled.to_latex(
        hrules=True,
        position="t",
        position_float="centering",
        column_format="l" + "r" * len(table.columns),
        caption=f"{table.title}. {table.caption}".translate(LATEX),
        label=f"tab:{table.name}",
    )
    notes = [
        rf"\par\smallskip {{\footnotesize {f'{label}: {note}'.translate(LATEX)}.}}"
        for label, note in zip(table.rows.index, table.notes, strict=True)
        if note
    ]
    end = r"\end{table}"
    return text.replace(end, "\n".join([*notes, end]))
