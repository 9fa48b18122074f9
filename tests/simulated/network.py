"""A Zenoh network of one to three routers: what `zenoh.Session` does, as far as zenpark uses it, on simulated time.

A router has tables of what its clients have declared and passes all on; without it a client has its own declarations
alone. Time is in seconds.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from math import inf
from types import SimpleNamespace
from typing import Any, Final, Self

import zenoh

from tests.simulated.entities import Left, Publisher, Query, Replies, Subscriber, Token
from tests.simulated.kernel import Process, Task, block, current, preempt
from tests.simulated.links import DELETE, LATENCY_S, PUT, Link, Node, Sample, match

SHAKE_S: Final = 0.003  # time to open a link
LOOK_S: Final = 0.01  # pause of two looks whether an end that is cut off, or frozen, answers at last
SETTINGS: Final = (
    "mode", "connect/endpoints", "listen/endpoints", "metadata",
    "transport/link/tx/lease", "transport/unicast/open_timeout",
)  # fmt: skip
ROUTER, CLIENT = zenoh.WhatAmI.ROUTER, zenoh.WhatAmI.CLIENT


def _nobody(_: str) -> bool:
    return False


class Network:
    """All nodes, with the endpoints that routers listen on.

    Attributes:
        beyond: Whether the process of a name is on the far side of a split.
        healed: Time at which the last split healed [s].
        forgets: Probability that a question for tokens, of a session that watches the same keys, has an empty answer
            (`findings/zenoh-liveliness-get-beside-subscriber.sh`).
    """

    def __init__(self) -> None:
        self.sessions: list[Session] = []
        self.routers: list[Router] = []
        self.numbers = itertools.count(1)
        self.forgets = 0.0
        self.beyond: Callable[[str], bool] = _nobody
        self.healed = -inf
        self.lifelines_cut = False

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

    def split(self, beyond: Callable[[str], bool] | None, *, lifelines: bool = False) -> None:
        """Let nothing pass between processes that are `beyond`, by their names, and all others; None: it heals.

        `lifelines` go through it as well, as those of ssh do.
        """
        if beyond is None:
            self.healed = current().now
        self.beyond, self.lifelines_cut = beyond or _nobody, lifelines
        for link in {id(link): link for node in (*self.sessions, *self.routers) for link in node.links}.values():
            link.parted = self.parts(link.near, link.far)
            link.look()

    def cuts_lifeline(self, one: Process, other: Process) -> bool:
        """Whether a split cuts the lifeline between two processes."""
        return self.lifelines_cut and self.beyond(one.name) != self.beyond(other.name)

    def parts(self, one: Node, other: Node) -> bool:
        """Whether a split is between two nodes."""
        return self.beyond(one.process.name) != self.beyond(other.process.name)

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
                if other is not None and not (self.silent or other.silent or self.network.parts(self, other)):
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

    def path_to(self, target: Router) -> Link | None:
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
        """The router itself, and those that it is linked with."""
        return [self, *(each for each in self.network.routers if each is not self and self.path_to(each) is not None)]

    def relay(self, target: Router, call: Callable[..., object], *args: Any) -> None:
        """Call a function at another router, or here."""
        if target is self:
            call(*args)
        elif (link := self.path_to(target)) is not None:
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
        self._link_listeners: list[Callable[[Any], object]] = []
        self.info = SimpleNamespace(
            routers_zid=lambda: [] if self.link is None else [self.link.far._zid],
            transports=lambda: [] if self.link is None else [SimpleNamespace(whatami=ROUTER)],
            peers_zid=list,
            links=list,
            zid=self.zid,
            declare_transport_events_listener=self._follow_link,
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
                if not (self.silent or router.silent or self.network.parts(self, router)):
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
        self._tell_of_link(self.link, PUT)
        router.welcome(self.link)
        things: list[Subscriber | Token] = [*self.subscribers, *self.queryables, *self.tokens]
        for each in things:
            self._declare(each, each.key)
        self._send(router.change)

    def _follow_link(self, listener: Callable[[Any], object], *, history: bool = False) -> object:
        self._link_listeners.append(listener)
        if self.link is not None and history:
            self._tell_of_link(self.link, PUT)
        return listener

    def _tell_of_link(self, link: Link, kind: zenoh.SampleKind) -> None:
        for listener in self._link_listeners:
            listener(SimpleNamespace(kind=kind, transport=SimpleNamespace(zid=link.far.zid())))

    def lost(self, link: Link) -> None:
        self.link = None
        if self.closed:
            return
        self._tell_of_link(link, DELETE)
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
