"""Sessions on the Zenoh network, and what a robot declares on them.

Everything that is received waits to be polled from the control loop: frequent samples in a ring channel, which keeps
the newest ones and never blocks; rare ones in an `Inbox`. A callback of the usual kind would cost a thread each, a slow
one stops all reception of its session, and one that is left open keeps the interpreter from exiting. The emergency stop
alone cannot wait for the next tick (`Alarm`).
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from math import inf
from typing import Final, Generic, Protocol, Self, TypeVar

import zenoh
from zenoh.ext import (
    AdvancedPublisher,
    AdvancedSubscriber,
    CacheConfig,
    HistoryConfig,
    MissDetectionConfig,
    RecoveryConfig,
    declare_advanced_publisher,
    declare_advanced_subscriber,
)
from zenoh.handlers import Callback, Handler, RingChannel

from agents import access, lab, topology, wire
from agents.endpoint import EndpointError
from agents.hangup import hang_up
from agents.promptness import prompt_threads
from agents.settings import ASK_S, LEASE_S, config, reason, settings

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

RETRY_S: Final = 0.1  # between attempts to open; an open client keeps to the `connect/retry` of its configuration
GATHER_S: Final = 1.0
LINK_S: Final = 0.01
FREED_S: Final = 3.0  # so long may an endpoint of a mesh stay taken by a robot that is started again
ROBOT_LEASE_S: Final = 1.2  # of robots: neighbours of one that hangs must know within 1.5 s
HEARTBEAT_S: Final = 0.5  # how long the loss of the last pose before a silence goes unnoticed
POSES: Final = 16  # of one robot that wait to be polled
ASK_EVERY_S: Final = 0.4  # between two questions whether the router still answers
ANSWER_S: Final = 0.3  # a question without an answer for so long begins a silence
ASKED: Final = 8  # questions that are waited for at once
LOOK_S: Final = 0.1  # between two looks for an answer no more than this is held against the router
NO_ORDER: Final = 'an order is a query with a payload, such as {"order": "land"}'
ORDERS: Final = 8  # that wait to be answered
EVENTS_OF_LIFE: Final = 256  # comings and goings that wait to be polled
EVENTS: Final = 64  # of a run that are said again to who was cut off: without a router much happens at once


class Unreachable(ConnectionError):
    """No router answers at the endpoints that were tried."""


class Polled(Protocol[T_co]):
    """Anything that hands out what arrived, one by one, and None when nothing waits."""

    def try_recv(self) -> T_co | None: ...


def open_session(
    endpoints: Sequence[str],
    *,
    name: str,
    wait_s: float = 10.0,
    stop: threading.Event | None = None,
    lease_s: float = LEASE_S,
    identity: str | None = None,
    rights: access.Rights | None = None,
    gather_s: float = GATHER_S,
) -> zenoh.Session:
    """A session on the network that some endpoints make; use it in a `with`.

    It is a client of the first router that answers. In a mesh (`agents.topology`) it is linked with all, some of
    whom may come later.

    Args:
        endpoints: Routers, best first; or members of a mesh.
        name: Who this is, as `zenpark keys` shows it.
        wait_s: How long to try [s].
        stop: Ends the wait when it is set.
        lease_s: See `agents.settings`.
        identity: Whose certificate is shown, where the endpoints are of a lab; `name` if left out.
        gather_s: How long members of a mesh that do not answer are waited for when others do [s].
        rights: Who may do what; a member of a mesh needs them in a lab, for nobody else enforces them.

    Raises:
        EndpointError: If an endpoint is malformed, or its lab has no such identity, or it cannot listen there.
        Unreachable: If nobody answered in time, or `stop` was set before anybody did.
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
    gone = stop or threading.Event()
    deadline = time.monotonic() + (min(wait_s, FREED_S) if ends.listen else wait_s)
    while True:
        try:
            with prompt_threads():
                session = zenoh.open(chosen)
        except zenoh.ZError as error:
            if time.monotonic() < deadline and not gone.wait(RETRY_S):
                continue
            if ends.listen:
                raise EndpointError(
                    f"{name} cannot listen on {', '.join(topology.bare(ends.listen))}: {reason(error)}. If it is on "
                    "the network already, end it first; or give it another endpoint in network.addresses"
                ) from None
        else:
            if not ends.visits or _gathered(session, len(ends.connect), gather_s, gone, deadline):
                return session
            session.close()  # type: ignore[no-untyped-call]
        raise Unreachable(_silence(endpoints, identity or name)) from None


