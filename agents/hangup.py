"""Hangs up on a router that is silent, so that Zenoh goes to the next one.

A client stays linked to a frozen router for the lease that the router has announced (rmw_zenohd: 60 s), whatever other
routers there are. To close its session and open another would mean to declare everything anew, and waits for that very
router. Where the connection itself ends, Zenoh does what it does when a router dies: it takes the next one that
answers, and declares there what was declared.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import zenoh

_OPEN: Final = Path("/proc/self/fd")  # Linux
_INET: Final = (socket.AF_INET, socket.AF_INET6)


def hang_up(session: zenoh.Session) -> int:
    """Ends the connections of this process, those of its other sessions too, to where a session is linked.

    Blocks nothing: the network is not waited for. Only TCP and TLS have connections that can be ended so; other links
    stay.

    Returns:
        How many connections were ended.
    """
    own = {str(link.src).partition("/")[2] for link in session.info.links()}
    ended = 0
    with ExitStack() as seen:
        found = [seen.enter_context(each) for each in _connections()]
        peers = {each.getpeername() for each in found if _address(each) in own}
        for each in found:
            if each.getpeername() in peers:
                each.shutdown(socket.SHUT_RDWR)
                ended += 1
    return ended


def _connections() -> Iterator[socket.socket]:
    """The TCP connections of this process, by descriptors of our own: theirs may be closed at any moment."""
    for name in list(_OPEN.iterdir()) if _OPEN.is_dir() else ():
        try:
            own = os.dup(int(name.name))
        except OSError:  # closed meanwhile
            continue
        try:
            one = socket.socket(fileno=own)
        except OSError:  # no socket
            os.close(own)
            continue
        try:
            one.getpeername()
            good = one.family in _INET and one.type == socket.SOCK_STREAM
        except OSError:  # it listens, or is not connected any more
            good = False
        if good:
            yield one
        else:
            one.close()


def _address(connection: socket.socket) -> str:
    """The near end, as Zenoh writes it."""
    host, port = connection.getsockname()[:2]
    return f"[{host}]:{port}" if connection.family == socket.AF_INET6 else f"{host}:{port}"
