"""Publishers, subscribers, typed inboxes, orders and liveliness tokens, as every process of a run declares them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import suppress
from itertools import chain, count
from typing import Any, Final, Generic, Protocol, Self, TypeVar

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
from zenoh.handlers import Callback, FifoChannel, Handler, RingChannel

from agents.network import messages
from agents.network.keys import Keys
from agents.network.messages import M
from agents.network.session import Polled, received, tokens_present

HEARTBEAT_S: Final = 0.5  # delay until the loss of the last pose before a silence is noticed
POSES: Final = 16  # queued poses of one robot
EVENTS: Final = 64  # events of a run, repeated to a subscriber that was cut off: without a router much happens at once
SOURCES: Final = 4096  # publishers with known numbers
ORDERS: Final = 8  # queued
REPORTS: Final = 8192  # queued reports of all robots of a realm
LONGEST_ORDER: Final = 4096  # [bytes] an order to land or to stop is shorter
TOKEN_CHANGES: Final = 256  # queued
NO_ORDER: Final = 'an order is a query with a payload, such as {"order": "land"}'

_RECOVERY: Final = RecoveryConfig(periodic_queries=None, heartbeat=True)

T = TypeVar("T")


# ---------------------------------------------------------------------- publish and subscribe


def pose_publisher(session: zenoh.Session, key: str, mime: str, kept: int = 1) -> AdvancedPublisher:
    """A publisher that never loses its last `kept` values, however rarely it publishes.

    Late joiners request the last value (cache). Subscribers that were cut off request it again when the publisher
    reappears (detection). The heartbeat reveals a value lost before a silence.
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


def advanced_subscriber(session: zenoh.Session, key: str, handler: object, kept: int) -> AdvancedSubscriber[Any]:
    """The advanced half of `pose_subscriber`."""
    history = HistoryConfig(max_samples=kept, detect_late_publishers=True)
    made: AdvancedSubscriber[Any]
    either: Any = handler  # a channel or a callback, for which the types of Zenoh have two signatures
    made = declare_advanced_subscriber(session, key, either, history=history, recovery=_RECOVERY)
    return made