def _gathered(session: zenoh.Session, members: int, gather_s: float, gone: threading.Event, deadline: float) -> bool:
    """Waits until a visitor is linked with all members of a mesh, or after a while with those that are there."""
    begun = time.monotonic()
    while (linked := len(session.info.transports())) < members:
        now = time.monotonic()
        if linked and now - begun > gather_s:
            return True
        if now > deadline or gone.wait(LINK_S):
            return linked > 0
    return True


def _silence(endpoints: Sequence[str], identity: str) -> str:
    folder = lab.of(endpoints)
    refused = (
        ""
        if folder is None
        else f", or it refuses the certificate of {identity} (`zenpark keys show {folder}` says until when it is valid)"
    )
    remedy = "`zenpark router` starts one, --connect names another"
    if topology.is_mesh(endpoints):
        remedy = "a mesh lasts as long as its run, --connect names another"
    elif folder is None:
        remedy += "; in a lab it needs --lab"
    return (
        f"{'nobody' if topology.is_mesh(endpoints) else 'no router'} answers at "
        f"{', '.join(topology.bare(endpoints)) or 'no endpoint'}{refused}: {remedy}"
    )


def connected(session: zenoh.Session) -> bool:
    """Whether the session has a router now, or a neighbour in a mesh. Costs 0.6 µs: poll it in the control loop."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


class RouterWatch:
    """Detection of a router that is silent, by questions of our own.

    Zenoh closes a link after the lease that the *other* end announces: 2 s with our router, 10 s with a plain zenohd,
    60 s with rmw_zenohd. Until then a frozen router, or a pulled cable, looks like a quiet one. A router answers a
    liveliness query from its own tables, so the end of its answer is a sign of life. Nothing waits for it: an answer
    is polled. A member of a mesh is not asked, for its lease is ours.

    Where there are several routers, one that is silent for `LEASE_S` is left for the next one, as one of ours would be
    by its lease (`agents.hangup`).
    """

    def __init__(self, session: zenoh.Session, key: str, endpoints: Sequence[str] = ()) -> None:
        """Begins with the first `silent_since`.

        Args:
            session: Whose router is watched.
            key: What is asked for; in a lab, a liveliness key that this session may watch.
            endpoints: Of the session.
        """
        self._session, self._key, self._others = session, key, len(endpoints) > 1
        self._waiting: deque[tuple[float, Polled[zenoh.Reply]]] = deque(maxlen=ASKED)
        # Times of a clock that stands while nobody looks: a process that gets no processor cannot blame the router.
        self._now, self._asked, self._unanswered = 0.0, -inf, inf  # the latter: when the oldest question was asked
        self._looked = inf
        self._silent_since = inf
        self._left = 0.0  # when a silent router was left last, or the silence or the time without any link began
        self._arrived = 0
        self._answers = 0  # since the silence began

    def silent_since(self, t: float, arrived: int = 0) -> float:
        """When the silence of the router began, or when the last link was lost; infinity while it answers.

        Args:
            t: Now, on any clock that does not go back [s]. Call it in each round of a loop, at 10 Hz or more.
            arrived: Samples that came by the router, ever. While more come it need not be asked.
        """
        self._now += max(0.0, min(t - self._looked, LOOK_S))
        self._looked = t
        info = self._session.info
        if not info.routers_zid():
            self._waiting.clear()
            self._asked, self._unanswered, self._answers, self._left = -inf, inf, 0, self._now
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
                self._waiting.clear()
                self._asked, self._unanswered = self._now, inf
        if self._now - self._unanswered > ANSWER_S and self._silent_since == inf:
            self._silent_since, self._answers = t - (self._now - self._unanswered), 0
            self._left = self._unanswered
        if self._others and self._silent_since < inf and self._now - self._left > LEASE_S:
            self._left = self._now
            hang_up(self._session)
        if self._now - self._asked >= ASK_EVERY_S:
            handler = self._session.liveliness().get(self._key, RingChannel(1), timeout=10.0 * ASKED * ASK_EVERY_S)
            self._waiting.append((self._now, handler))
            self._asked = self._now
            self._unanswered = min(self._unanswered, self._now)
        return self._silent_since

    def _answered(self) -> bool:
        """Whether an answer has come since the last look."""
        for number in reversed(range(len(self._waiting))):
            _, handler = self._waiting[number]
            try:
                while handler.try_recv() is not None:
                    pass
            except zenoh.ZError:  # the answer is complete
                for _ in range(number + 1):
                    self._waiting.popleft()
                self._unanswered = self._waiting[0][0] if self._waiting else inf
                return True
        return False


def links(session: zenoh.Session) -> int:
    """With how many others it is linked."""
    return len(session.info.transports())


def deserted(session: zenoh.Session) -> bool:
    """Whether nobody but other routers is connected to a router."""
    return all(transport.whatami == zenoh.WhatAmI.ROUTER for transport in session.info.transports())


def pose_publisher(session: zenoh.Session, key: str, mime: str, kept: int = 1) -> AdvancedPublisher:
    """A publisher whose last value is never lost, however rarely it speaks; nor are the last `kept`.

    Late joiners ask for the last value (cache), subscribers that were cut off ask again when they see the publisher
    reappear (detection), and a value lost before a silence is noticed by the heartbeat.
    """
    return declare_advanced_publisher(
        session,
        key,
        encoding=mime,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_HIGH,
        cache=CacheConfig(kept),
        sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
        publisher_detection=True,
    )


def pose_subscriber(
    session: zenoh.Session, key: str, depth: int = POSES, kept: int = 1
) -> AdvancedSubscriber[Handler[zenoh.Sample]]:
    """The other end of `pose_publisher`: the newest `depth` samples wait in `.handler`.

    The history is limited to the `kept` of the publisher: without a limit a single frozen publisher stalls a wildcard
    for 10 s.
    """
    return declare_advanced_subscriber(
        session,
        key,
        RingChannel(depth),
        history=HistoryConfig(max_samples=kept, detect_late_publishers=True),
        recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
    )


def publisher(session: zenoh.Session, key: str, mime: str) -> zenoh.Publisher:
    """A plain publisher for what comes again soon (telemetry): dropped when the link is congested."""
    return session.declare_publisher(
        key, encoding=mime, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA
    )


def urgent_publisher(session: zenoh.Session, key: str, mime: str) -> zenoh.Publisher:
    """A publisher for what must overtake all else, and is said again: orders to a body elsewhere.

    Not express: then each sample fills a batch, a link has two of a priority, and a router drops what twenty robots
    say to one world at once.
    """
    return session.declare_publisher(
        key, encoding=mime, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME
    )


def subscriber(session: zenoh.Session, key: str, depth: int = 256) -> zenoh.Subscriber[Handler[zenoh.Sample]]:
    """The other end of `publisher`: the newest `depth` samples wait in `.handler`."""
    return session.declare_subscriber(key, RingChannel(depth))


class Alarm:
    """Emergency stops, obeyed as they come, without waiting for a control loop that may hang; it polls them later.

    Everything that is put on the key is a stop (`wire.read_stop`). A DELETE is none, and takes none back: it is what
    clears a storage.

    The callback runs in the thread that receives, without one of its own: what it calls must be quick, and must not
    ask this session anything.
    """

    def __init__(self, session: zenoh.Session, key: str, obey: Callable[[wire.Stop], object], depth: int = 256) -> None:
        """Listens on a key: each stop is given to `obey`; the newest `depth` wait besides, from then on."""
        self._obey = obey
        self._waiting: deque[wire.Stop] = deque(maxlen=depth)
        self._subscriber = session.declare_subscriber(key, Callback(self._take, indirect=False))

    def try_recv(self) -> wire.Stop | None:
        """See `Polled`."""
        return self._waiting.popleft() if self._waiting else None

    def close(self) -> None:
        """Listens no longer."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _take(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            return
        stop = wire.read_stop(sample.payload.to_bytes(), str(sample.encoding))
        try:
            self._obey(stop)
        finally:  # not before: a loop that polls in between would take it for obeyed already
            self._waiting.append(stop)


