"""Leaves the network without waiting for a router that does not answer.

Zenoh says good-bye to everybody and waits for it to be taken: about 9 s when the network is cut, and half as long again
when what was declared is let go of.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, NoReturn

import zenoh

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
