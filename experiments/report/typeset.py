"""Tables of a report as LaTeX (booktabs) and as Markdown, for papers and notes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from experiments.report.page import Cell, Row, Table

LETTER: Final = 3.8  # [pt] mean width of a letter in eight-point type
WIDEST_COLUMN: Final = 300.0  # [pt] of a page in two columns; what is wider spans both

# what LaTeX would take for a command, and what pdflatex has no letter for
_LATEX: Final = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "×": r"$\times$",
    "−": "$-$",
    "–": "--",
    "·": r"$\cdot$",
    "²": "$^2$",
    "Σ": r"$\Sigma$",
    "\u202f": r"\,",
    "<": "$<$",
    ">": "$>$",
}


def latex(tables: Sequence[Table], width: float = 3.5) -> str:
    """Floats of the package booktabs with caption and label, one for each table with rows, to fit a width [in].

    Where a table is too wide, ratios go below their values, and columns into further tabulars of the same float.
    """
    return "\n\n".join(_float(table, 72.0 * width) for table in tables if table.rows)


def _float(table: Table, width: float) -> str:
    name = "table*" if width > WIDEST_COLUMN else "table"
    words = f"{table.head[0]}s, {table.title}" if table.title else table.head[0]
    label = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
    caption = _escaped(" ".join(part for part in (f"{words}.", table.note) if part))
    parts = "\\\\[1ex]\n".join(_tabular(part) for part in _fitting(table, width))
    return "\n".join([
        rf"\begin{{{name}}}",
        r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        rf"\caption{{{caption}}}",
        rf"\label{{tab:{label}}}",
        parts,
        rf"\end{{{name}}}",
    ])  # fmt: skip


def _fitting(table: Table, width: float) -> list[Table]:
    """Tables that fit a width [pt], each with the first column."""
    if sum(_widths(table)) > width:
        table = replace(table, rows=tuple(part for row in table.rows for part in _stacked_rows(row)))
    first, *others = _widths(table)
    groups: list[list[int]] = [[]]
    room = width - first
    for column, wide in enumerate(others, start=1):
        if groups[-1] and wide > room:
            groups.append([])
            room = width - first
        groups[-1].append(column)
        room -= wide
    return [_columns(table, [0, *group]) for group in groups]


def _columns(table: Table, which: Sequence[int]) -> Table:
    rows = (replace(row, cells=tuple(row.cells[k] for k in which)) for row in table.rows)
    return replace(table, head=tuple(table.head[k] for k in which), rows=tuple(row for row in rows if any(row.cells)))


def _stacked_rows(row: Row) -> list[Row]:
    """A row, and a second one with what stood behind its values."""
    name, *cells = row.cells
    behind = ["" if isinstance(cell, str) else cell[1] for cell in cells]
    values = [cell if isinstance(cell, str) else cell[0] for cell in cells]
    return [replace(row, cells=(name, *values)), *([Row(("", *behind))] if any(behind) else [])]


def _widths(table: Table) -> list[float]:
    """About how wide the columns are [pt], in eight-point type."""
    lines = [table.head, *(row.cells for row in table.rows)]
    return [max(len(_text(cell)) for cell in column) * LETTER + 6.0 for column in zip(*lines, strict=True)]


def _tabular(table: Table) -> str:
    columns = "l" * len(table.head) if table.words else "l" + "r" * (len(table.head) - 1)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", _latex_row(table.head), r"\midrule"]
    for k, row in enumerate(table.rows):
        if row.sum and k and not table.rows[k - 1].sum:
            lines.append(r"\midrule")
        lines.append(_latex_row(row.cells))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _latex_row(cells: Sequence[Cell]) -> str:
    return " & ".join(_escaped(_text(cell)) for cell in cells) + r" \\"


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)


def markdown(tables: Sequence[Table]) -> str:
    """Pipe tables, one for each table with rows; titles bold above, notes below."""
    return "\n\n".join(_pipes(table) for table in tables if table.rows)


def _pipes(table: Table) -> str:
    rule = ["---", *(("---" if table.words else "---:") for _ in table.head[1:])]
    lines = [_piped(table.head), "|" + "|".join(rule) + "|", *(_piped(row.cells) for row in table.rows)]
    lines = [f"**{table.title}**", "", *lines] if table.title else lines
    return "\n".join([*lines, "", table.note] if table.note else lines)


def _piped(cells: Sequence[Cell]) -> str:
    texts = (re.sub(r"([|*_<>`\\])", r"\\\1", _text(cell)) for cell in cells)
    return f"| {' | '.join(texts)} |"


def _text(cell: Cell) -> str:
    return cell if isinstance(cell, str) else " ".join(part for part in cell if part)
