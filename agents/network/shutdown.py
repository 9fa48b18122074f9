"""Leaving the network without waiting for a router that does not answer; support processes outlive the robots.

Closing a Zenoh session waits for acknowledgements: about 9 s when the network is cut, and half as long again when
declared entities are dropped.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Final, NoReturn

import zenoh

from agents.network import pubsub
from agents.network.keys import Keys

LEAVE_S: Final = 1.0


def leave(session: zenoh.Session, *declared: object, limit_s: float = LEAVE_S) -> bool:
    """Closes a session; returns whether that ended in time. If not it goes on in the background.

    `declared` own entities of the session: kept until it is closed, because dropping an entity waits as well.
    """
    closing = threading.Thread(target=_close, args=(session, declared), name="leaving the network", daemon=True)
    closing.start()
    closing.join(limit_s)
    return not closing.is_alive()


def _close(session: zenoh.Session, _declared: tuple[object, ...]) -> None:
    session.close()


@contextmanager
def closing_cleanly(session: zenoh.Session) -> Iterator[tuple[zenoh.Session, list[object]]]:
    """Inside, a session is open; at the end it is left. The items of the list count as `declared`."""
    declared: list[object] = []
    try:
        yield session, declared
    finally:
        leave(session, declared)


def end(main: Callable[[], int]) -> NoReturn:
    """Runs a `main` and ends the process with its exit code, after an exception with 1.

    It ends at once after an exception, for which no other thread waits, and while a daemon thread is alive. The
    interpreter would end that thread wherever it is: inside Zenoh, as when a router asks itself or a session is still
    closing, the process would end by SIGABRT ("FATAL: exception not rethrown").
    """
    code: str | int | None
    broke = False
    try:
        code = main()
    except SystemExit as left:
        code = left.code
    except BaseException:  # noqa: BLE001 - Ctrl-C as well
        traceback.print_exc()
        code, broke = 1, True
    end_process(code, at_once=broke)


def end_process(code: str | int | None, *, at_once: bool = False) -> NoReturn:
    """Ends the process with the exit code of a `main`; for `at_once` see `end`."""
    if at_once or any(thread.daemon for thread in threading.enumerate()):
        if isinstance(code, str):
            print(code, file=sys.stderr)
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):  # its reader has gone, or its disk is full
                stream.flush()
        os._exit(code if isinstance(code, int) else int(code is not None))
    sys.exit(code)


FAREWELL_S: Final = 15.0  # least limit for robots without a launcher to land; the same again to land by force
STOPPED_S: Final = 5.0  # limit for a body to confirm that its motors are off
AFTER_S: Final = 2.0 * FAREWELL_S + STOPPED_S + 5.0  # limit for all of that and the end of the process
SETTLE_S: Final = 0.5  # the token of a robot that has just started may still be on its way


class Farewell:
    """Support processes stay until all their robots have landed, at most `AFTER_S` after the launcher died."""

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Sequence[str], lost: threading.Event) -> None:
        """`lost` is set when the lifeline is lost."""
        self._watches = [pubsub.AliveWatch(session, keys.alive(robot)) for robot in robots]
        self._alive = [False] * len(self._watches)
        self._lost = lost
        self._last = float("inf")

    def over(self) -> bool:
        """Whether the launcher is gone, and the robots as well or their time is over; costs microseconds."""
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
