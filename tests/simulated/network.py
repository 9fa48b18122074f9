"""A Zenoh network of one to three routers: what `zenoh.Session` does, as far as zenpark uses it, on simulated time.

Each link is a TCP connection: it keeps the order, and holds what is sent into a cut or to a frozen process. An end that
has received nothing for the lease of the other one closes it. A router has tables of what its clients have declared and
passes all on; without it a client has its own declarations alone. Advanced publishers and subscribers are made of
plain ones, tokens and questions, as those of Zenoh are. Time is in seconds.
"""

from __future__ import annotations

import itertools
import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Final, Self

import zenoh

from tests.simulated.kernel import Process, Task, Waiters, block, current, preempt

LATENCY_S: Final = 0.0003  # mean time of a message on a link
SHAKE_S: Final = 0.003  # time to open a link
LOOK_S: Final = 0.01  # between two looks whether an end that is cut off, or frozen, answers at last
FLUSH_S: Final = 0.001  # from the mending of a cable until what it held arrives
REORDERED_S: Final = 0.1  # longest delay of a message that others overtake
REPEATED_S: Final = 0.2  # longest time until the copy of a message arrives
HEARTBEAT_S: Final = 0.5  # period in which an advanced publisher repeats the number of a new sample
HISTORY_S: Final = 10.0  # limit of the questions of an advanced subscriber
SETTINGS: Final = (
    "mode", "connect/endpoints", "listen/endpoints", "metadata",
    "transport/link/tx/lease", "transport/unicast/open_timeout",
)  # fmt: skip
ROUTER, CLIENT = zenoh.WhatAmI.ROUTER, zenoh.WhatAmI.CLIENT


@lru_cache(8192)
def match(expression: str, other: str) -> bool:
    return bool(zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(other)))


class Id(SimpleNamespace):
    """Id of an entity of a session: session `zid` and number `eid`."""

    def __str__(self) -> str:
        return f"{self.zid}/{self.eid}"


def source_info(source_id: Id, source_sn: int) -> SimpleNamespace:
    """As `zenoh.SourceInfo`."""
    return SimpleNamespace(source_id=source_id, source_sn=source_sn)


class Payload(bytes):
    def to_bytes(self) -> bytes:
        return self


class Sample:
    timestamp = attachment = None

    def __init__(
        self, key: str, payload: bytes = b"", mime: object = "", source: Any = None, *, deleted: bool = False
    ) -> None:
        self.key_expr, self.payload, self.encoding, self.source_info = key, Payload(payload), str(mime), source
        self.kind = zenoh.SampleKind.DELETE if deleted else zenoh.SampleKind.PUT


class Ring:
    """As `zenoh.handlers.RingChannel`; of other channels the depth is not limited."""

    def __init__(self, depth: int) -> None:
        self.depth = depth


# ---------------------------------------------------------------------- links


class Node:
    """An end of links: a session of a client, or a router.

    Attributes:
        cut: True while its cable is pulled out; see `Network.cut`.
        slow: Factor of the time that messages need.
        loss, dup, reorder: Probability that a message that may be lost is so, is repeated, or is overtaken by others.
    """

    def __init__(self, network: Network, lease_s: float) -> None:
        process = current().process
        assert process is not None
        self.network, self.process, self.lease_s = network, process, lease_s
        self.links: list[Link] = []
        self.closed = self.cut = False
        self.slow, self.loss, self.dup, self.reorder = 1.0, 0.0, 0.0, 0.0
        self._zid = f"{current().rng.getrandbits(64) | 1 << 63:x}"
        process.sessions.append(self)

    def zid(self) -> str:
        return self._zid

    @property
    def silent(self) -> bool:
        return self.cut or self.process.paused

    def suspend(self) -> None:
        for link in self.links:
            link.look()

    resume = suspend

    def die(self) -> None:
        """Close all links, as the kernel does for a dead process."""
        self.closed = True
        for link in list(self.links):
            link.close(self)

    hang_up = die

    def lost(self, link: Link) -> None:
        """A link is closed, by this end or the other."""


