"""A page: findings, tables and pictures in one self-contained HTML file, readable in ten years."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from agents.errors import replacing
from experiments.metrics.statistics import Spread
from experiments.recording import version

if TYPE_CHECKING:
    from jinja2 import Template
    from matplotlib.figure import Figure

NONE: Final = "–"
MOST_DECIMALS: Final = 6  # decimals of an interval; smaller ones have an exponent


Cell = str | tuple[str, str]  # a text, or a text and a smaller one behind it


@dataclass(frozen=True)
class TableRow:
    """Cells of a row; `sum` rows are set apart."""

    cells: tuple[Cell, ...]
    sum: bool = False


@dataclass(frozen=True)
class Table:
    """A table."""

    head: tuple[str, ...]
    rows: tuple[TableRow, ...]
    title: str = ""
    note: str = ""
    words: bool = False  # aligns to the left


def number(value: float | None, scale: float = 1.0) -> str:
    """Three digits that count; whole numbers in full, in groups of three; a dash for what is unknown."""
    if value is None:
        return NONE
    size = abs(value * scale)
    if size < 1e-9 or size >= 1000.0 or isinstance(value, int):
        text = f"{size:,.0f}".replace(",", "\u202f")
    elif size < 0.001:
        text = f"{size:.1e}"
    else:
        text = f"{size:.{min(4, 2 - math.floor(math.log10(size)))}f}"
    return f"−{text}" if value < 0.0 and text != "0" else text


def interval(values: Spread, scale: float = 1.0) -> str:
    """A mean and, if the values differ, its 95 % half-width with as many decimals as its first digit needs."""
    if (
        values.mean is None or not values.ci95 or values.ci95 <= 1e-9 * abs(values.mean)
    ):  # values that differ by rounding
        return number(values.mean, scale)
    mean, half = values.mean * scale, values.ci95 * scale
    decimals = max(0, -math.floor(math.log10(half)), 2 - math.floor(math.log10(max(abs(mean), half))))
    if decimals > MOST_DECIMALS:
        return f"{number(mean)} ± {half:.0e}"
    return f"{mean:,.{decimals}f} ± {half:,.{decimals}f}".replace(",", "\u202f").replace("-", "−")


Mark = Literal["good", "fair", "bad", "plain"]


@dataclass(frozen=True)
class VerdictLine:
    """A sentence of the verdict and its mark."""

    mark: Mark
    text: str

    def __str__(self) -> str:
        """Line for a terminal."""
        return f"{MARKS[self.mark]} {self.text}"


@dataclass(frozen=True)
class PageFigure:
    """An SVG drawing to stand in the page, with its number and caption."""

    svg: str
    number: int
    caption: str


COLUMN_PX: Final = 480.0  # [px] half of the page


def _width(table: Table) -> float:
    """About how wide a table is in a page [px]."""
    lines = [table.head, *(row.cells for row in table.rows)]
    texts = [[cell if isinstance(cell, str) else " ".join(cell) for cell in line] for line in lines]
    return sum(24.0 + 7.0 * max(map(len, column)) for column in zip(*texts, strict=True))


@dataclass(frozen=True)
class Section:
    """A part of the page; whatever it has is shown in this order."""

    title: str
    prose: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[PageFigure, ...] = ()
    listing: str = ""
    terms: tuple[tuple[str, str], ...] = ()
    more: tuple[str, Table] | None = None  # a folded table at the end, behind the text on which to click
    folded: str = ""  # what is in it, in a few words; then the whole section is folded

    @property
    def packed(self) -> bool:
        """Whether its tables stand in two columns of the page: they are many, and each is narrow enough."""
        return len(self.tables) > 2 and max(map(_width, self.tables)) <= COLUMN_PX

    @property
    def anchor(self) -> str:
        """Id in the page, for links."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def template(name: str) -> Template:
    """A template of this folder, which escapes what it is given."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # noqa: PLC0415 - for pages alone

    loader = FileSystemLoader(Path(__file__).parent)
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return pages.get_template(name)


def render(
    target: Path,
    *,
    title: str,
    source: str,
    facts: Sequence[tuple[str, str]],
    verdict: Sequence[VerdictLine],
    sections: Sequence[Section],
    command: str = "",
    foot: Sequence[str] | None = None,
    replay: str = "",
) -> Path:
    """Writes a self-contained page: findings, facts, sections with their contents, a `foot` of small lines.

    Args:
        foot: Code and versions of this process if left out.
        replay: HTML of an embedded replay, trusted as it is, shown right after the findings; none if left out.
    """
    page = template("report.html.jinja").render(
        title=title,
        source=source,
        facts=facts,
        command=command,
        findings=verdict,
        marks=MARKS,
        sections=sections,
        foot=version.provenance().words[:2] if foot is None else foot,
        replay=replay,
    )
    with replacing(target) as fresh:
        fresh.write_text(page, encoding="utf-8")
    return target


MARKS: Final[dict[Mark, str]] = {"good": "✓", "fair": "!", "bad": "✗", "plain": "·"}


def fragment(title: str, verdict: Sequence[VerdictLine], tables: Sequence[Table]) -> str:
    """Verdict and tables as HTML without a page around it, for the end of a notebook's cell."""
    return template("fragment.html.jinja").render(title=title, findings=verdict, tables=tables, marks=MARKS)


def numbered(drawn: Iterable[tuple[Figure | str, str]], first: int = 1) -> tuple[PageFigure, ...]:
    """Figures, or their SVG, and their captions, to stand in a page."""
    from experiments.report import style  # noqa: PLC0415 - matplotlib takes 0.6 s

    texts = ((each if isinstance(each, str) else style.svg(each), caption) for each, caption in drawn)
    return tuple(
        PageFigure(inline(svg, f"f{number}-", caption), number, caption)
        for number, (svg, caption) in enumerate(texts, start=first)
    )


def inline(svg: str, prefix: str, label: str) -> str:
    """An SVG file as an element of a page: ids of its own, black and white as the page's ink and paper.

    Args:
        prefix: For every id and every reference to one.
        label: Its content for screen readers; plain words without markup.
    """
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<style.*?</style>|<metadata.*?</metadata>|<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{prefix}', svg)
    svg = re.sub(r'\b(?:xlink:)?href="#', f'href="#{prefix}', svg)
    svg = svg.replace("url(#", f"url(#{prefix}")
    svg = (
        svg.replace("stroke: #000000", "stroke: currentColor")
        .replace("#ffffff", "var(--paper)")
        .replace("#c0c0c0", "var(--line)")
    )
    box = re.search(r'viewBox="[^"]*"', svg)
    words = label.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    head = f'<svg {box[0] if box else ""} role="img" aria-label="{words}">'
    return re.sub(r"\n\s*", "\n", head + svg[svg.index(">") + 1 :]).strip()


def date_of(at: float) -> str:
    """A UTC time [s], such as `Playback.started`, as reports show it."""
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M} UTC"


def seeds_in_words(seeds: Sequence[int]) -> str:
    """`1 to 50` of many that follow one another, else each."""
    if len(seeds) > 2 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(str(seed) for seed in seeds)
