"""The clock of an experiment as one process reads it: that of its machine, set right by what it is known to lack."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Clock:
    """UTC as everybody in the experiment reads it.

    Attributes:
        correction_s: What is added to this machine's UTC [s]; whoever starts a robot on another machine measures it.
            Corrected where stamps are made, so that nobody who reads them needs to know on which machine they were.
    """

    correction_s: float = 0.0

    def utc(self) -> float:
        """Now, UTC [s]."""
        return time.time() + self.correction_s


MACHINE: Final = Clock()  # of a process whose machine is right