class Link:
    """A TCP connection between two nodes.

    Attributes:
        near, far: Its ends: the client and its router, or two routers.
        subscribers, queryables, tokens: What the near end has declared: keys, by the thing that was declared.
        shown: Keys of tokens that the near end was told.
        asked: Questions that the near end has not answered yet.
        since: Time at which it was opened [s].
    """

    def __init__(self, near: Node, far: Node) -> None:
        self.near, self.far, self.since = near, far, current().now
        self.subscribers: dict[Any, str] = {}
        self.queryables: dict[Any, str] = {}
        self.tokens: dict[Any, str] = {}
        self.shown: dict[str, None] = {}
        self._open = {near: True, far: True}
        self._due = dict.fromkeys(self._open, self.since)  # when the last message arrives at each end
        self._sent = dict.fromkeys(self._open, self.since)  # when each end sent last
        self._held: dict[Node, list[tuple[Any, ...]]] = {near: [], far: []}
        self._silences: dict[Node, int] = {near: 0, far: 0}  # number of the present silence of each end
        self._counter = itertools.count(1)
        near.links.append(self)
        far.links.append(self)

    def open(self) -> bool:
        """Whether both ends are open."""
        return all(self._open.values())

    def other(self, node: Node) -> Node:
        return self.far if node is self.near else self.near

    def send(
        self, sender: Node, call: Callable[..., object], *args: Any, drop: bool = False, express: bool = False
    ) -> None:
        """Call a function at the other end, in the order of all calls; it may be lost if `drop`."""
        if not self._open[sender]:
            return
        kernel, to = current(), self.other(sender)
        self._sent[sender] = kernel.now
        if drop and ((lost := max(sender.loss, to.loss)) and kernel.rng.random() < lost):
            return
        due = kernel.now + LATENCY_S * sender.slow * to.slow * (0.3 + kernel.rng.expovariate(1.0))
        if drop and to.reorder and kernel.rng.random() < to.reorder:
            due += kernel.rng.random() * REORDERED_S
        elif not express:
            due = self._due[to] = max(due, self._due[to])
        kernel.at(due, self._arrive, to, call, args)
        if drop and to.dup and kernel.rng.random() < to.dup:
            kernel.at(due + kernel.rng.random() * REPEATED_S, self._arrive, to, call, args)

    def close(self, node: Node) -> None:
        """Close one end; the other one notices after all that was sent before."""
        if self._open[node]:
            to, now = self.other(node), current().now
            self._open[node] = False
            node.links.remove(self)
            current().at(max(self._due[to], now + LATENCY_S), self._arrive, to, self.close, (to,))
            node.lost(self)

    def look(self) -> None:
        """Notice that the cable, or the process of an end, stands still or goes on."""
        now = current().now
        for to in (self.near, self.far):
            sender = self.other(to)
            if not (self.near.cut or self.far.cut or sender.process.paused):
                self._silences[to] = 0
            elif not self._silences[to]:
                number = self._silences[to] = next(self._counter)
                beat_s = sender.lease_s / 4.0  # a sign of life is sent after this time without another message
                heard = now - (now - self._sent[sender]) % beat_s
                current().at(heard + sender.lease_s, to.process.call, self._expire, to, number)
        if not (self.near.cut or self.far.cut):
            current().after(FLUSH_S, self._flush)

    def _expire(self, to: Node, number: int) -> None:
        if self._silences[to] == number:
            self.close(to)

    def _arrive(self, to: Node, call: Callable[..., object], args: tuple[Any, ...]) -> None:
        if self.near.cut or self.far.cut or self._held[to]:
            self._held[to].append((call, args))
        elif self._open[to]:
            to.process.call(self._receive, to, call, args)

    def _receive(self, to: Node, call: Callable[..., object], args: tuple[Any, ...]) -> None:
        if self._open[to]:
            call(*args)

    def _flush(self) -> None:
        if not (self.near.cut or self.far.cut):
            for to, held in self._held.items():
                self._held[to] = []
                for call, args in held:
                    self._arrive(to, call, args)


class Network:
    """All nodes, with the endpoints that routers listen on.

    Attributes:
        forgets: Probability that a question for tokens, of a session that watches the same keys, has an empty answer
            (`findings/zenoh-liveliness-get-beside-subscriber.sh`).
    """

    def __init__(self) -> None:
        self.sessions: list[Session] = []
        self.routers: list[Router] = []
        self.numbers = itertools.count(1)
        self.forgets = 0.0

    def open(self, config: zenoh.Config) -> Session | Router:
        """A node with settings of `agents.network.zenoh_config`; raises ZError if no router answers."""
        settings = {key: json.loads(config.get_json(key)) for key in SETTINGS}
        kind = Router if settings["mode"] == "router" else Session
        return kind(self, settings["transport/link/tx/lease"] / 1000.0, settings)

    def at(self, endpoint: str) -> Router | None:
        """The router that listens on an endpoint."""
        return next((each for each in self.routers if endpoint in each.listen), None)

    def cut(self, node: Node, cut: bool = True) -> None:
        """Pull the cable of a node out, or plug it in again."""
        node.cut = cut
        node.suspend()

    @property
    def serving(self) -> bool:
        """Whether there is a router that runs."""
        return any(not each.process.paused for each in self.routers)


