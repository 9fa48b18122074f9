"""Clock of an experiment in one process: the machine's clock plus its known correction.

The wall clock is read once and continued with `uptime`. A step in mid-run (NTP, an operator) changes nothing, and a
machine that was suspended is not behind the others afterwards. All processes of a run on the launcher's machine share
one reading, however late they are started.

Clocks drift. The starter of a process on another machine measures the offset again during the run and writes it to the
lifeline of the process, `clock -0.200131`. The clock of the process then runs a little faster or slower. It never goes
back, because stamps decide which of two samples is newer.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from math import inf, isfinite
from typing import Final

SLEW: Final = 0.005  # [s/s] a hundred times the drift of quartz, harmless for any body
STEP_S: Final = 0.5  # larger changes are no drift: a suspended or mistaken peer
READING: Final = "ZENPARK_CLOCK"  # environment: UTC at which the machine's `uptime` was 0 [s]
_WORD: Final = b"clock "
_UPTIME: Final = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


def uptime() -> float:
    """Time [s] since the machine was started, on a clock that goes on while the machine sleeps."""
    return time.clock_gettime(_UPTIME)


def wait_until(
    true: Callable[[], object], limit_s: float, pause_s: float = 0.02, stop: threading.Event | None = None
) -> bool:
    """Wait until something is true, at most `limit_s` [s], or until `stop` is set; returns whether it was true."""
    deadline, pause = time.monotonic() + limit_s, time.sleep if stop is None else stop.wait
    while not true():
        if time.monotonic() >= deadline or pause(pause_s):
            return False
    return True


def correction_line(correction_s: float) -> bytes:
    """Line of the lifeline that sets the correction of a process."""
    return _WORD + f"{correction_s:.6f}\n".encode()


class Clock:
    """UTC of the experiment."""

    def __init__(self, correction_s: float = 0.0) -> None:
        # added to this machine's UTC where stamps are made, so that their readers need no machine [s]
        self.correction_s = self._wanted = correction_s
        shared = os.environ.get(READING)
        self._zero = time.time() - uptime() if shared is None else float(shared)

    def utc(self) -> float:
        """Now, UTC [s]."""
        return self.at(uptime())

    def at(self, up: float) -> float:
        """UTC [s] at a time `up` of the clock `uptime` [s]."""
        return self._zero + up + self.correction_s

    def shared(self) -> dict[str, str]:
        """Environment of processes on this machine that share this clock."""
        return {READING: repr(self.at(0.0))}

    def follow(self, line: bytes) -> None:
        """Follow a correction line, from any thread; an unreadable one, or one too far off to be drift, is refused."""
        try:
            wanted = float(line.removeprefix(_WORD))
        except ValueError:
            wanted = float("nan")
        if not line.startswith(_WORD) or not isfinite(wanted):
            print(f"clock: {line[:40]!r} is no correction; ignored", file=sys.stderr, flush=True)
        elif abs(wanted - self.correction_s) > STEP_S:
            far = wanted - self.correction_s
            print(f"clock: {far:+.3f} s at once is no drift; not followed", file=sys.stderr, flush=True)
        else:
            self._wanted = wanted

    def slew(self, dt: float) -> float:
        """Approach the wanted correction for a step of `dt` [s]; returns the change [s]."""
        lacks = self._wanted - self.correction_s
        if lacks == 0.0:
            return 0.0
        change = min(max(lacks, -SLEW * dt), SLEW * dt)
        self.correction_s = self._wanted if change == lacks else self.correction_s + change
        return change


class StampAge:
    """Age of messages: arrival less stamp, less the smallest such difference so far, for the clocks are not the same.

    A stamp that does not grow comes from a clock that was set back, or from a sender without stamps: the record
    restarts. Delays that are constant do not show.
    """

    def __init__(self, drift: float) -> None:
        """`drift`: largest difference between the rates of the two clocks [s/s]."""
        self.least, self._drift = inf, drift  # smallest difference [s]
        self._arrival = self._stamp = -inf

    def age(self, arrival: float, stamp: float) -> float:
        """Age [s] of a message with this stamp [s] that arrived at `arrival` [s, monotonic]."""
        if stamp <= self._stamp:
            self.least = inf
        self._stamp = stamp
        return self.lateness(arrival, stamp)

    def lateness(self, arrival: float, stamp: float) -> float:
        """Age [s] of a message that others may have overtaken."""
        self.least = min(self.least + self._drift * max(arrival - self._arrival, 0.0), arrival - stamp)
        self._arrival = arrival
        return arrival - stamp - self.least
