"""The clock of an experiment as one process reads it: that of its machine, set right by what it is known to lack.

The wall clock is read once and goes on with the monotonic one: a step in mid-run (NTP, an operator) moves nothing.
All processes of a run on the launcher's machine share one reading, however late they are started.

Clocks drift. Whoever started the process on another machine measures again during the run and says so on its lifeline,
`clock -0.200131`; the process follows by going a little faster or slower, never back: stamps tell which of two
samples is the newer one.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, field
from math import isfinite
from typing import Final

SLEW: Final = 0.005  # seconds per second; a hundred times what quartz drifts, and no body notices
STEP_S: Final = 0.5  # more is no drift: somebody was suspended, or is mistaken
READING: Final = "ZENPARK_CLOCK"  # environment: UTC at which the machine's monotonic clock was 0 [s]
_WORD: Final = b"clock "


def correction_line(correction_s: float) -> bytes:
    """The line by which a process is told its correction."""
    return _WORD + f"{correction_s:.6f}\n".encode()


@dataclass
class Clock:
    """UTC as everybody in the experiment reads it.

    Attributes:
        correction_s: What is added to this machine's UTC [s]; whoever starts a robot on another machine measures it.
            Corrected where stamps are made, so that nobody who reads them needs to know on which machine they were.
    """

    correction_s: float = 0.0
    _wanted: float = field(init=False, repr=False)
    _zero: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._wanted = self.correction_s
        shared = os.environ.get(READING)
        self._zero = time.time() - time.monotonic() if shared is None else float(shared)

    def utc(self) -> float:
        """Now, UTC [s]."""
        return self.at(time.monotonic())

    def at(self, monotonic: float) -> float:
        """UTC [s] at a time of the monotonic clock [s]."""
        return self._zero + monotonic + self.correction_s

    def shared(self) -> dict[str, str]:
        """The environment of processes on this machine that are to read this clock."""
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
        """Goes on towards what was told, for a step of `dt` [s]; returns by how much the clock was moved [s]."""
        lacks = self._wanted - self.correction_s
        if lacks == 0.0:
            return 0.0
        change = min(max(lacks, -SLEW * dt), SLEW * dt)
        self.correction_s = self._wanted if change == lacks else self.correction_s + change
        return change