# ---------------------------------------------------------------------- routers


class Question:
    """A question on its way: `Replies` at the asker, and the clients that have yet to answer, with their routers."""

    def __init__(self, link: Link, replies: Replies, selector: str, payload: Any, mime: str) -> None:
        self.link, self.replies, self.payload, self.mime = link, replies, payload, mime
        self.key, _, self.parameters = selector.partition("?")
        self.left: dict[Link, Router] = {}


class Router(Node):
    """The session of a router's process."""

    def __init__(self, network: Network, lease_s: float, settings: Mapping[str, Any]) -> None:
        super().__init__(network, lease_s)
        self.listen, self._connect = settings["listen/endpoints"], settings["connect/endpoints"]
        if any(network.at(endpoint) for endpoint in self.listen):
            raise zenoh.ZError("simulated: address in use")
        self.clients: list[Link] = []
        self.peers: list[Link] = []
        self._routes: dict[str, list[Link]] = {}
        self._questions: list[Question] = []
        self._linking: dict[str, Task] = {}
        network.routers.append(self)
        self.info = SimpleNamespace(
            transports=lambda: (
                [SimpleNamespace(whatami=CLIENT) for _ in self.clients]
                + [SimpleNamespace(whatami=ROUTER) for _ in self.peers]
            ),
            links=list,
            routers_zid=lambda: [each.other(self).zid() for each in self.peers],
            peers_zid=list,
            zid=self.zid,
        )
        for endpoint in self._connect:
            self._link_with(endpoint)

    def close(self) -> None:
        self.die()

    def die(self) -> None:
        if self in self.network.routers:
            self.network.routers.remove(self)
        super().die()

    hang_up = die

    def _link_with(self, endpoint: str) -> None:
        """Link with another router, for as long as both live."""

        def attempt() -> None:
            while not self.closed:
                block(SHAKE_S)
                other = self.network.at(endpoint)
                if other is not None and not self.silent and not other.silent:
                    link = Link(self, other)
                    self.peers.append(link)
                    other.peers.append(link)
                    self.change()
                    return
                block(0.1)

        self._linking[endpoint] = Task(self.process, attempt, f"link with {endpoint}")

    def lost(self, link: Link) -> None:
        for links in (self.clients, self.peers):
            if link in links:
                links.remove(link)
        self._routes.clear()
        self.change()
        if link.near is self and isinstance(link.far, Router) and not self.closed:
            for endpoint in self._connect:
                if endpoint in link.far.listen:
                    self._link_with(endpoint)

    def welcome(self, link: Link) -> None:
        """A client has connected."""
        self.clients.append(link)

    def _next(self, target: Router) -> Link | None:
        """Link with a router, or with one that is linked with it."""
        for link in self.peers:
            if link.other(self) is target:
                return link
        for link in self.peers:
            beyond = link.other(self)
            assert isinstance(beyond, Router)
            if any(each.other(beyond) is target for each in beyond.peers):
                return link
        return None

    def _reached(self) -> list[Router]:
        """This router, and those that it is linked with."""
        return [self, *(each for each in self.network.routers if each is not self and self._next(each) is not None)]

    def relay(self, target: Router, call: Callable[..., object], *args: Any) -> None:
        """Call a function at another router, or here."""
        if target is self:
            call(*args)
        elif (link := self._next(target)) is not None:
            neighbour = link.other(self)
            assert isinstance(neighbour, Router)
            link.send(self, neighbour.relay, target, call, *args)

    # samples

    def declare(self, link: Link, table: dict[Any, str], thing: object, key: str | None) -> None:
        """A client declares something, or undeclares it if there is no key."""
        if key is None:
            table.pop(thing, None)
        else:
            table[thing] = key
        if table is link.subscribers:
            self._routes.clear()
        elif table is link.tokens:
            self.change()

    def forward(self, origin: Link, sample: Sample, drop: bool, express: bool, passed: Sequence[Router] = ()) -> None:
        """Pass a sample on to clients that have subscribed, and to other routers."""
        key = sample.key_expr
        if (found := self._routes.get(key)) is None:
            found = self._routes[key] = [
                link for link in self.clients if any(match(each, key) for each in link.subscribers.values())
            ]
        for link in found:
            if link is not origin:
                link.send(self, link.near.take, sample, drop=drop, express=express)  # type: ignore[attr-defined]
        if self.peers:
            neighbours = [link.other(self) for link in self.peers]
            for link, each in zip(self.peers, neighbours, strict=True):
                if each not in passed:
                    far = [*passed, self, *neighbours]
                    link.send(self, each.forward, link, sample, drop, express, far, drop=drop)  # type: ignore[attr-defined]

    # liveliness

    def _tokens(self) -> dict[str, None]:
        """Keys of all tokens of the network."""
        found = (link for router in self._reached() for link in router.clients)
        return {key: None for link in found for key in link.tokens.values()}

    def change(self, passed: Sequence[Router] = ()) -> None:
        """Tell clients what has changed of tokens, and what questions are over; and the other routers to do so."""
        wanted = self._tokens()
        for link in list(self.clients):
            gone = [key for key in link.shown if key not in wanted]
            new = [key for key in wanted if key not in link.shown]
            link.shown = wanted
            for key, there in [(key, False) for key in gone] + [(key, True) for key in new]:
                link.send(self, link.near.show, key, there)  # type: ignore[attr-defined]
        reached = self._reached()
        for question in list(self._questions):
            for target, router in list(question.left.items()):
                if router not in reached or target not in router.clients:
                    self.finish(question, target)
        neighbours = [link.other(self) for link in self.peers]
        for link, each in zip(self.peers, neighbours, strict=True):
            if each not in passed:
                link.send(self, each.change, [*passed, self, *neighbours])  # type: ignore[attr-defined]

    def repeat(self, link: Link) -> None:
        """Tell a client of all tokens, since it has begun to watch some."""
        for key in link.shown:
            link.send(self, link.near.show, key, True)  # type: ignore[attr-defined]

    def list_tokens(self, link: Link, key: str, replies: Replies) -> None:
        for each in self._tokens():
            if match(key, each):
                link.send(self, link.near.add_token, replies, each)  # type: ignore[attr-defined]
        link.send(self, replies.finish)

    def liveliness(self) -> SimpleNamespace:
        return SimpleNamespace(get=self._get_tokens)

    def _get_tokens(self, key: str, handler: object = None, timeout: float = 10.0) -> Replies:
        if self.closed:
            raise zenoh.ZError("simulated: session closed")
        replies = Replies(timeout, self.process)
        for each in self._tokens():
            if match(str(key), each):
                replies.add(Sample(each))
        current().after(LATENCY_S, self.process.call, replies.finish)
        return replies

    def put(self, key: str, payload: bytes, encoding: object = "", **_: object) -> None:
        for link in self.clients:
            link.send(self, link.near.take, Sample(str(key), payload, encoding))  # type: ignore[attr-defined]

    # questions

    def ask(self, question: Question) -> None:
        for router in self._reached():
            for target in router.clients:
                asks = target is not question.link and any(
                    match(question.key, key) for key in target.queryables.values()
                )
                if asks:
                    question.left[target] = router
        if not question.left:
            question.link.send(self, question.replies.finish)
            return
        self._questions.append(question)
        for target, router in list(question.left.items()):
            self.relay(router, router.put_to, target, question, self)

    def put_to(self, target: Link, question: Question, origin: Router) -> None:
        target.send(self, target.near.answer, target, question, origin)  # type: ignore[attr-defined]

    def reply(self, question: Question, answer: Sample, failed: bool) -> None:
        question.link.send(self, question.replies.add, answer, failed)

    def finish(self, question: Question, target: Link) -> None:
        """A client has answered, or is gone."""
        question.left.pop(target, None)
        if not question.left and question in self._questions:
            self._questions.remove(question)
            question.link.send(self, question.replies.finish)


