"""Leaves the network without waiting for a router that does not answer.

Zenoh says good-bye to everybody and waits for it to be taken: about 9 s when the network is cut, and half as long again
when what was declared is let go of.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final, NoReturn

import zenoh

from agents.network import pubsub
from agents.network.keys import Keys

LEAVE_S: Final = 1.0
LEAVING: Final = "leaving the network"


def leave(session: zenoh.Session, *declared: object, limit_s: float = LEAVE_S) -> bool:
    """Closes a session; whether that was over in time. If not it goes on in the background.

    Args:
        session: To close.
        declared: Who holds what was declared on it: kept until it is closed, because to let go of it waits as well.
        limit_s: How long to wait [s].
    """
    closing = threading.Thread(target=_close, args=(session, declared), name=LEAVING, daemon=True)
    closing.start()
    closing.join(limit_s)
    return not closing.is_alive()


def _close(session: zenoh.Session, _declared: tuple[object, ...]) -> None:
    session.close()  # type: ignore[no-untyped-call]


@contextmanager
def held(session: zenoh.Session, limit_s: float = LEAVE_S) -> Iterator[tuple[zenoh.Session, list[object]]]:
    """Inside, a session is open; at the end it is left. What is put into the list counts as `declared`."""
    declared: list[object] = []
    try:
        yield session, declared
    finally:
        leave(session, declared, limit_s=limit_s)


def end(code: int) -> NoReturn:
    """Ends the process, at once if it is still leaving the network: all that is left to do is to wait for nobody."""
    if any(thread.name == LEAVING for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


FAREWELL_S: Final = 15.0  # so long robots whose launcher is gone are flown down, and once more so long landed by force
STOPPED_S: Final = 5.0  # a body that does not say that its motors stand is told so long, and then left
AFTER_S: Final = 2.0 * FAREWELL_S + STOPPED_S + 5.0  # how long all of that may take, and the end of a process
SETTLE_S: Final = 0.5  # the news of a robot that has just come may still be on its way


class Farewell:
    """Robots that have to land first still need what this process does for them."""

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Sequence[str], lost: threading.Event) -> None:
        """`lost` is that of the lifeline."""
        self._watches = [pubsub.AliveWatch(session, keys.alive(robot)) for robot in robots]
        self._alive = [False] * len(self._watches)
        self._lost = lost
        self._last = float("inf")

    def over(self) -> bool:
        """Whether the starter is gone, and then the robots, or their time is up; costs microseconds."""
        for row, watch in enumerate(self._watches):
            for _, alive in watch.changes():
                self._alive[row] = alive
        if not self._lost.is_set():
            return False
        now = time.monotonic()
        self._last = min(self._last, now + AFTER_S)
        if now < self._last - AFTER_S + SETTLE_S:
            return False
        return not any(self._alive) or now > self._last
