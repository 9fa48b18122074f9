"""Tables of a report as LaTeX (booktabs) and as Markdown, for papers and notes."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from experiments.report.page import Cell, Row, Table

LETTER: Final = 4.0  # [pt] width of a letter in eight-point type,
LETTERS: Final = {  # [pt] and of others
    " .,:;'|()[]fijlt": 2.9,
    "0123456789_": 4.3,
    "ABCDEFGHJKLNOPQRSTUVXYZ&$#^~": 6.2,
    "mwMW±×−–%": 6.9,
}
WIDEST_COLUMN: Final = 300.0  # [pt] of a page in two columns; what is wider spans both
MOST_LINES: Final = 54  # of a float, with its caption on a page
SHORT: Final = 6  # letters of a head that is not broken
HEAD_LINES: Final = 4  # of a tabular, with its rules

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
    """Floats of the package booktabs with caption and label, one for each table with rows, to fit a width [in].

    Where a table is too wide, its heads are broken, ratios go below their values, and columns into further tabulars;
    where it is too high for a page, it becomes several floats.
    """
    return "\n\n".join(part for table in tables if table.rows for part in _floats(table, 72.0 * width))


def _floats(table: Table, width: float) -> list[str]:
    name = "table*" if width > WIDEST_COLUMN else "table"
    words = f"{table.head[0]}s, {table.title}" if table.title else table.head[0]
    label = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
    found = []
    for k, parts in enumerate(_pages(_fitting(table, width))):
        caption = _escaped(f"{words}, continued." if k else f"{words}. {table.note}".strip())
        tabulars = "\\\\[1ex]\n".join(map(_tabular, parts))
        found.append("\n".join([
            rf"\begin{{{name}}}",
            r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
            rf"\caption{{{caption}}}",
            rf"\label{{tab:{label}{f'-{k + 1}' if k else ''}}}",
            tabulars,
            rf"\end{{{name}}}",
        ]))  # fmt: skip
    return found


def _pages(parts: Sequence[Table]) -> list[list[Table]]:
    """Tabulars that stand together in a float: as many as fit a page; one that does not is cut."""
    most = MOST_LINES - HEAD_LINES
    cut = [replace(part, rows=part.rows[k : k + most]) for part in parts for k in range(0, len(part.rows), most)]
    pages: list[list[Table]] = [[]]
    room = MOST_LINES
    for part in cut:
        lines = HEAD_LINES + len(part.rows)
        if pages[-1] and lines > room:
            pages.append([])
            room = MOST_LINES
        pages[-1].append(part)
        room -= lines
    return pages


def _fitting(table: Table, width: float) -> list[Table]:
    """Tables that fit a width [pt], each with the columns that name its rows."""
    if sum(_widths(table)) > width:
        table = replace(table, head=tuple(_broken(table, k) for k in range(len(table.head))))
    if sum(_widths(table)) > width:
        table = replace(table, rows=tuple(part for row in table.rows for part in _stacked_rows(row)))
    wide, names = _widths(table), [*range(table.keys)]
    groups: list[list[int]] = [[]]
    room = width - sum(wide[: table.keys])
    for column in range(table.keys, len(wide)):
        if groups[-1] and wide[column] > room:
            groups.append([])
            room = width - sum(wide[: table.keys])
        groups[-1].append(column)
        room -= wide[column]
    return [_columns(table, [*names, *group]) for group in groups]


def _broken(table: Table, column: int) -> str:
    """A head in lines that are no wider than its column needs."""
    words = re.findall(r"\[[^]]*\]|[^ _]*_s$|[^ _]*_|[^ _]+", table.head[column])
    widest = max(SHORT, *map(len, [*words, *(_text(row.cells[column]) for row in table.rows)]))
    lines = [""]
    for word in words:
        joined = f"{lines[-1]}{'' if lines[-1].endswith('_') else ' '}{word}".lstrip()
        lines = [*lines[:-1], joined] if len(joined) <= widest else [*lines, word]
    return "\n".join(line for line in lines if line)


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
    texts = ([part for cell in column for part in _text(cell).split("\n")] for column in zip(*lines, strict=True))
    return [max(map(_width, column)) + 6.0 for column in texts]


def _width(text: str) -> float:
    return sum(next((wide for letters, wide in LETTERS.items() if each in letters), LETTER) for each in text)


def _tabular(table: Table) -> str:
    columns = "l" * len(table.head) if table.words else "l" + "r" * (len(table.head) - 1)
    heads = " & ".join(map(_head, table.head, columns)) + r" \\"
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", heads, r"\midrule"]
    for k, row in enumerate(table.rows):
        if row.sum and k and not table.rows[k - 1].sum:
            lines.append(r"\midrule")
        lines.append(_latex_row(row.cells))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _head(text: str, side: str) -> str:
    lines = [_escaped(line) for line in text.split("\n")]
    return lines[0] if len(lines) == 1 else rf"\shortstack[{side}]{{" + r"\\".join(lines) + "}"


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