# ---------------------------------------------------------------------- clients


class Session(Node):
    """The session of a client: it connects to the first router that answers, and again when it has lost that one."""

    def __init__(self, network: Network, lease_s: float, settings: Mapping[str, Any]) -> None:
        super().__init__(network, lease_s)
        self.name = (settings["metadata"] or {}).get("name", "")
        self._endpoints, self._limit_s = (
            settings["connect/endpoints"],
            settings["transport/unicast/open_timeout"] / 1000.0,
        )
        self.link: Link | None = None
        self.subscribers: list[Subscriber] = []
        self.watches: list[Subscriber] = []
        self.queryables: list[Subscriber] = []
        self.tokens: list[Token] = []
        self._remote: dict[str, None] = {}  # keys of tokens of the router that are watched
        self._told: dict[str, None] = {}  # keys of tokens that have appeared to watches
        self._questions: list[Replies] = []
        self._routes: dict[str, list[Subscriber]] = {}
        far: Callable[[], list[Node]] = lambda: [] if self.link is None else [self.link.far]  # noqa: E731
        self.info = SimpleNamespace(
            routers_zid=lambda: [each.zid() for each in far()],
            transports=lambda: [SimpleNamespace(whatami=ROUTER) for _ in far()],
            peers_zid=list,
            links=list,
            zid=self.zid,
        )
        network.sessions.append(self)
        if not self._connected():
            self.die()
            raise zenoh.ZError("simulated: no router answers")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if not self.closed:
            preempt()
            self.die()

    def die(self) -> None:
        super().die()
        if self in self.network.sessions:
            self.network.sessions.remove(self)
        for replies in self._questions:
            replies.finish()

    def hang_up(self) -> None:
        """End the connection, without waiting for the network."""
        if self.link is not None:
            self.link.close(self)

    def _connected(self) -> bool:
        """Try each endpoint; one that does not answer takes its time."""
        for endpoint in self._endpoints:
            begun = current().now
            block(SHAKE_S)
            while (router := self.network.at(endpoint)) is not None and current().now - begun < self._limit_s:
                if self.closed:
                    return False
                if not self.silent and not router.silent:
                    self._begin(router)
                    return True
                block(LOOK_S)
        return False

    def _reconnect(self) -> None:
        wait_s = 0.1
        while not self.closed and not self._connected():
            block(wait_s)
            wait_s = min(0.5, 1.5 * wait_s)

    def _begin(self, router: Router) -> None:
        self.link = Link(self, router)
        router.welcome(self.link)
        things: list[Subscriber | Token] = [*self.subscribers, *self.queryables, *self.tokens]
        for each in things:
            self._declare(each, each.key)
        self._send(router.change)

    def lost(self, link: Link) -> None:
        self.link = None
        if self.closed:
            return
        questions, self._questions = self._questions, []
        for replies in questions:
            replies.finish()
        gone, self._remote = self._remote, {}
        for key in gone:  # tokens of this session, which the router had as well, seem to vanish too
            self._tell(key, False)
        Task(self.process, self._reconnect, "reconnect")

    def _send(self, call: Callable[..., object], *args: Any, drop: bool = False, express: bool = False) -> None:
        if self.link is not None:
            self.link.send(self, call, *args, drop=drop, express=express)

    def _declare(self, thing: Subscriber | Token, key: str | None) -> None:
        if (link := self.link) is not None:
            table = link.tokens if isinstance(thing, Token) else getattr(link, thing.table)
            link.send(self, link.far.declare, link, table, thing, key)  # type: ignore[attr-defined]

    def drop(self, thing: Subscriber) -> None:
        for table in (self.subscribers, self.queryables, self.watches):
            if thing in table:
                table.remove(thing)
        self._routes.clear()
        if thing.table:
            self._declare(thing, None)

    # publishers and subscribers

    def declare_subscriber(self, key: object, handler: Any = None, **_: object) -> Subscriber:
        preempt()
        made = Subscriber(self, str(key), handler, "subscribers")
        self.subscribers.append(made)
        self._routes.clear()
        self._declare(made, made.key)
        return made

    def declare_queryable(self, key: object, handler: Any, **_: object) -> Subscriber:
        preempt()
        made = Subscriber(self, str(key), handler, "queryables")
        self.queryables.append(made)
        self._declare(made, made.key)
        return made

    def declare_publisher(
        self, key: object, encoding: object = "", congestion_control: Any = None, express: bool = False, **_: object
    ) -> Publisher:
        drop = congestion_control == zenoh.CongestionControl.DROP
        return Publisher(self, str(key), encoding, drop=drop, express=express)

    def put(self, key: object, payload: bytes, encoding: object = "", **_: object) -> None:
        self.send(Sample(str(key), payload, encoding))

    def send(self, sample: Sample, *, drop: bool = False, express: bool = False) -> None:
        if self.closed:
            raise zenoh.ZError("simulated: session closed")
        preempt()
        self.take(sample)
        if (link := self.link) is not None:
            link.send(self, link.far.forward, link, sample, drop, express, drop=drop, express=express)  # type: ignore[attr-defined]

    def take(self, sample: Sample) -> None:
        key = sample.key_expr
        if (found := self._routes.get(key)) is None:
            found = self._routes[key] = [each for each in self.subscribers if match(each.key, key)]
        for each in found:
            each.push(sample)

    # liveliness

    def liveliness(self) -> SimpleNamespace:
        return SimpleNamespace(
            declare_token=self.declare_token, declare_subscriber=self.watch_tokens, get=self.get_tokens
        )

    def declare_token(self, key: object) -> Token:
        preempt()
        token = Token(self, str(key))
        self.tokens.append(token)
        self._declare(token, token.key)
        self._tell(token.key, True)
        return token

    def withdraw(self, token: Token) -> None:
        preempt()
        if token in self.tokens:
            self.tokens.remove(token)
            self._declare(token, None)
            if token.key not in self._remote and all(each.key != token.key for each in self.tokens):
                self._tell(token.key, False)

    def watch_tokens(self, key: object, handler: Any, history: bool = False) -> Subscriber:
        watch = Subscriber(self, str(key), handler, "")
        self.watches.append(watch)
        if history:
            for each in [each for each in self._told if match(watch.key, each)]:
                watch.push(Sample(each))
            for token in self.tokens:
                self._tell(token.key, True)
            if (link := self.link) is not None:
                link.send(self, link.far.repeat, link)  # type: ignore[attr-defined]
        return watch

    def get_tokens(self, key: object, handler: object = None, timeout: float = 10.0) -> Replies:
        """Tokens that match: those that this session knows at once, then those that the router lists besides.

        As with Zenoh, tokens that a new watch hears of while the question is on its way are in neither part.
        """
        replies = self._asked(timeout)
        watching = self.link is not None and any(match(watch.key, str(key)) for watch in self.watches)
        if watching and self.network.forgets and current().rng.random() < self.network.forgets:
            key = "-"  # a key that no token has
        known = [each for each in {token.key: None for token in self.tokens} | self._remote if match(str(key), each)]
        for each in known:
            replies.add(Sample(each))
        if (link := self.link) is not None:
            link.send(self, link.far.list_tokens, link, str(key), replies)  # type: ignore[attr-defined]
        else:
            replies.finish()
        return replies

    def add_token(self, replies: Replies, key: str) -> None:
        if key not in self._remote and all(token.key != key for token in self.tokens):
            replies.add(Sample(key))

    def show(self, key: str, there: bool) -> None:
        """The router has, or has no longer, a token; those of this session are among its tokens as well."""
        if there and any(match(watch.key, key) for watch in self.watches):
            self._remote[key] = None
            self._tell(key, True)
        elif key in self._remote:
            del self._remote[key]
            if all(token.key != key for token in self.tokens):
                self._tell(key, False)

    def _tell(self, key: str, there: bool) -> None:
        """Tell the watches of a token, of one that has appeared once."""
        watches = [watch for watch in self.watches if match(watch.key, key)]
        if there and (key in self._told or not watches):
            return
        if there:
            self._told[key] = None
        else:
            self._told.pop(key, None)
        for watch in watches:
            watch.push(Sample(key, deleted=not there))

    # questions

    def _asked(self, limit_s: float) -> Replies:
        replies = Replies(limit_s, self.process)
        self._questions = [each for each in self._questions if not each.over] + [replies]
        return replies

    def get(
        self,
        selector: object,
        handler: object = None,
        payload: Any = None,
        encoding: object = "",
        timeout: float = 10.0,
        **_: object,
    ) -> Replies:
        preempt()
        replies = self._asked(timeout)
        if (link := self.link) is None:
            replies.finish()
        else:
            link.send(self, link.far.ask, Question(link, replies, str(selector), payload, str(encoding)))  # type: ignore[attr-defined]
        return replies

    def answer(self, link: Link, question: Question, origin: Router) -> None:
        """A question arrives: each queryable that matches gets it."""
        found = [each for each in self.queryables if match(each.key, question.key)]
        left = Left(len(found), lambda: link.send(self, link.far.relay, origin, origin.finish, question, link))  # type: ignore[attr-defined]
        for each in found:
            each.push(Query(self, link, question, origin, left))
        if not found:
            left.end()