class Bell:
    """Ends the wait of one thread early; a ring before the wait counts, several are one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def ring(self) -> None:
        with suppress(RuntimeError):  # it has been rung already
            self._lock.release()

    def wait(self, timeout_s: float) -> bool:
        """Wait for a ring; returns whether there was one within `timeout_s` ≥ 0 [s]."""
        return self._lock.acquire(timeout=timeout_s)


def pose_subscriber(
    session: zenoh.Session, key: str, depth: int = POSES, kept: int = 1, bell: Bell | None = None
) -> PoseSubscriber:
    """The other end of `pose_publisher`, and of plain publishers: the newest `depth` samples wait in `.handler`.

    The history is limited to the `kept` of the publisher: without a limit a single frozen publisher stalls a wildcard
    for 10 s. A sample with a new number rings the `bell`, if there is one. A ring costs the receiving thread a wait for
    the interpreter's lock, and the loop a wake-up: 57 µs in all.
    """
    return PoseSubscriber(session, key, depth, kept, bell)


class PoseSubscriber:
    """Samples of advanced and of plain publishers.

    Zenoh's advanced subscriber drops a sample with a source number that does not grow, such as each of a plain
    publisher that names itself with a constant one. A plain subscriber brings these; it costs 2 µs for each sample.
    """

    def __init__(self, session: zenoh.Session, key: str, depth: int, kept: int, bell: Bell | None) -> None:
        """Subscribes; see `pose_subscriber`."""
        self._samples = deque[zenoh.Sample](maxlen=depth)
        self._numbers: dict[str, int] = {}  # last source number, by source

        def append(sample: zenoh.Sample) -> None:  # runs under a lock of the subscriber: it may only append and ring
            self._samples.append(sample)
            if bell is not None:
                bell.ring()

        handler: object = RingChannel(depth) if bell is None else Callback(append, indirect=False)
        self._advanced = advanced_subscriber(session, key, handler, kept)
        self._plain = session.declare_subscriber(key, RingChannel(depth))
        self._numbered = self._pop if bell is not None else self._advanced.handler.try_recv
        self._all = self._plain.handler.try_recv

    @property
    def handler(self) -> Polled[zenoh.Sample]:
        return self

    def try_recv(self) -> zenoh.Sample | None:
        if (sample := self._numbered()) is not None:
            return sample
        while (sample := self._all()) is not None:
            if self._repeats_its_number(sample):
                return sample
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.undeclare()

    def undeclare(self) -> None:
        self._advanced.undeclare()
        self._plain.undeclare()

    def _pop(self) -> zenoh.Sample | None:
        return self._samples.popleft() if self._samples else None

    def _repeats_its_number(self, sample: zenoh.Sample) -> bool:
        """Whether the number of a sample is not greater than the last one of its source."""
        if (source := sample.source_info) is None:
            return False
        name, number = str(source.source_id), source.source_sn
        last = self._numbers.get(name)
        if last is None and len(self._numbers) >= SOURCES:
            self._numbers.clear()
        self._numbers[name] = number
        return last is not None and number <= last


def last_values(session: zenoh.Session, keyexpr: str, limit_s: float) -> list[zenoh.Sample]:
    """Last value of each `pose_publisher`; those that have not answered after `limit_s` [s] are missing.

    Each is asked by its own key: in a lab a question on a wildcard does not reach them.
    """
    caches = sorted(tokens_present(session, f"{keyexpr}/@adv/pub/**") or ())
    asked = [session.get(f"{cache}?_max=1;_anyke", FifoChannel(ORDERS), timeout=limit_s) for cache in caches]
    return [reply.ok for answers in asked for reply in answers if reply.ok is not None]


def publisher(
    session: zenoh.Session, key: str, mime: str, priority: zenoh.Priority = zenoh.Priority.DATA
) -> zenoh.Publisher:
    """A plain publisher for frequent values (telemetry): dropped when the link is congested.

    Commands to a body in another process, which are repeated, overtake all others by the priority REAL_TIME. They are
    not express: then each sample fills a batch, a link has two of a priority, and a router drops what twenty robots
    send to one world at once.
    """
    return session.declare_publisher(
        key, encoding=mime, congestion_control=zenoh.CongestionControl.DROP, priority=priority
    )


class NumberedPublisher:
    """A plain publisher that names and numbers its samples: `session_of` reads the source.

    The number grows by one, or advanced subscribers of others drop all samples but the first.
    """

    def __init__(self, session: zenoh.Session, key: str, mime: str) -> None:
        self._publisher, self._numbers = publisher(session, key, mime), count()

    def put(self, payload: bytes) -> None:
        self._publisher.put(payload, source_info=zenoh.SourceInfo(self._publisher.id, next(self._numbers)))


def session_of(sample: zenoh.Sample) -> str | None:
    """Session that published a sample, if the sample names it."""
    source = sample.source_info
    return None if source is None else str(source.source_id.zid)


def subscriber(session: zenoh.Session, key: str, depth: int = 256) -> zenoh.Subscriber[Handler[zenoh.Sample]]:
    """The other end of `publisher`: the newest `depth` samples wait in `.handler`."""
    return session.declare_subscriber(key, RingChannel(depth))


# ---------------------------------------------------------------------- typed receive


class Subscription(Protocol):
    """A subscriber with queued samples, plain or advanced."""

    @property
    def handler(self) -> Polled[zenoh.Sample]: ...

    def undeclare(self) -> None: ...


class Inbox(Generic[M]):
    """Queued messages of one kind: `for pose in inbox.read(check)` decodes, checks, and counts what is refused."""

    def __init__(
        self,
        subscription: Subscription,
        kind: type[M],
        *,
        keys: Keys | None = None,  # keys that name the robot of a message; a message must carry that name
        robots: Container[str] | None = None,  # robots with accepted messages; None: all
        on_refusal: Callable[[str, str], object] | None = None,  # called with key and reason of each refusal
    ) -> None:
        """Reads `kind` from the queue of a subscription."""
        self._subscription, self._kind, self._keys, self._on_refusal = subscription, kind, keys, on_refusal
        # the next queued sample, or None; Zenoh makes a new handler at each access
        self.take = subscription.handler.try_recv
        self._robots = robots
        self._key, self._owner = "", None if keys is None else keys.robot_of("")  # last key: mostly the next's
        self.malformed, self.trouble = 0, ""  # refused payloads, and the reason of the last refusal

    def read(self, check: Callable[[M], object] | None = None) -> Iterator[M]:
        """Queued messages, oldest first, without waiting; those for which `check` raises `Malformed` are left out."""
        return (message for message, _ in self.read_samples(check))

    def read_samples(
        self, check: Callable[[M], object] | None = None, wanted: Callable[[str], bool] | None = None
    ) -> Iterable[tuple[M, zenoh.Sample]]:
        """As `read`, with the sample of each message; keys that are not `wanted` are skipped before decoding.

        Empty, and false, if nothing is queued.
        """
        first = self.take()
        return () if first is None else self.read_from(first, check, wanted)

    def read_from(
        self,
        first: zenoh.Sample,
        check: Callable[[M], object] | None = None,
        wanted: Callable[[str], bool] | None = None,
    ) -> Iterator[tuple[M, zenoh.Sample]]:
        """As `read_samples`, of a first sample and those that are queued."""
        for sample in chain((first,), iter(self.take, None)):
            key = str(sample.key_expr)
            if wanted is not None and not wanted(key):
                continue
            if key != self._key and self._keys is not None:
                self._key, self._owner = key, self._keys.robot_of(key)
            try:
                message = messages.decode(sample.payload.to_bytes(), str(sample.encoding), self._kind)
                if self._keys is not None and (robot := getattr(message, "robot", "")) != self._owner:
                    raise messages.Malformed(
                        f"{self._kind.__name__.lower()} of '{robot}' on the key of '{self._owner}'"
                    )
                if check is not None:
                    check(message)
            except messages.Malformed as error:
                self.refuse(str(error))
                if self._on_refusal is not None:
                    self._on_refusal(key, self.trouble)
            else:
                if self._robots is None or getattr(message, "robot", "") in self._robots:
                    yield message, sample

    def newest(self) -> Iterator[M]:
        """The last queued message of each key; those before it are not decoded."""
        for sample in {str(sample.key_expr): sample for sample in iter(self.take, None)}.values():
            for message, _ in self.read_from(sample):
                yield message

    def refuse(self, reason: str) -> None:
        """Count a payload as refused."""
        self.malformed += 1
        self.trouble = reason

    def close(self) -> None:
        self._subscription.undeclare()


class CallbackQueue(Generic[T]):
    """A queue of rare items, filled by the receiving thread, emptied by polling.

    Polling an empty one costs a tenth of polling an empty ring channel, and a look at `queue` a tenth of that.
    Frequent items belong into a ring channel: each item here costs the receiving thread a wait for the interpreter's
    lock.
    """

    def __init__(
        self, depth: int, wanted: Callable[[T], bool] = lambda _: True, urgent: Callable[[T], bool] = lambda _: False
    ) -> None:
        """Keeps the newest `depth` items that are `wanted`. `callback` is the one to declare.

        An item that is `urgent` is never displaced: if all are, the new one is left out.
        """
        self.queue: deque[T] = deque()  # queued items
        self._depth, self._wanted, self._urgent = depth, wanted, urgent
        self._lock = threading.Lock()
        self.callback = Callback(self._append, indirect=False)

    def try_recv(self) -> T | None:
        if not self.queue:
            return None
        with self._lock:
            return self.queue.popleft()

    def _append(self, item: T) -> None:
        if not self._wanted(item):
            return
        with self._lock:
            if len(self.queue) == self._depth:
                displaced = next((number for number, each in enumerate(self.queue) if not self._urgent(each)), None)
                if displaced is None:
                    return
                del self.queue[displaced]
            self.queue.append(item)


class ImmediateSubscriber:
    """Emergency stops, obeyed on reception: the control loop, which may hang, polls them later.

    Every PUT on the key is a stop (`messages.read_stop`). A DELETE is none, and revokes none: it clears a storage.

    The callback runs in the receiving thread: it must be quick, and must not query this session.
    """

    def __init__(
        self, session: zenoh.Session, key: str, obey: Callable[[messages.Stop], object], depth: int = 256
    ) -> None:
        """Subscribes: each stop is given to `obey`; the newest `depth` wait to be polled from then on."""
        self._obey = obey
        self.queue: deque[messages.Stop] = deque(maxlen=depth)  # stops to be polled
        self._subscriber = session.declare_subscriber(key, Callback(self.receive, indirect=False))

    def try_recv(self) -> messages.Stop | None:
        return self.queue.popleft() if self.queue else None

    def close(self) -> None:
        self._subscriber.undeclare()

    def receive(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.DELETE:
            self.obey(messages.read_stop(sample.payload.to_bytes(), str(sample.encoding)))

    def obey(self, stop: messages.Stop) -> None:
        """Obey a stop, whichever way it came."""
        try:
            self._obey(stop)
        finally:  # not before: a loop that polls in between would take it for obeyed already
            self.queue.append(stop)


# ---------------------------------------------------------------------- queries


class Orders(Generic[M]):
    """Queries on a key that carry an order of one kind; polled.

    Declare it before the liveliness token: a client that sees the token may then give orders.
    """

    def __init__(self, session: zenoh.Session, key: str, kind: type[M]) -> None:
        self._kind, self.malformed = kind, 0  # refused payloads
        self._queries = CallbackQueue[zenoh.Query](ORDERS, urgent=_ends_flight)
        self.queue = self._queries.queue  # queued
        self._queryable = session.declare_queryable(key, self._queries.callback, complete=True)

    def read(self) -> Iterator[tuple[zenoh.Query, M]]:
        """Queued orders with their queries. Reply inside `with query:` and on the key, or the client waits.

        A malformed order gets an error as its reply. A query without payload is no order: tools that read all keys
        (`get park/**`) send one and get no reply. Such a query on the key itself gets the form of an order.
        """
        for query in received(self._queries):
            payload = query.payload.to_bytes() if query.payload is not None else b""
            reason = NO_ORDER
            if payload:
                try:
                    order = messages.decode(payload, str(query.encoding or messages.JSON), self._kind)
                except messages.Malformed as error:
                    self.malformed += 1
                    reason = str(error)
                else:
                    yield query, order
                    continue
            with query:
                if payload or "*" not in str(query.key_expr):
                    query.reply_err(reason.encode(), encoding="text/plain")

    def close(self) -> None:
        self._queryable.undeclare()


def _ends_flight(query: zenoh.Query) -> bool:
    """Whether a query is an order to land or to stop, in either encoding."""
    payload = query.payload
    if payload is None or len(payload) > LONGEST_ORDER:
        return False
    order = payload.to_bytes()
    return b"land" in order or b"stop" in order


class LastValue:
    """Reply to a plain `get` (z_get, REST) on a key: the last value, which the cache of the publisher does not give.

    Polled by `answer` from the control loop, so it costs no thread.
    """

    def __init__(self, session: zenoh.Session, key: str, mime: str) -> None:
        self.key = key
        self.mime = mime
        self._payload: bytes | None = None
        self._queries = CallbackQueue[zenoh.Query](ORDERS)
        self.queue = self._queries.queue  # queued
        self._queryable = session.declare_queryable(key, self._queries.callback)  # lives as long as it is referenced

    def hold(self, payload: bytes) -> None:
        self._payload = payload

    def answer(self) -> int:
        """Replies to the queries since the last call, with nothing if there is no value yet; returns their number."""
        answered = 0
        for query in received(self._queries):
            with query:
                if self._payload is not None:
                    query.reply(self.key, self._payload, encoding=self.mime)
            answered += 1
        return answered


# ---------------------------------------------------------------------- liveliness


def alive_token(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    """Declares a liveliness token: it stands until it is undeclared or the session is gone."""
    return session.liveliness().declare_token(key)


class AliveWatch:
    """Liveliness tokens that appear (PUT) and vanish (DELETE), those that stand already first; polled.

    When the router dies every token vanishes at once and comes back after the reconnection: ask `connected` before
    a robot counts as lost. A token on many keys at once (`park/**`) belongs to no robot and is left out.
    """

    def __init__(self, session: zenoh.Session, keyexpr: str) -> None:
        self.handler = CallbackQueue[zenoh.Sample](TOKEN_CHANGES, lambda sample: "*" not in str(sample.key_expr))
        self.queue = self.handler.queue  # queued changes
        self._subscriber = session.liveliness().declare_subscriber(keyexpr, self.handler.callback, history=True)

    def changes(self) -> Iterator[tuple[str, bool]]:
        """Key of each token that appeared (True) or vanished (False) since the last call, oldest first."""
        for sample in received(self.handler):
            yield str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT


class RobotFeed:
    """Reports of the robots of a realm to those that watch them: statuses, states, and liveliness; polled."""

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Container[str] | None = None) -> None:
        """Subscribes; reports of other names than `robots` are dropped, of none if that is None."""
        self._keys = keys
        statuses = pose_subscriber(session, keys.status("*"), REPORTS)
        self.statuses = Inbox(statuses, messages.Status, keys=keys, robots=robots)
        self.states = Inbox(subscriber(session, keys.state("*"), REPORTS), messages.State, keys=keys, robots=robots)
        self._tokens = AliveWatch(session, keys.alive("*"))

    @property
    def malformed(self) -> int:
        """Reports that were refused."""
        return self.statuses.malformed + self.states.malformed

    def alive(self) -> Iterator[tuple[str, bool]]:
        """Name of each robot that came (True) or went (False) since the last call, oldest first."""
        for token, stands in self._tokens.changes():
            if (robot := self._keys.robot_of(token)) is not None:
                yield robot, stands
