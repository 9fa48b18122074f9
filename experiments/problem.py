"""What is wrong with an experiment file, where, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from experiments.locate import Path, line_column

SHOWN = 100  # characters of a source line; longer ones are cut around the place
MOST = 20  # problems that are told at once


@dataclass(frozen=True)
class Fault:
    """Something wrong at a path of the document, not yet located in the text.

    Attributes:
        path: Keys and list indices from the top of the document.
        message: What is wrong.
        hint: What to do.
        on_key: The key itself is wrong, not its value.
    """

    path: Path
    message: str
    hint: str = ""
    on_key: bool = False


@dataclass(frozen=True)
class Problem:
    """Something wrong at a place. Line and column are 1-based, 0 where there is no text to point into.

    Attributes:
        file: As the user named it; or the command-line flag that is at fault.
        line: Line number.
        column: In characters.
        message: What is wrong.
        hint: What to do.
        source: The line of text.
    """

    file: str
    line: int
    column: int
    message: str
    hint: str = ""
    source: str = ""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        parts = [f"{_printable(place)}: {_printable(self.message)}"]
        if self.line:
            shown, caret = _window(self.source, self.column - 1)
            parts += [f"{self.line:>6} | {shown}", f"       | {caret}^"]
        if self.hint:
            parts.append(f"       = {_printable(self.hint)}" if self.line else f"  {_printable(self.hint)}")
        return "\n".join(parts)


class DocumentError(ValueError):
    """An experiment that cannot be read, with everything that is wrong with it."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        told = [str(problem) for problem in problems[:MOST]]
        if len(problems) > MOST:
            told.append(f"and {len(problems) - MOST} more")
        super().__init__("\n".join(told))
        self.problems = list(problems)


def at_offset(file: str, text: str, offset: int, message: str, hint: str = "") -> Problem:
    """A problem at an offset into the text."""
    line, column = line_column(text, offset)
    return Problem(file, line, column, message, hint, text.split("\n")[line - 1])


def shown(value: object) -> str:
    """A value of the document, short enough for one line."""
    words = {True: "true", False: "false", None: "null"}
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _window(source: str, column: int) -> tuple[str, str]:
    """The part of a line around a column, and the blanks that lead to that column (tabs stay, so that they line up)."""
    first = max(0, column - SHOWN // 2) if len(source) > SHOWN else 0
    part = source[first : first + SHOWN]
    blanks = "".join("\t" if letter == "\t" else " " for letter in part[: column - first])
    cut = "..." if first else ""
    return cut + _printable(part), " " * len(cut) + blanks


def _printable(text: str) -> str:
    """Control characters and lone surrogates replaced: they would upset the terminal."""
    return "".join(letter if letter.isprintable() or letter == "\t" else "\ufffd" for letter in text)
