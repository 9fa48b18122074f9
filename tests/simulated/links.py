"""Samples, and the TCP connections that carry them between simulated clients and routers. Time is in seconds.

A link keeps the order, and holds what is sent into a cut or to a frozen process. An end that has received nothing for
the lease of the other one closes it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import lru_cache
from math import log
from typing import TYPE_CHECKING, Any, Final, Self

import zenoh

from tests.simulated.kernel import current

if TYPE_CHECKING:
    from tests.simulated.network import Network

LATENCY_S: Final = 0.0003  # mean time of a message on a link
FLUSH_S: Final = 0.001  # time from the mending of a cable until what it held arrives
REORDERED_S: Final = 0.1  # longest delay of a message that others overtake
LATELY_S: Final = 0.05  # the rules look that often
REPEATED_S: Final = 0.2  # longest time until the copy of a message arrives
PUT, DELETE = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE


@lru_cache(8192)
def match(expression: str, other: str) -> bool:
    return bool(zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(other)))


class Id(str):
    """Id of an entity of a session: session `zid` and number."""

    zid: str

    def __new__(cls, zid: str, number: int) -> Self:
        made = super().__new__(cls, f"{zid}/{number}")
        made.zid = zid
        return made


class SourceInfo:
    """As `zenoh.SourceInfo`."""

    __slots__ = "source_id", "source_sn"

    def __init__(self, source_id: Id, source_sn: int) -> None:
        self.source_id, self.source_sn = source_id, source_sn


class Payload(bytes):
    to_bytes = bytes.__bytes__


class Sample:
    timestamp = attachment = None

    def __init__(
        self, key: str, payload: bytes = b"", mime: object = "", source: Any = None, *, deleted: bool = False
    ) -> None:
        self.key_expr, self.payload, self.encoding, self.source_info = key, Payload(payload), str(mime), source
        self.kind = DELETE if deleted else PUT


class Ring:
    """As `zenoh.handlers.RingChannel`; of other channels the depth is not limited."""

    def __init__(self, depth: int) -> None:
        self.depth = depth


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
        parted: True while the network is split between its ends; see `Network.split`.
    """

    def __init__(self, near: Node, far: Node) -> None:
        self.near, self.far, self.since = near, far, current().now
        self.parted = False
        self.subscribers: dict[Any, str] = {}
        self.queryables: dict[Any, str] = {}
        self.tokens: dict[Any, str] = {}
        self.shown: dict[str, None] = {}
        self._open = {near: True, far: True}
        self._due = dict.fromkeys(self._open, self.since)  # arrival of the last message at each end
        self._sent = dict.fromkeys(self._open, self.since)  # time at which each end sent last
        self._held: dict[Node, list[tuple[Any, ...]]] = {near: [], far: []}
        self._silences: dict[Node, int] = {near: 0, far: 0}  # number of the present silence of each end
        self._counter = itertools.count(1)
        near.links.append(self)
        far.links.append(self)

    def open(self) -> bool:
        """Whether both ends are open."""
        return all(self._open.values())

    @property
    def out(self) -> bool:
        """Whether nothing passes now; it is held."""
        return self.near.cut or self.far.cut or self.parted

    def arrives(self, node: Node) -> bool:
        """Whether messages to an end are under way, or came lately."""
        return self._due[node] > current().now - LATELY_S

    def other(self, node: Node) -> Node:
        return self.far if node is self.near else self.near

    def send(
        self, sender: Node, call: Callable[..., object], *args: Any, drop: bool = False, express: bool = False
    ) -> None:
        """Call a function at the other end, in the order of all calls; it may be lost if `drop`."""
        if not self._open[sender]:
            return
        kernel, to = sender.process.kernel, self.far if sender is self.near else self.near
        now, rng = kernel.now, kernel.rng
        self._sent[sender] = now
        if drop and (sender.loss or to.loss) and rng.random() < max(sender.loss, to.loss):
            return
        due = now + LATENCY_S * sender.slow * to.slow * (0.3 - log(1.0 - rng.random()))  # exponentially distributed
        if drop and to.reorder and rng.random() < to.reorder:
            due += rng.random() * REORDERED_S
        elif not express:
            if due < (last := self._due[to]):
                due = last
            self._due[to] = due
        kernel.at(due, self._arrive, to, call, args)
        if drop and to.dup and rng.random() < to.dup:
            kernel.at(due + rng.random() * REPEATED_S, self._arrive, to, call, args)

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
            if not (self.out or sender.process.paused):
                self._silences[to] = 0
            elif not self._silences[to]:
                number = self._silences[to] = next(self._counter)
                beat_s = sender.lease_s / 4.0  # a sign of life is sent after this time without another message
                heard = now - (now - self._sent[sender]) % beat_s
                current().at(heard + sender.lease_s, to.process.call, self._expire, to, number)
        if not self.out:
            current().after(FLUSH_S, self._flush)

    def _expire(self, to: Node, number: int) -> None:
        if self._silences[to] == number:
            self.close(to)

    def _arrive(self, to: Node, call: Callable[..., object], args: tuple[Any, ...]) -> None:
        if self.near.cut or self.far.cut or self.parted or self._held[to]:
            self._held[to].append((call, args))
        elif not self._open[to]:
            return
        elif to.process.paused:
            to.process.call(self._receive, to, call, args)
        else:
            to.process.call(call, *args)

    def _receive(self, to: Node, call: Callable[..., object], args: tuple[Any, ...]) -> None:
        """Deliver samples that arrived while a process was suspended, as it goes on."""
        if self._open[to]:
            call(*args)

    def _flush(self) -> None:
        if not self.out:
            for to, held in self._held.items():
                self._held[to] = []
                self._due[to] = max(self._due[to], current().now if held else 0.0)
                for call, args in held:
                    self._arrive(to, call, args)
