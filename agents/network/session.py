"""Sessions on the Zenoh network: opening, connection state, and detection of a silent router.

The control loop polls all received samples. Frequent samples wait in a ring channel, which keeps the newest ones and
never blocks; rare ones wait in a queue (`agents.network.pubsub`). A callback of the usual kind would cost a thread
each, a slow one stops all reception of its session, and one that is left open keeps the interpreter from exiting. The
emergency stop alone cannot wait for the next tick (`pubsub.ImmediateSubscriber`).
"""

from __future__ import annotations

import ctypes
import os
import platform
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain
from math import inf
from pathlib import Path
from typing import Final, NamedTuple, Protocol, TypeVar

import zenoh
from zenoh.handlers import RingChannel

from agents.errors import ExplainedError
from agents.network import access_control, lab
from agents.network import endpoints as topology
from agents.network.endpoints import EndpointError
from agents.network.zenoh_config import ASK_S, LEASE_S, config, reason, settings

_OPEN: Final = Path("/proc/self/fd")  # Linux
_NO_LINGER: Final = struct.pack("ii", 0, 0)  # struct linger
_INET: Final = (socket.AF_INET, socket.AF_INET6)


class _Connection(NamedTuple):
    """A TCP connection, by a descriptor of our own: Zenoh may close its own at any moment."""

    socket: socket.socket
    near: str  # address of its end here, as Zenoh writes it
    far: str


def forbid_lingering() -> int:
    """Lets the TCP connections of this process close at once, with data still on their way; returns their number.

    Zenoh sets SO_LINGER to 10 s: closing the connection to a process that is frozen, or cut off, stops the thread that
    serves all others for as long.
    """
    with _connections() as found:
        for each in found:
            each.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
        return len(found)


def hang_up(session: zenoh.Session) -> int:
    """Ends the TCP connections of this process, those of its other sessions too, to the peers of a session.

    Returns their number; the network is not waited for. Only TCP and TLS have connections that can be ended so.
    """
    own = {str(link.src).partition("/")[2] for link in session.info.links()}
    with _connections() as found:
        peers = {each.far for each in found if each.near in own}
        return _shut_down([each for each in found if each.far in peers])


def hang_up_on(link: zenoh.Link) -> bool:
    """Ends the TCP connection of one link of this process; returns whether it has one."""
    far = str(link.dst).partition("/")[2].partition("?")[0].partition("#")[0]
    with _connections() as found:
        return _shut_down([each for each in found if each.far == far]) > 0


def _shut_down(connections: Sequence[_Connection]) -> int:
    for each in connections:
        each.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
        with suppress(OSError):  # the other end was faster
            each.socket.shutdown(socket.SHUT_RDWR)
    return len(connections)


@contextmanager
def _connections() -> Iterator[list[_Connection]]:
    """The TCP connections of this process."""
    with ExitStack() as opened:
        found = []
        for name in list(_OPEN.iterdir()) if _OPEN.is_dir() else ():
            try:
                own = os.dup(int(name.name))
            except OSError:  # closed meanwhile
                continue
            try:
                one = opened.enter_context(socket.socket(fileno=own))
            except OSError:  # no socket
                os.close(own)
                continue
            with suppress(OSError):  # it listens, or is not connected any more
                if one.family in _INET and one.type == socket.SOCK_STREAM:
                    near, far = one.getsockname(), one.getpeername()
                    found.append(_Connection(one, _address(near, one.family), _address(far, one.family)))
        yield found


def _address(name: tuple[str, int], family: int) -> str:
    """The address of one end of a connection, as Zenoh writes it."""
    host, port = name[:2]
    return f"[{host}]:{port}" if family == socket.AF_INET6 else f"{host}:{port}"


SLICE_NS: Final = 100_000  # the shortest that is granted
_CALL: Final = {"x86_64": 314, "aarch64": 274}  # sched_setattr, which glibc has only since 2.41


@contextmanager
def prompt_threads() -> Iterator[None]:
    """Inside, new threads ask Linux (≥ 6.12) for short scheduler slices, to cut latency; the caller keeps its own."""
    asked = _ask(SLICE_NS)
    try:
        yield
    finally:
        if asked:
            _ask(0)


def _ask(slice_ns: int) -> bool:
    """Sets the slice of the calling thread, 0 for the default; returns whether that was possible."""
    number = _CALL.get(platform.machine())
    if sys.platform != "linux" or number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    # struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period
    attributes = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    return bool(ctypes.CDLL(None).syscall(number, 0, attributes, 0) == 0)


T_co = TypeVar("T_co", covariant=True)