class Inbox(Generic[T]):
    """Rare items, put in by the thread that receives, until they are polled.

    An empty one costs a tenth of an empty ring channel to poll. Items that come often belong into a ring channel: each
    item here costs the receiving thread a wait for the interpreter's lock.
    """

    def __init__(self, depth: int, wanted: Callable[[T], bool] = lambda _: True) -> None:
        """Keeps the newest `depth` items that are `wanted`. `filled` is the callback to declare."""
        self._items: deque[T] = deque(maxlen=depth)
        self._wanted = wanted
        self.filled = Callback(self._take, indirect=False)

    def try_recv(self) -> T | None:
        """See `Polled`."""
        return self._items.popleft() if self._items else None

    def _take(self, item: T) -> None:
        if self._wanted(item):
            self._items.append(item)


class LastValue:
    """Answers a plain `get` (z_get, REST) on a key with its last value, which the cache of an advanced publisher does
    not: call `answer` from the control loop."""

    def __init__(self, session: zenoh.Session, key: str, mime: str) -> None:
        self.key = key
        self.mime = mime
        self._payload: bytes | None = None
        self._questions = Inbox[zenoh.Query](ORDERS)
        self._queryable = session.declare_queryable(key, self._questions.filled)

    def hold(self, payload: bytes) -> None:
        """Remembers the value to answer with."""
        self._payload = payload

    def answer(self) -> int:
        """Replies to whoever asked since the last call, with nothing if there is no value yet; says to how many."""
        asked = 0
        for query in received(self._questions):
            with query:
                if self._payload is not None:
                    query.reply(self.key, self._payload, encoding=self.mime)
            asked += 1
        return asked

    def close(self) -> None:
        """Takes no more questions."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def last_value(session: zenoh.Session, key: str, mime: str) -> LastValue:
    """Makes the last value of a key visible to a plain `get`; polled, so it costs no thread."""
    return LastValue(session, key, mime)


class Orders:
    """Queries that carry an order, as they wait in `handler`.

    Reply inside `with query:` and on the key, or the asker waits.

    A query without payload is no order. Tools that read all keys (`get park/**`) send such: they get no answer. One
    on the key itself is told what an order is.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._queries = Inbox[zenoh.Query](ORDERS)
        self._queryable = session.declare_queryable(key, self._queries.filled, complete=True)

    @property
    def handler(self) -> Self:
        """See `Polled`."""
        return self

    def try_recv(self) -> zenoh.Query | None:
        """See `Polled`."""
        for query in received(self._queries):
            if query.payload is not None and query.payload.to_bytes():
                return query
            with query:
                if "*" not in str(query.key_expr):
                    query.reply_err(NO_ORDER, encoding="text/plain")
        return None

    def close(self) -> None:
        """Takes no more orders."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]


def orders(session: zenoh.Session, key: str) -> Orders:
    """The orders on a key.

    Declare it before the liveliness token: whoever sees the token can then give orders.
    """
    return Orders(session, key)


def alive_token(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    """Says that the owner of this session is there, until the token is undeclared or the session is gone."""
    return session.liveliness().declare_token(key)


def here(session: zenoh.Session, keyexpr: str, wait_s: float = ASK_S) -> set[str] | None:
    """Liveliness tokens that match; None if the question was not answered within `wait_s`."""
    found = set()
    for reply in session.liveliness().get(keyexpr, timeout=wait_s):
        if reply.ok is None:
            return None
        found.add(str(reply.ok.key_expr))
    return found


class AliveWatch:
    """Who comes (PUT) and goes (DELETE), as samples that wait in `handler`.

    A token on many keys at once (`park/**`) is nobody's life: it is left out.
    """

    def __init__(self, session: zenoh.Session, keyexpr: str) -> None:
        """Those already there come first."""
        self.handler = Inbox[zenoh.Sample](EVENTS_OF_LIFE, lambda sample: "*" not in str(sample.key_expr))
        self._subscriber = session.liveliness().declare_subscriber(keyexpr, self.handler.filled, history=True)


def alive_watch(session: zenoh.Session, keyexpr: str) -> AliveWatch:
    """Who comes and goes, those already there first.

    When the router dies every token goes at once and comes back after the reconnection: ask `connected` before
    holding a robot for lost.
    """
    return AliveWatch(session, keyexpr)


def received(handler: Polled[T_co]) -> Iterable[T_co]:
    """Items that wait in a handler, oldest first, without blocking. Nearly always there are none."""
    first = handler.try_recv()
    return () if first is None else chain((first,), iter(handler.try_recv, None))
