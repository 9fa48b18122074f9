"""Watchdog of the control loop: another thread of the process lands the robots when the loop hangs.

It depends on the interpreter: in a frozen process, or while native code keeps the interpreter's lock, no thread runs,
and the far end must act (docs/safety.md lists the reaction of each body).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from agents.body.interface import Body

SILENCE_S: Final = 0.5
DOWN_S: Final = 10.0  # least limit for the robots of a loop that hangs to land,
CUT_S: Final = 0.5  # time for the body to cut the motors; then the process ends
AGAIN_S: Final = 0.5  # pause between two orders to land: the first may be lost
LOOKS: Final = 5  # checks in each silence
HUNG: Final = 70  # exit code of a process with a loop that hung for good


class Watchdog:
    """Watches a loop that calls `beat` on every turn, from `start` to `end`, repeatedly if wanted.

    After `silence_s` without a beat it orders the body to land and raises the alarm, and after `down_s` more it cuts
    the motors and ends the process. Each call, of each row, has a thread of its own: it may hang as the loop does.
    """

    def __init__(
        self,
        body: Body,
        rows: Sequence[int],
        *,
        alarm: Callable[[str], object],  # reports the reason to the other processes
        silence_s: float = SILENCE_S,  # longest time without a beat [s]
        down_s: float = DOWN_S,  # time from then until the motors are cut [s]
        end: Callable[[int], object] | None = None,  # ends the process with an exit code
        displaced: Callable[[], bool] = lambda: False,  # whether another process drives the body: it is left alone
    ) -> None:
        self.tripped = ""  # why the robots were ordered to land; empty before, and after `forgive`
        self._body, self._rows, self._alarm = body, rows, alarm
        self._end, self._displaced = end or os._exit, displaced
        self.down_s, self._silence_s = down_s, silence_s
        self._beats = 0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._at_work: dict[str, threading.Thread] = {}

    def beat(self) -> None:
        """Reports a turn of the loop; costs 0.1 µs."""
        self._beats += 1

    def forgive(self) -> str:
        """Clears and returns the reason when the loop runs again. The robots must land all the same."""
        why, self.tripped = self.tripped, ""
        return why

    def start(self) -> None:
        """Starts to watch, unless it does already."""
        if self._thread is None:
            self._over.clear()
            self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
            self._thread.start()

    def end(self) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def call_for_help(self, why: str) -> None:
        """Raises the alarm without waiting for it to be sent."""
        self._call_in_thread("alarm", partial(self._alarm, why))

    def _watch(self) -> None:
        period = self._silence_s / LOOKS
        looked = since = time.monotonic()
        counted = self._beats
        hung, again = 0.0, 0.0
        while not self._over.wait(period):
            last, looked = looked, time.monotonic()
            if looked - last > self._silence_s:
                since += looked - last  # the whole process stood still
                continue
            if self._beats != counted:
                counted, since = self._beats, looked
                hung = 0.0
                continue
            displaced = self._displaced()
            if looked - since < self._silence_s:
                continue
            if not hung:
                hung = again = looked
            if not self.tripped and not displaced:
                self.tripped = f"its control loop hangs: no tick for {looked - since:.1f} s"
                self.call_for_help(self.tripped)
            if looked >= again and not displaced:
                again = looked + AGAIN_S
                self._order_each("land", self._body.land)
            if looked - hung > self.down_s:
                self._abort()
                return

    def _abort(self) -> None:
        """Cuts the motors and ends the process; the watchdog of the device and the launcher do the rest."""
        if not self._displaced():
            self._order_each("stop", self._body.stop)
            limit = time.monotonic() + CUT_S
            for row in self._rows:
                self._at_work[f"stop {row}"].join(max(0.0, limit - time.monotonic()))
        if not self._over.wait(CUT_S):  # time for messages to leave the process
            self._end(HUNG)

    def _order_each(self, what: str, order: Callable[[Sequence[int]], object]) -> None:
        for row in self._rows:
            self._call_in_thread(f"{what} {row}", partial(order, (row,)))

    def _call_in_thread(self, what: str, call: Callable[[], object]) -> None:
        """Makes a call in a thread of its own, unless the last call of that name still runs."""
        last = self._at_work.get(what)
        if last is None or not last.is_alive():
            self._at_work[what] = threading.Thread(target=call, name=f"watchdog: {what}", daemon=True)
            self._at_work[what].start()
