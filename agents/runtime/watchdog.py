"""A watchdog outside the control loop: a robot whose loop hangs is brought down by another thread of its process.

It is as good as the interpreter: where a process is frozen, or native code keeps the interpreter's lock for ever, no
thread of it runs, and the far end must act (docs/safety.md says who does, for each body).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Final, Self

from agents.arrays import Index
from agents.body.interface import Body

SILENCE_S: Final = 0.5
DOWN_S: Final = 10.0  # a robot whose loop hangs has so long to come down by itself,
CUT_S: Final = 0.5  # and its body so long to take in that the motors go off; then the process ends
AGAIN_S: Final = 0.5  # between two orders to land: the first may have got lost
LOOKS: Final = 5  # in each silence
HUNG: Final = 70  # exit code of a process whose loop hung for good


class Watchdog:
    """Watches a loop that says `beat` on every turn, from `start` to `end` or inside a `with`, as often as wanted.

    When no beat came for too long it has the body land, says so, and after `down_s` without a beat cuts the motors and
    ends the process. Each call is made in a thread of its own: what the loop hangs in may hang here too.

    Attributes:
        tripped: Why the robots were told to land; empty while all is well, and again after `forgive`.
    """

    def __init__(
        self,
        body: Body,
        rows: Index,
        *,
        alarm: Callable[[str], object],
        silence_s: float = SILENCE_S,
        down_s: float = DOWN_S,
        end: Callable[[int], object] = os._exit,
    ) -> None:
        """Nothing is watched yet.

        Args:
            body: `land` and `stop` of it are called.
            rows: All of its rows.
            alarm: Says to the others what has happened.
            silence_s: Longest time without a beat.
            down_s: From then until the motors are cut.
            end: Ends the process with an exit code.
        """
        self.tripped = ""
        self._body, self._rows, self._alarm, self._end = body, rows, alarm, end
        self._silence_s, self._down_s = silence_s, down_s
        self._beats = 0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._at_work: dict[str, threading.Thread] = {}

    def beat(self) -> None:
        """The loop goes round; costs 0.1 µs."""
        self._beats += 1

    def forgive(self) -> str:
        """The loop runs again: why it had been taken for hanging. The robots must land all the same."""
        why, self.tripped = self.tripped, ""
        return why

    def start(self) -> None:
        """Watches from now on, if it does not already."""
        if self._thread is None:
            self._over.clear()
            self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
            self._thread.start()

    def end(self) -> None:
        """Watches no longer."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def call_for_help(self, why: str) -> None:
        """Says to the others that the robots come down, without waiting until that has been said."""
        self._do("alarm", partial(self._alarm, why))

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def _watch(self) -> None:
        period = self._silence_s / LOOKS
        looked = since = time.monotonic()
        seen, hung, again = self._beats, 0.0, 0.0
        while not self._over.wait(period):
            last, looked = looked, time.monotonic()
            if looked - last > self._silence_s:
                since += looked - last  # nobody in this process ran, or could have
                continue
            if self._beats != seen:
                seen, since, hung = self._beats, looked, 0.0
                continue
            if looked - since < self._silence_s:
                continue
            if not hung:
                hung = again = looked
                self.tripped = f"its control loop hangs: no tick for {looked - since:.1f} s"
                self.call_for_help(self.tripped)
            if looked >= again:
                again = looked + AGAIN_S
                self._do("land", lambda: self._body.land(self._rows))
            if looked - hung > self._down_s:
                self._give_up()
                return

    def _give_up(self) -> None:
        """Motors off, and out: the device's own watchdog and the starter do the rest."""
        self._do("stop", lambda: self._body.stop(self._rows))
        self._at_work["stop"].join(CUT_S)
        if not self._over.wait(CUT_S):  # for what was said to leave the process
            self._end(HUNG)

    def _do(self, what: str, call: Callable[[], object]) -> None:
        """Calls in a thread of its own, unless the last call of that name has not come back."""
        last = self._at_work.get(what)
        if last is None or not last.is_alive():
            self._at_work[what] = threading.Thread(target=call, name=f"watchdog: {what}", daemon=True)
            self._at_work[what].start()
