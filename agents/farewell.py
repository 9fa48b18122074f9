"""When those who serve robots (a simulated device, motion capture) may leave after their starter has gone."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Final

import zenoh

from agents import session as network
from agents.keys import Keys

FAREWELL_S: Final = 15.0  # so long robots whose launcher is gone are flown down, and once more so long landed by force
STOPPED_S: Final = 5.0  # a body that does not say that its motors stand is told so long, and then left
AFTER_S: Final = 2.0 * FAREWELL_S + STOPPED_S + 5.0  # how long all of that may take, and the end of a process
SETTLE_S: Final = 0.5  # the news of a robot that has just come may still be on its way


class Farewell:
    """Robots that have to land first still need what this process does for them."""

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Sequence[str], lost: threading.Event) -> None:
        """`lost` is that of the lifeline."""
        self._watches = [network.alive_watch(session, keys.alive(robot)) for robot in robots]
        self._alive = [False] * len(self._watches)
        self._lost = lost
        self._last = float("inf")

    def over(self) -> bool:
        """Whether the starter is gone, and then the robots, or their time is up; costs microseconds."""
        for row, watch in enumerate(self._watches):
            for sample in network.received(watch.handler):
                self._alive[row] = sample.kind != zenoh.SampleKind.DELETE
        if not self._lost.is_set():
            return False
        now = time.monotonic()
        self._last = min(self._last, now + AFTER_S)
        if now < self._last - AFTER_S + SETTLE_S:
            return False
        return not any(self._alive) or now > self._last
