"""Text for the terminal: what others wrote neither steers it nor turns its direction."""

from __future__ import annotations

from collections.abc import Collection
from typing import TextIO
from unicodedata import category


def printable(text: str) -> str:
    """Text of others on one line, with escapes in the place of what is no letter, mark, sign or space."""
    return "".join(
        letter if letter.isprintable() or category(letter) == "Zs" else letter.encode("unicode_escape").decode()
        for letter in text
    )


def say(*texts: str, to: TextIO | None = None) -> None:
    """Print texts of any origin, each of one or more lines."""
    for text in texts:
        print("\n".join(map(printable, text.split("\n"))), file=to, flush=True)


def listed(names: Collection[str], most: int) -> str:
    """Names in order with commas between them; of more than `most` the first `most`, and the number of the others."""
    first = ", ".join(sorted(names)[:most])
    return first if len(names) <= most else f"{first} and {len(names) - most} more (--json names all)"
