"""Findings of the checks: severity, code, message and remedy at a place of the file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from experiments.file.problems import Path

Severity = Literal["error", "warning", "note"]

SHOWN: Final = 5  # findings of one sort; the others are counted
FORGIVEN: Final = 1e-6  # of rounding


MARK: Final[dict[Severity, str]] = {"error": "✗", "warning": "!", "note": "✓"}


@dataclass(frozen=True)
class Finding:
    """Finding on an experiment: an error, a warning or a note, with remedy and place."""

    # of an error, the experiment cannot work; of a warning, it may not do what was meant; a note is good news, or
    # explains
    severity: Severity
    code: str  # one word for programs
    message: str  # what it is, with numbers
    remedy: str = ""  # what to change; empty for notes
    # path in the file; of those that `check` returns file:line:column, or the `--set` at fault; empty where it concerns
    # the whole
    where: Path | str = ""

    def __str__(self) -> str:
        """Line for a terminal."""
        return f"{MARK[self.severity]} {self.message}" + (f"; {self.remedy}" if self.remedy else "")


def join_names(words: Sequence[str], most: int = 4) -> str:
    """Words joined by commas; the last of many are counted."""
    more = len(words) - most
    return ", ".join(words) if more <= 0 else f"{', '.join(words[:most])} and {more} more"


def first_of_each_code(findings: Iterable[Finding]) -> list[Finding]:
    """First findings of each code; the last of them ends with the number of the others."""
    by_code: dict[str, list[Finding]] = {}
    for each in findings:
        by_code.setdefault(each.code, []).append(each)
    kept = []
    for same in by_code.values():
        kept += same[:SHOWN]
        if len(same) > SHOWN:
            kept[-1] = replace(kept[-1], message=f"{kept[-1].message}; and {len(same) - SHOWN} more like this")
    return kept
