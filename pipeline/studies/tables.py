"""A study's tables: one description, as Markdown, LaTeX, HTML cells and Parquet."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.tables import write_table

SCHEMA = pa.schema(
    [
        ("table", pa.string()),
        ("row", pa.string()),
        ("subject", pa.string()),
        ("metric", pa.string()),
        ("source", pa.string()),
        ("value", pa.float64()),
    ]
)
"""A value a row; ``subject`` is ``mean`` for a mean over subjects; ``source`` is ``here`` or ``paper``."""

HERE, PAPER = "here", "paper"
MEAN = "mean"
NOTHING = "–"


@dataclasses.dataclass(frozen=True)
class Column:
    """A number of each row.

    Attributes:
        key: its name in a row and in Parquet.
        label: of the head, plain text.
        digits: after the point.
        better: ``higher``, ``lower``, or empty where neither is.
        factor: what it is shown times.
        source: ``here`` or ``paper``.
    """

    key: str
    label: str
    digits: int = 2
    better: str = ""
    factor: float = 1.0
    source: str = HERE

    @property
    def head(self) -> str:
        """The label with its arrow, and with the source where that is the paper."""
        arrow = {"higher": " ↑", "lower": " ↓"}.get(self.better, "")
        return f"{'paper: ' if self.source == PAPER else ''}{self.label}{arrow}"

    def cell(self, value: float | None) -> str:
        """A number as text."""
        if value is None or not math.isfinite(value):
            return NOTHING
        return f"{self.factor * value:,.{self.digits}f}"


@dataclasses.dataclass(frozen=True)
class Row:
    """A line.

    Attributes:
        label: what it is of.
        values: by the column's key and source.
        note: what must be said of it; empty where nothing must.
        main: whether it stands out.
    """

    label: str
    values: Mapping[tuple[str, str], float]
    note: str = ""
    main: bool = False


@dataclasses.dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: for Parquet and for LaTeX's label.
        title: above it.
        caption: below it: sizes, and how it was measured.
        columns: in their order.
        rows: in their order.
        first: the head of the rows' labels.
        notes: whether there is a last column with the rows' notes.
    """

    name: str
    title: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    first: str = "variant"
    notes: bool = True

    @property
    def noted(self) -> bool:
        """Whether any row has a note to show."""
        return self.notes and any(row.note for row in self.rows)

    def best(self, column: Column) -> str | None:
        """The cell's text of the best row; None where neither end is better, or only one row has a number.

        By its text, so that what looks equal is equally good.
        """
        known = [row.values.get((column.key, column.source), math.nan) for row in self.rows]
        known = [value for value in known if math.isfinite(value)]
        if not column.better or len(known) < 2:
            return None
        return column.cell(max(known) if column.better == "higher" else min(known))

    def cells(self, row: Row) -> list[tuple[str, bool]]:
        """The texts of a row's numbers, each with whether it is its column's best."""
        texts = [column.cell(row.values.get((column.key, column.source))) for column in self.columns]
        return [(text, text == self.best(column)) for text, column in zip(texts, self.columns, strict=True)]


def markdown(table: Table) -> str:
    """The table as GitHub's Markdown, caption first."""
    heads = [table.first, *(column.head for column in table.columns), *(["note"] if table.noted else [])]
    lines = [f"### {table.title}", "", table.caption, ""] if table.caption else [f"### {table.title}", ""]
    lines.append(f"| {' | '.join(_pipe(head) for head in heads)} |")
    lines.append("|---|" + "---:|" * len(table.columns) + ("---|" if table.noted else ""))
    for row in table.rows:
        cells = [f"**{text}**" if best else text for text, best in table.cells(row)]
        label = f"**{_pipe(row.label)}**" if row.main else _pipe(row.label)
        lines.append(f"| {' | '.join([label, *cells, *([_pipe(row.note)] if table.noted else [])])} |")
    return "\n".join(lines) + "\n"


def _pipe(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")


ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "×": r"$\times$",
    "–": "--", "²": "$^2$", "\n": " ",
}  # fmt: skip
"""What LaTeX would take for something else, and what its standard fonts lack."""


def escaped(text: str) -> str:
    """Plain text for LaTeX."""
    return "".join(ESCAPES.get(letter, letter) for letter in text)


def latex(table: Table) -> str:
    """The table for LaTeX with booktabs; the caption has its notes."""
    heads = [table.first.capitalize(), *(column.head for column in table.columns)]
    lines = [
        r"\begin{table}[t]",
        r"\centering",
        rf"\caption{{{escaped(' '.join(filter(None, (table.title + '.', table.caption))))}}}",
        rf"\label{{tab:{table.name}}}",
        rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"\toprule",
        " & ".join(escaped(head) for head in heads) + r" \\",
        r"\midrule",
    ]
    for row in table.rows:
        cells = [rf"\textbf{{{escaped(text)}}}" if best else escaped(text) for text, best in table.cells(row)]
        label = rf"\textbf{{{escaped(row.label)}}}" if row.main else escaped(row.label)
        lines.append(" & ".join([label, *cells]) + r" \\")
    notes = [
        rf"\par\smallskip {{\footnotesize {escaped(row.label)}: {escaped(row.note)}.}}"
        for row in table.rows
        if table.notes and row.note
    ]
    lines += [r"\bottomrule", r"\end{tabular}", *notes, r"\end{table}"]
    return "\n".join(lines) + "\n"


@dataclasses.dataclass(frozen=True)
class Value:
    """A line of the Parquet file; see ``SCHEMA``."""

    table: str
    row: str
    subject: str
    metric: str
    source: str
    value: float


def values_of(table: Table, subject: str) -> list[Value]:
    """Every number of a table."""
    return [
        Value(
            table.name,
            row.label,
            subject if column.source == HERE else MEAN,
            column.key,
            column.source,
            value,
        )
        for row in table.rows
        for column in table.columns
        if math.isfinite(value := row.values.get((column.key, column.source), math.nan))
    ]


def write_values(path: Path, values: Sequence[Value]) -> None:
    """Writes the Parquet file."""
    columns = {
        name: np.array([getattr(one, name) for one in values], float if name == "value" else object)
        for name in SCHEMA.names
    }
    write_table(path, SCHEMA, columns)
