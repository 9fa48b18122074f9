"""Text for the terminal: what others wrote neither steers it nor turns its direction."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, Final, TextIO, cast
from unicodedata import category

from agents.errors import join_names


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
    return join_names(sorted(names), most) + " (--json names all)" * (len(names) > most)


STALL_S: Final = 0.2  # wait for a reader of progress that stands still


class _Lasting:
    """Stream that drops what cannot be written: its reader has gone, or its disk is full."""

    def __init__(self, stream: TextIO, *, patient: bool) -> None:
        """`patient`: a reader that stands still is waited for, however long; else what comes meanwhile is dropped."""
        self._stream, self._patient = stream, patient

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        with self._dropping():
            if self._patient or self._is_read():
                self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, or drop what is left."""
        with self._dropping():
            self._stream.flush()

    def _is_read(self) -> bool:
        """Whether the reader takes more: a terminal may be stopped, and a pipe full."""
        try:
            poll = select.poll()
            poll.register(self._stream.fileno(), select.POLLOUT)
        except (OSError, ValueError):  # no file
            return True
        return bool(poll.poll(1e3 * STALL_S))

    @contextmanager
    def _dropping(self) -> Iterator[None]:
        try:
            yield
        except OSError:
            with suppress(OSError, ValueError):  # what is buffered would fail again, at the end of the process too
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


@contextmanager
def lasting_console() -> Iterator[None]:
    """Inside, whatever is printed cannot end the process, and no progress stops it: robots fly on without a console."""
    with ExitStack() as both:
        both.enter_context(redirect_stdout(cast(TextIO, _Lasting(sys.stdout, patient=True))))
        both.enter_context(redirect_stderr(cast(TextIO, _Lasting(sys.stderr, patient=False))))
        yield