RETRY_S: Final = 0.1  # pause between attempts to open; an open client keeps to the `connect/retry` of its configuration
GATHER_S: Final = 1.0
LINK_S: Final = 0.01
KNOCK_S: Final = 0.3  # limit for a port to accept a connection, when the reason of a failure is looked for
ENDPOINT_FREE_S: Final = 3.0  # limit for the endpoint of a robot of a mesh that is restarted to become free
ROBOT_LEASE_S: Final = 1.2  # lease of robots: the neighbours of a robot that hangs must detect it within 1.5 s
ASK_EVERY_S: Final = 0.4  # pause between two queries to the router
ANSWER_S: Final = 0.3  # time without a reply after which the router counts as silent
ASKED: Final = 8  # pending queries
LOOK_S: Final = 0.1  # most time between two polls that counts as silence of the router


class Unreachable(ExplainedError, ConnectionError):
    """No router answers at the endpoints."""


class Polled(Protocol[T_co]):
    """A queue that returns one received item a call, and None when it is empty."""

    def try_recv(self) -> T_co | None: ...


def open_session(
    endpoints: Sequence[str],  # routers, best first; or members of a mesh
    *,
    name: str,  # name that `./zenpark keys` shows
    wait_s: float = 10.0,  # limit for an answer [s]
    stop: threading.Event | None = None,  # ends the wait when it is set
    lease_s: float = LEASE_S,  # see `agents.network.zenoh_config`
    identity: str | None = None,  # name in the certificate, in a lab; `name` if left out
    rights: access_control.Rights | None = None,  # rights of all identities, enforced by the members of a mesh in a lab
    gather_s: float = GATHER_S,  # limit for further members of a mesh to answer when one has [s]
) -> zenoh.Session:
    """A session on the network of some endpoints; use it in a `with`.

    It is a client of the first router that answers. In a mesh (`agents.network.endpoints`) it is linked with all
    members, also with later ones. Raises EndpointError if an endpoint is malformed, or cannot be listened on, and
    LabError if its lab has no such identity. Raises Unreachable without an answer in time, or when `stop` is set
    before.
    """
    ends = topology.ends(endpoints, name)
    chosen = config(
        settings(
            ends.mode,
            connect=ends.connect,
            listen=ends.listen,
            name=name,
            lease_s=lease_s,
            identity=identity,
            rights=rights if ends.listen else None,
        )
    )
    ended = stop or threading.Event()
    deadline = time.monotonic() + (min(wait_s, ENDPOINT_FREE_S) if ends.listen else wait_s)
    while True:
        try:
            session = open_with(chosen)
        except zenoh.ZError as error:
            if time.monotonic() < deadline and not ended.wait(RETRY_S):
                continue
            if ends.listen:
                raise EndpointError(
                    f"{name} cannot listen on {', '.join(topology.bare(ends.listen))}: {reason(error)}. If it is on "
                    "the network already, end it first; or give it another endpoint in network.addresses"
                ) from None
        else:
            if not ends.visits or _gathered(session, len(ends.connect), gather_s, ended, deadline):
                return session
            session.close()
        raise Unreachable(_silence(endpoints, identity or name)) from None


def open_with(chosen: zenoh.Config) -> zenoh.Session:
    """A session, of a client or of a router: the one place in which zenpark opens any."""
    with prompt_threads():
        return zenoh.open(chosen)


def _gathered(session: zenoh.Session, members: int, gather_s: float, ended: threading.Event, deadline: float) -> bool:
    """Waits until a visitor is linked with all members of a mesh, or, after a while, with some."""
    begun = time.monotonic()
    while (linked := len(session.info.transports())) < members:
        now = time.monotonic()
        if linked and now - begun > gather_s:
            return True
        if now > deadline or ended.wait(LINK_S):
            return linked > 0
    return True


def _silence(endpoints: Sequence[str], identity: str) -> str:
    folder = lab.lab_of(endpoints)
    refused = (
        ""
        if folder is None
        else f", or it refuses the certificate of {identity} (`./zenpark lab show {folder}` says how long it is valid)"
    )
    remedy = "`./zenpark router` starts one, --connect names another"
    if topology.is_mesh(endpoints):
        remedy = "a mesh lasts as long as its run, --connect names another"
    elif folder is None:
        remedy += "; in a lab it needs --lab"
    plain = topology.bare(endpoints)
    obstacles = dict.fromkeys(filter(None, (topology.obstacle(each, KNOCK_S) for each in plain)))
    return (
        f"{'no member' if topology.is_mesh(endpoints) else 'no router'} answers at "
        f"{', '.join(plain) or 'no endpoint'}{''.join(f' ({each})' for each in obstacles)}{refused}: {remedy}"
    )


