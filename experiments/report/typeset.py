"""Tables of a report as LaTeX (booktabs) and as Markdown, for papers and notes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from experiments.report.page import Cell, Table

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


def latex(tables: Sequence[Table]) -> str:
    """Tabulars of the package booktabs, one for each table with rows; titles and notes are comments."""
    return "\n\n".join(_tabular(table) for table in tables if table.rows)


def _tabular(table: Table) -> str:
    columns = "l" * len(table.head) if table.words else "l" + "r" * (len(table.head) - 1)
    lines = [f"% {text}" for text in (table.title, table.note) if text]
    lines += [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", _latex_row(table.head), r"\midrule"]
    for k, row in enumerate(table.rows):
        if row.sum and not (k and table.rows[k - 1].sum):
            lines.append(r"\midrule")
        lines.append(_latex_row(row.cells))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _latex_row(cells: Sequence[Cell]) -> str:
    texts = ("".join(_LATEX.get(letter, letter) for letter in _text(cell)) for cell in cells)
    return " & ".join(texts) + r" \\"


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
