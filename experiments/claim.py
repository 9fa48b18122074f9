"""A claim about an experiment: what its numbers mean to the user, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from experiments.locate import Path

Severity = Literal["error", "warning", "note"]

SHOWN: Final = 3  # claims of one sort; the others are counted
FORGIVEN: Final = 1e-6  # of rounding


@dataclass(frozen=True)
class Claim:
    """Something to say about a path of the experiment file."""

    severity: Severity
    code: str
    message: str
    remedy: str = ""
    path: Path = ()


def listed(words: Sequence[str], most: int = 4) -> str:
    """Words with commas; the last of many are counted."""
    more = len(words) - most
    return ", ".join(words) if more <= 0 else f"{', '.join(words[:most])} and {more} more"