class Left:
    """Answers that are still to come, and what happens after the last."""

    def __init__(self, count: int, after: Callable[[], object]) -> None:
        self._count, self._after = count, after

    def end(self) -> None:
        self._count -= 1
        if self._count <= 0:
            self._after()


class Subscriber:
    """A subscriber of samples or tokens, or a queryable: what arrives waits in a ring, or goes to a callback."""

    def __init__(self, session: Session, key: str, handler: Any, table: str) -> None:
        self.session, self.key, self.table, self.handler = session, key, table, self
        depth = getattr(handler, "depth", None)
        self._waiting: deque[Any] = deque(maxlen=depth)
        self.push: Callable[[Any], object] = handler if callable(handler) else self._waiting.append

    def try_recv(self) -> Any:
        current().step()
        return self._waiting.popleft() if self._waiting else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.undeclare()

    def undeclare(self) -> None:
        self.session.drop(self)


class Token:
    """A liveliness token."""

    def __init__(self, session: Session, key: str) -> None:
        self.session, self.key = session, key

    def undeclare(self) -> None:
        self.session.withdraw(self)


class Publisher:
    def __init__(self, session: Session, key: str, mime: object, *, drop: bool = True, express: bool = False) -> None:
        self.session, self.key, self._mime, self._drop, self._express = session, key, mime, drop, express
        self.id = Id(zid=session.zid(), eid=next(session.network.numbers))

    def put(self, payload: bytes, *, encoding: object = None, source_info: Any = None, **_: object) -> None:
        sample = Sample(self.key, payload, encoding or self._mime, source_info)
        self.session.send(sample, drop=self._drop, express=self._express)

    def undeclare(self) -> None:
        pass


