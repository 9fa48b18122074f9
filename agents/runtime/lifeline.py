"""Parent-death detection: the launcher writes a heartbeat to the standard input of a process.

End of file means that the launcher is gone, silence that it hangs or that the network to it is cut. This works equally
for a local process and through ssh, on every operating system.

The heartbeat is an empty line. The emergency stop is a line as well: its second way, which needs no router. So is each
event of a run, for its recorder.
"""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from agents.network import messages

BEAT_S: Final = 0.5  # period of the heartbeat
SILENCE_S: Final = 3.0
# Of a process on another machine. TCP sends again 0.2, 0.6, 1.4, 3.0 and 6.2 s after a cable was cut: one that is back
# within 3 s is noticed after 3 s.
FAR_SILENCE_S: Final = 4.5
LONGEST: Final = 4096  # longest line [bytes]

GONE: Final = "the starter is gone"  # reason of the loss: gone, or ended
_STOP: Final = b"stop "
_EVENT: Final = b"event "


def stop_line(stop: messages.Stop) -> bytes:
    """Line with an emergency stop."""
    words = messages.Stop(stop.operator[: messages.MAX_WORDS], stop.reason[: messages.MAX_WORDS])
    return _STOP + messages.encode(words) + b"\n"


def stop_in(line: bytes) -> messages.Stop | None:
    """The emergency stop in a line; None if it has none."""
    return messages.read_stop(line.removeprefix(_STOP), messages.JSON) if line.startswith(_STOP) else None


def event_line(event: messages.Event) -> bytes:
    """Line with an event of a run."""
    return _EVENT + messages.encode(event) + b"\n"


def event_in(line: bytes) -> messages.Event | None:
    """The event in a line; None if it has none, or one that was too long."""
    with suppress(messages.Malformed):
        return messages.decode(line.removeprefix(_EVENT), messages.JSON, messages.Event)
    return None


class LifelineEnd:
    """The reading end of a lifeline: a file descriptor, standard input as a rule."""

    def __init__(self, fd: int = 0) -> None:
        self._fd, self._poll = fd, select.poll()  # not select(): a process with many files has descriptors beyond 1023
        self._poll.register(fd, select.POLLIN)

    def wait(self, timeout_s: float) -> bool:
        """Waits for data or the end; returns whether there is one in time."""
        return bool(self._poll.poll(timeout_s * 1000))

    def read(self) -> bytes:
        """Data that has arrived; empty at the end. Raises OSError if the line is broken."""
        return os.read(self._fd, LONGEST)


class Lifeline:
    """Watches a line in a daemon thread; the owner reacts to a loss: a robot lands first."""

    def __init__(
        self,
        lost: threading.Event,  # set once when the launcher is gone
        timeout_s: float = SILENCE_S,  # silence [s] that counts as loss
        line: LifelineEnd | None = None,  # standard input if left out
        on_line: Callable[[bytes], None] | None = None,  # called in that thread with each line that is no heartbeat
    ) -> None:
        self.reason: str | None = None  # reason of the loss; set before `lost`
        self._lost, self._timeout_s, self._on_line = lost, timeout_s, on_line
        self._line = line or LifelineEnd()
        self._rest = b""
        self._thread = threading.Thread(target=self._watch, name="lifeline", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def join(self, timeout_s: float | None = None) -> None:
        """Waits until the lifeline is lost."""
        self._thread.join(timeout_s)

    def _watch(self) -> None:
        self.reason = self._until_lost()
        self._lost.set()

    def _until_lost(self) -> str:
        try:
            while self._line.wait(self._timeout_s):
                data = self._line.read()
                if not data:
                    return GONE
                if self._on_line is not None:
                    self._deliver_lines(data, self._on_line)
        except OSError as error:
            return f"the lifeline broke: {error.strerror}"
        return f"nothing from the starter for {self._timeout_s:g} s"

    def _deliver_lines(self, data: bytes, on_line: Callable[[bytes], None]) -> None:
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-LONGEST:]
        for line in lines:
            if line:
                try:
                    on_line(line)
                except Exception as error:  # noqa: BLE001 - it must go on to watch
                    print(f"lifeline: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
