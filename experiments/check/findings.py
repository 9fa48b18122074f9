"""Claims of the checks: severity, code, message and remedy at a path of the file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from experiments.file.problems import Path

Severity = Literal["error", "warning", "note"]

SHOWN: Final = 5  # claims of one sort; the others are counted
FORGIVEN: Final = 1e-6  # of rounding


@dataclass(frozen=True)
class Claim:
    """Claim about a path of the experiment file."""

    severity: Severity
    code: str
    message: str
    remedy: str = ""
    path: Path = ()


def join_names(words: Sequence[str], most: int = 4) -> str:
    """Words joined by commas; the last of many are counted."""
    more = len(words) - most
    return ", ".join(words) if more <= 0 else f"{', '.join(words[:most])} and {more} more"


def first_of_each_code(claims: Iterable[Claim]) -> list[Claim]:
    """First claims of each code; the last of them ends with the number of the others."""
    by_code: dict[str, list[Claim]] = {}
    for claim in claims:
        by_code.setdefault(claim.code, []).append(claim)
    kept = []
    for same in by_code.values():
        kept += same[:SHOWN]
        if len(same) > SHOWN:
            kept[-1] = replace(kept[-1], message=f"{kept[-1].message}; and {len(same) - SHOWN} more like this")
    return kept