class Replies:
    """Replies to a question, to be polled or waited for; a question that is lost ends as one that is answered."""

    def __init__(self, limit_s: float, process: Process) -> None:
        self.over = False
        self._items: deque[SimpleNamespace] = deque()
        self._waiters = Waiters()
        self._call: Callable[[Sample], object] | None = None
        self._after: Callable[[], object] | None = None
        current().after(limit_s, process.call, self._expire)

    def then(self, call: Callable[[Sample], object], after: Callable[[], object]) -> None:
        """Give each good reply to a function, and call another at the end."""
        self._call, self._after = call, after
        if self.over:
            after()

    def add(self, sample: Sample, failed: bool = False) -> None:
        if self.over:
            return
        if self._call is not None:
            if not failed:
                self._call(sample)
            return
        self._items.append(SimpleNamespace(ok=None if failed else sample, err=sample if failed else None))
        self._waiters.wake()

    def finish(self) -> None:
        if not self.over:
            self.over = True
            if self._after is not None:
                self._after()
            self._waiters.wake()

    def _expire(self) -> None:
        self.add(Sample("", b"Timeout", "text/plain"), failed=True)
        self.finish()

    def try_recv(self) -> Any:
        current().step()
        if self._items:
            return self._items.popleft()
        if self.over:
            raise zenoh.ZError("simulated: no more replies")
        return None

    def __iter__(self) -> Iterator[Any]:
        while True:
            if self._items:
                yield self._items.popleft()
            elif self.over:
                return
            else:
                self._waiters.wait()


