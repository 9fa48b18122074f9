"""Experiments that come with zenpark, one file each."""

from __future__ import annotations

from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parent
SCHEMA: Final = "zenpark.schema.json"


def names() -> list[str]:
    """Names of all entries, sorted."""
    return sorted(file.stem for file in FOLDER.glob("*.toml"))
