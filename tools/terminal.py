"""Text for the terminal: what others wrote neither steers it nor turns its direction."""

from __future__ import annotations

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