class Query:
    """A question at the one who answers; it ends with its `with` block."""

    def __init__(self, session: Session, link: Link, question: Question, origin: Router, left: Left) -> None:
        self._session, self._link, self._question, self._origin, self._left = session, link, question, origin, left
        self.key_expr, self.parameters, self.encoding = question.key, question.parameters, question.mime
        self.payload = None if question.payload is None else Payload(question.payload)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.drop()

    def drop(self) -> None:
        left, self._left = self._left, Left(2, lambda: None)
        left.end()

    def reply(self, key: object, payload: bytes, encoding: object = "", **_: object) -> None:
        self.send(Sample(str(key), payload, encoding))

    def reply_err(self, payload: bytes, encoding: object = "", **_: object) -> None:
        self.send(Sample("", payload, encoding), failed=True)

    def send(self, sample: Sample, *, failed: bool = False) -> None:
        router: Any = self._link.far
        self._link.send(self._session, router.relay, self._origin, self._origin.reply, self._question, sample, failed)


# ---------------------------------------------------------------------- advanced publishers and subscribers


class AdvancedPublisher(Publisher):
    """A publisher that numbers its samples and answers for the last of them."""

    def __init__(self, session: Session, key: str, mime: object, kept: int) -> None:
        super().__init__(session, key, mime)
        self._cache: deque[Sample] = deque(maxlen=kept)
        self._count = itertools.count()
        self._beating, self._since = False, current().now
        self._place = f"{key}/@adv/pub/{self.id}/_"
        self._queryable = session.declare_queryable(self._place, self._answer)
        self._token = session.declare_token(self._place)

    def put(self, payload: bytes, *, encoding: object = None, **_: object) -> None:
        sample = Sample(self.key, payload, encoding or self._mime, source_info(self.id, next(self._count)))
        self._cache.append(sample)
        if not self._beating:
            self._beating = True
            past = (current().now - self._since) % HEARTBEAT_S
            current().after(HEARTBEAT_S - past, self.session.process.call, self._beat)
        self.session.send(sample, drop=self._drop)

    def undeclare(self) -> None:
        self._token.undeclare()
        self._queryable.undeclare()

    def _beat(self) -> None:
        self._beating = False
        if not self.session.closed:
            number = self._cache[-1].source_info.source_sn
            self.session.send(Sample(self._place, str(number).encode()), drop=True)

    def _answer(self, query: Query) -> None:
        asked = dict(each.partition("=")[::2] for each in query.parameters.split(";"))
        first, _, last = asked.get("_sn", "..").partition("..")
        found = [
            each
            for each in self._cache
            if int(first or 0) <= each.source_info.source_sn <= int(last or each.source_info.source_sn)
        ]
        with query:
            for each in found[-int(asked.get("_max", 0)) :]:
                query.send(each)


