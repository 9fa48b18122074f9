"""The lifeline of a process: its standard input, on which whoever started it writes a byte now and then.

End of file means that the starter is gone, silence that it hangs or that the network to it is cut. It works the same
for a local process and through ssh, and needs no help of the operating system that the other one lacks.
"""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable
from typing import Final

BEAT_S: Final = 0.5  # the starter writes one byte this often
SILENCE_S: Final = 3.0
LONGEST: Final = 4096  # of a line [bytes]


class Lifeline:
    """Watches a file descriptor in a daemon thread and sets `lost` when the starter is gone.

    What to do then is the owner's business: a robot lands first.

    Args:
        lost: Set once, after `reason` was.
        timeout_s: Silence [s] that counts as loss.
        fd: What to watch; standard input unless told otherwise.
        told: Called in that thread with each line that is no heartbeat: what the starter has to say later on.
    """

    def __init__(
        self,
        lost: threading.Event,
        timeout_s: float = SILENCE_S,
        fd: int = 0,
        told: Callable[[bytes], None] | None = None,
    ) -> None:
        self.reason: str | None = None
        self._lost = lost
        self._timeout_s = timeout_s
        self._fd = fd
        self._told = told
        self._rest = b""
        self._thread = threading.Thread(target=self._watch, name="lifeline", daemon=True)

    def start(self) -> None:
        """Begins to watch."""
        self._thread.start()

    def join(self, timeout_s: float | None = None) -> None:
        """Waits until the lifeline is lost."""
        self._thread.join(timeout_s)

    def _watch(self) -> None:
        self.reason = self._until_lost()
        self._lost.set()

    def _until_lost(self) -> str:
        waiting = select.poll()  # not select(): a process with many files has descriptors beyond 1023
        waiting.register(self._fd, select.POLLIN)
        try:
            while waiting.poll(self._timeout_s * 1000):
                data = os.read(self._fd, LONGEST)
                if not data:
                    return "the starter is gone"
                if self._told is not None:
                    self._pass_on(data, self._told)
        except OSError as error:
            return f"the lifeline broke: {error.strerror}"
        return f"nothing from the starter for {self._timeout_s:g} s"

    def _pass_on(self, data: bytes, told: Callable[[bytes], None]) -> None:
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-LONGEST:]
        for line in lines:
            if line:
                told(line)
