"""A table and a verdict as lines of the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.report.page import VerdictLine
from tools.progress import columns


def report_lines(rows: Sequence[Sequence[str]], verdict: Sequence[VerdictLine]) -> list[str]:
    """Lines of a table, its head first, and one for each finding."""
    return [*columns(rows), *map(str, verdict)]