def connected(session: zenoh.Session) -> bool:
    """Whether the session has a router now, or a neighbour in a mesh. Costs 0.6 µs: poll it in the control loop."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


class RouterWatch:
    """Detection of a silent router by liveliness queries.

    Zenoh closes a link after the lease that the *other* end announces: 2 s with our router, 10 s with a plain zenohd,
    60 s with rmw_zenohd. Until then a frozen router, or a pulled cable, looks like a quiet one. A router answers a
    liveliness query from its own tables, so the end of its reply is a sign of life. Replies are polled, never waited
    for. Members of a mesh are not asked, since their lease is ours.

    Where there are several routers, one that is silent for `LEASE_S` is left for the next one, as one of ours would be
    by its lease (`agents.network.zenoh_config.LEASE_S`).
    """

    def __init__(self, session: zenoh.Session, key: str, endpoints: Sequence[str] = ()) -> None:
        """Begins with the first `silent_since`; in a lab, `key` is a liveliness key that this session may watch."""
        self._session, self._key = session, key
        self._others = len(endpoints) > 1
        self._questions: deque[tuple[float, Polled[zenoh.Reply]]] = deque(maxlen=ASKED)
        # Times of a clock that stands between polls: a process that gets no processor cannot blame the router.
        self._now, self._asked = 0.0, -inf
        self._unanswered = inf  # time of the oldest question [s]
        self._looked = inf
        self._silent_since = inf
        self._left = 0.0  # begin of the silence or of the time without any link, or of the last change of router
        self._arrived = 0
        self._answers = 0  # count since the silence began

    @property
    def heard(self) -> bool:
        """Whether an answer has come since the silence began; the first may be the end of a link."""
        return self._answers > 0

    def silent_since(self, t: float, arrived: int = 0) -> float:
        """Begin [s] of the silence of the router, or of the loss of the last link; infinity while it answers.

        Call it at 10 Hz or more, at times `t` [s] of any clock that does not go back. `arrived` is the number of
        samples received by the router, ever: while it grows no query is needed.
        """
        self._now += max(0.0, min(t - self._looked, LOOK_S))
        self._looked = t
        info = self._session.info
        if not info.routers_zid():
            self._questions.clear()
            self._asked, self._unanswered = -inf, inf
            self._answers, self._left = 0, self._now
            self._silent_since = inf if info.peers_zid() else min(self._silent_since, t)
            return self._silent_since
        if self._answered():
            self._answers += 1
            # A link that is closed ends its questions as an answer does: after a silence the second one counts.
            if self._answers > 1:
                self._silent_since = inf
            else:
                self._asked = -inf
        if arrived != self._arrived:
            self._arrived = arrived
            if self._silent_since == inf:
                self._questions.clear()
                self._asked, self._unanswered = self._now, inf
        if self._now - self._unanswered > ANSWER_S and self._silent_since == inf:
            self._silent_since, self._answers = t - (self._now - self._unanswered), 0
            forbid_lingering()
            self._left = self._unanswered
        if self._others and self._silent_since < inf and self._now - self._left > LEASE_S:
            self._left = self._now
            hang_up(self._session)
        if self._now - self._asked >= ASK_EVERY_S:
            handler = self._session.liveliness().get(self._key, RingChannel(1), timeout=10.0 * ASKED * ASK_EVERY_S)
            self._questions.append((self._now, handler))
            self._asked = self._now
            self._unanswered = min(self._unanswered, self._now)
        return self._silent_since

    def _answered(self) -> bool:
        """Whether a reply has arrived since the last call."""
        for number in reversed(range(len(self._questions))):
            _, handler = self._questions[number]
            try:
                while handler.try_recv() is not None:
                    pass
            except zenoh.ZError:  # the answer is complete
                for _ in range(number + 1):
                    self._questions.popleft()
                self._unanswered = self._questions[0][0] if self._questions else inf
                return True
        return False


def count_links(session: zenoh.Session) -> int:
    return len(session.info.transports())


def deserted(session: zenoh.Session) -> bool:
    """Whether only other routers are connected to a router."""
    return all(transport.whatami == zenoh.WhatAmI.ROUTER for transport in session.info.transports())


def tokens_present(session: zenoh.Session, keyexpr: str) -> set[str] | None:
    """Keys of the liveliness tokens that match; None without a reply in time."""
    found = set()
    for reply in session.liveliness().get(keyexpr, timeout=ASK_S):
        if reply.ok is None:
            return None
        found.add(str(reply.ok.key_expr))
    return found


def received(handler: Polled[T_co]) -> Iterable[T_co]:
    """Queued items, oldest first, without blocking. Nearly always there are none."""
    first = handler.try_recv()
    return () if first is None else chain((first,), iter(handler.try_recv, None))
