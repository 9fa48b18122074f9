"""Publishers, subscribers and liveliness tokens, as every process of a run declares them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, Self

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

from agents.network import messages
from agents.network.session import EVENTS_OF_LIFE, ORDERS, Inbox, Orders, received

HEARTBEAT_S: Final = 0.5  # how long the loss of the last pose before a silence goes unnoticed


POSES: Final = 16  # of one robot that wait to be polled


EVENTS: Final = 64  # of a run that are said again to who was cut off: without a router much happens at once


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


class ImmediateSubscriber:
    """Emergency stops, obeyed as they come, without waiting for a control loop that may hang; it polls them later.

    Everything that is put on the key is a stop (`wire.read_stop`). A DELETE is none, and takes none back: it is what
    clears a storage.

    The callback runs in the thread that receives, without one of its own: what it calls must be quick, and must not
    ask this session anything.
    """

    def __init__(
        self, session: zenoh.Session, key: str, obey: Callable[[messages.Stop], object], depth: int = 256
    ) -> None:
        """Listens on a key: each stop is given to `obey`; the newest `depth` wait besides, from then on."""
        self._obey = obey
        self._waiting: deque[messages.Stop] = deque(maxlen=depth)
        self._subscriber = session.declare_subscriber(key, Callback(self._take, indirect=False))

    def try_recv(self) -> messages.Stop | None:
        """See `Polled`."""
        return self._waiting.popleft() if self._waiting else None

    def close(self) -> None:
        """Listens no longer."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _take(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            return
        stop = messages.read_stop(sample.payload.to_bytes(), str(sample.encoding))
        try:
            self._obey(stop)
        finally:  # not before: a loop that polls in between would take it for obeyed already
            self._waiting.append(stop)


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


def orders(session: zenoh.Session, key: str) -> Orders:
    """The orders on a key.

    Declare it before the liveliness token: whoever sees the token can then give orders.
    """
    return Orders(session, key)


def alive_token(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    """Says that the owner of this session is there, until the token is undeclared or the session is gone."""
    return session.liveliness().declare_token(key)


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
