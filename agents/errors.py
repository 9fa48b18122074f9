"""Base of the errors that a user can mend, and what their texts share.

A command prints them without a traceback and ends with exit code 2.
"""

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


class ExplainedError(Exception):
    """An error with a text that names the place and the remedy."""


class Refusal(Exception):
    """An order that is not carried out, with reason and remedy."""


@contextmanager
def writing(place: object, remedy: str) -> Iterator[None]:
    """Raises ExplainedError if a file or folder cannot be written inside."""
    try:
        yield
    except OSError as error:
        raise ExplainedError(f"{place}: cannot be written: {error.strerror}; {remedy}") from None


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """A place to write to, which takes the name of `file` after the block; what was there stays if that fails."""
    file = file.resolve()  # a link stays one
    draft = file.with_name(f"{file.name}.new")
    try:
        yield draft
        draft.replace(file)
    finally:
        draft.unlink(missing_ok=True)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The nearest known word as a question, or the list of all when none is near; empty when nothing is known."""
    words = list(known)
    lower = {each.lower(): each for each in words}
    near = difflib.get_close_matches(word.lower()[:80], lower, n=1)
    if near:
        return f"did you mean '{lower[near[0]]}'?"
    return f"known: {', '.join(words)}" if words else ""


def join_names(words: Sequence[str], most: int = 4) -> str:
    """Words joined by commas; the last of many are counted."""
    more = len(words) - most
    return ", ".join(words) if more <= 0 else f"{', '.join(words[:most])} and {more} more"