class Source:
    """What an advanced subscriber knows of a publisher: number of the last sample, and samples that wait for others."""

    def __init__(self) -> None:
        self.last: int | None = None
        self.questions = 0
        self.waiting: dict[int, Sample] = {}


class AdvancedSubscriber:
    """A subscriber that asks for the last `kept` samples of each publisher, and for those that were lost."""

    def __init__(self, session: Session, key: str, handler: Any, kept: int) -> None:
        self._session, self._kept = session, kept
        self.handler = Subscriber(session, key, handler, "")
        self._sources: dict[str, Source] = {}
        self._first = 1  # pending questions for the first samples
        self._parts = [session.declare_subscriber(key, self._take)]
        self._ask(f"{key}/@adv/pub/**", f"_max={kept}", None)
        self._parts.append(session.watch_tokens(f"{key}/@adv/pub/**", self._discover, history=True))
        self._parts.append(session.declare_subscriber(f"{key}/@adv/pub/**", self._hear))

    def undeclare(self) -> None:
        for each in self._parts:
            each.undeclare()

    def _ask(self, key: str, parameters: str, source: Source | None) -> None:
        def done() -> None:
            if source is None:
                self._first -= 1
            else:
                source.questions -= 1
            for each in self._sources.values() if source is None else (source,):
                self._flush(each)

        self._session.get(f"{key}?{parameters}", timeout=HISTORY_S).then(self._sort, done)

    def _discover(self, sample: Sample) -> None:
        """A publisher has appeared, or is back."""
        if sample.kind == zenoh.SampleKind.PUT:
            source = self._source(sample.key_expr)
            source.questions += 1
            self._ask(sample.key_expr, f"_max={self._kept}", source)

    def _hear(self, beat: Sample) -> None:
        source, number = self._source(beat.key_expr), int(beat.payload)
        if (source.last is None or number > source.last) and number not in source.waiting:
            source.questions += 1
            self._ask(beat.key_expr, f"_sn={'' if source.last is None else source.last + 1}..{number}", source)

    def _source(self, place: str) -> Source:
        zid, number = place.split("/@adv/pub/")[1].split("/")[:2]
        return self._sources.setdefault(f"{zid}/{number}", Source())

    def _take(self, sample: Sample) -> None:
        self._sort(sample)
        if sample.source_info is None:
            return
        name = str(sample.source_info.source_id)
        source = self._sources[name]
        if source.waiting and not source.questions:
            source.questions += 1
            self._ask(f"{sample.key_expr}/@adv/pub/{name}/**", f"_sn={(source.last or 0) + 1}..", source)

    def _sort(self, sample: Sample) -> None:
        """Pass a sample on, keep it until those before it are here, or drop it as a repetition."""
        if sample.source_info is None:
            self.handler.push(sample)
            return
        number = sample.source_info.source_sn
        source = self._sources.setdefault(str(sample.source_info.source_id), Source())
        if self._first:
            source.waiting[number] = sample
        elif source.last is not None and number != source.last + 1:
            if number > source.last:
                source.waiting[number] = sample
        else:
            self._pass(source, sample)
            while (following := source.waiting.pop((source.last or 0) + 1, None)) is not None:
                self._pass(source, following)

    def _pass(self, source: Source, sample: Sample) -> None:
        source.last = sample.source_info.source_sn
        self.handler.push(sample)

    def _flush(self, source: Source) -> None:
        """All questions are answered: samples that are still missing are lost."""
        if not self._first and not source.questions:
            waiting, source.waiting = source.waiting, {}
            for number in sorted(waiting):
                if source.last is None or number > source.last:
                    self._pass(source, waiting[number])
