"""What a robot prints when whoever started it may be gone, or reads slowly: it never waits and never fails for it."""

from __future__ import annotations

import io
import os
import sys


class Output(io.TextIOBase):
    """Writes to a file descriptor what fits; the rest is lost: printing must neither stop nor end a flying robot."""

    def __init__(self, fd: int) -> None:
        """Makes the descriptor one that does not block."""
        super().__init__()
        self._fd = fd
        os.set_blocking(fd, False)

    def write(self, text: str) -> int:
        """Writes at once, as far as that goes without waiting."""
        rest = text.encode(errors="replace")
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:  # nobody is there, or the pipe is full
            pass
        return len(text)

    def writable(self) -> bool:
        """It is."""
        return True


def detach() -> None:
    """Puts such outputs in the place of standard output and standard error."""
    sys.stdout, sys.stderr = Output(1), Output(2)
