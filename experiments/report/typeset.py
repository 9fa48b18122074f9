"""Tables of a report as LaTeX (booktabs), as Markdown and as plain texts."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from typing import Final

from experiments.report.page import Cell, Table

WIDEST_COLUMN: Final = 4.2  # [in] column of a page in two columns; a wider float spans both

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
    "Δ": r"$\Delta$",
    "√": r"$\surd$",
    "→": r"$\to$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "‖": r"$\|$",
    "₂": "$_2$",
    "\u202f": r"\,",
    "<": "$<$",
    ">": "$>$",
}


def latex(tables: Sequence[Table], width: float = 3.5) -> str:
    """Floats with caption and label for the packages booktabs and adjustbox, one for each table with rows.

    A float spans one column of a page, or both for a width [in] above `WIDEST_COLUMN`; a larger table is scaled down.
    """
    name = "table*" if width > WIDEST_COLUMN else "table"
    return "\n\n".join(_float(table, name) for table in tables if table.rows)


def _float(table: Table, name: str) -> str:
    words = f"{table.head[0]}s, {table.title}" if table.title else table.head[0]
    return "\n".join([
        rf"\begin{{{name}}}",
        r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        rf"\caption{{{_escaped(f'{words}. {table.note}'.strip())}}}",
        rf"\label{{tab:{re.sub(r'[^a-z0-9]+', '-', words.lower()).strip('-')}}}",
        r"\begin{adjustbox}{max width=\linewidth, max totalheight=0.85\textheight}",
        _tabular(table),
        r"\end{adjustbox}",
        rf"\end{{{name}}}",
    ])  # fmt: skip


def _tabular(table: Table) -> str:
    columns = "l" * len(table.head) if table.words else "l" + "r" * (len(table.head) - 1)
    heads = _latex_row(table.head)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", heads, r"\midrule"]
    for k, row in enumerate(table.rows):
        if row.sum and k and not table.rows[k - 1].sum:
            lines.append(r"\midrule")
        lines.append(_latex_row(row.cells))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _latex_row(cells: Sequence[Cell]) -> str:
    return " & ".join(_escaped(_text(cell)) for cell in cells) + r" \\"


def _escaped(text: str) -> str:
    """A text as LaTeX shows it; a bracket at its beginning would be taken for a length of the line break before it."""
    return ("{}" if text.startswith(("[", "*")) else "") + "".join(map(_letter, text))


def _letter(letter: str) -> str:
    greek = unicodedata.name(letter, "").split(" ")
    if greek[:2] == ["GREEK", "SMALL"] and len(greek) == 4 and letter != "ο":
        return rf"$\{greek[3].lower().replace('lamda', 'lambda')}$"
    return _LATEX.get(letter, letter)


def markdown(tables: Sequence[Table]) -> str:
    """Pipe tables, one for each table with rows; titles bold above, notes below."""
    return "\n\n".join(_pipes(table) for table in tables if table.rows)


def plain(table: Table) -> list[tuple[str, ...]]:
    """Cells of a table as texts, its head first, for a terminal."""
    return [table.head, *(tuple(map(_text, row.cells)) for row in table.rows)]


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
