"""A Zenoh network without Zenoh: what `agents.network.session` hands out, fed by hand; no time is lost on a wire."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Self
from unittest import mock

import zenoh
from zenoh.handlers import Callback


class Payload(bytes):
    def to_bytes(self) -> bytes:
        return self


class Sample:
    timestamp = attachment = source_info = None

    def __init__(self, key: str, mime: str, data: bytes, *, gone: bool = False) -> None:
        self.key_expr, self.encoding, self.payload = key, mime, Payload(data)
        self.kind = zenoh.SampleKind.DELETE if gone else zenoh.SampleKind.PUT


class Query(Sample):
    """A question; every one must be answered, but for those of tools that read all keys: they hold no order."""

    answers = 0
    answer: tuple[str, bytes, str] | None = None  # key, payload and encoding of a reply
    error: bytes | None = None  # payload of a refusal

    def __enter__(self) -> Query:
        return self

    def __exit__(self, *_: object) -> None:
        reads_all = "*" in self.key_expr and not self.payload
        assert self.answers == (0 if reads_all else 1), "a query without an answer"

    def reply(self, key: str, payload: bytes, encoding: str = "") -> None:
        self._count(payload, encoding)
        self.answer = (key, payload, encoding)

    def reply_err(self, payload: bytes, encoding: str = "") -> None:
        self._count(payload, encoding)
        self.error = payload

    def _count(self, payload: bytes, encoding: str) -> None:
        assert isinstance(payload, bytes)
        assert encoding
        self.answers += 1


class Reply:
    def __init__(self, sample: Sample, *, good: bool) -> None:
        self.ok, self.err = (sample, None) if good else (None, sample)


class Channel:
    """The end of a key that listens."""

    def __init__(self, key: str, *, asked: bool = False, depth: int = 64) -> None:
        self.key, self.asked, self.expression = key, asked, zenoh.KeyExpr(key)
        self.queue: deque[Sample] = deque(maxlen=depth)
        self.handler = self
        self.obey: Callable[[Sample], object] = lambda _sample: None

    def try_recv(self) -> Sample | None:
        return self.queue.popleft() if self.queue else None

    def add(self, sample: Sample) -> None:
        self.queue.append(sample)
        self.obey(sample)

    def undeclare(self, *_: object) -> None:
        self.queue.clear()

    def __enter__(self) -> Self:
        return self

    close = __exit__ = undeclare


class _Closing:
    """What may be closed, and stays as it is."""

    def __enter__(self) -> Self:
        return self

    def close(self, *_: object) -> None:
        pass

    __exit__ = undeclare = close


class Mute(_Closing):
    """The end of a key that speaks, a token, a last value: nobody listens."""

    queue = ()

    def put(self, payload: bytes, **_: object) -> None:
        assert isinstance(payload, bytes)

    hold = put

    def answer(self) -> int:
        return 0


class Token(Mute):
    """A token of the own session, which is in each answer about its key."""

    def __init__(self, tokens: list[str], key: str) -> None:
        self._tokens, self._key = tokens, key
        tokens.append(key)

    def undeclare(self, *_: object) -> None:
        if self._key in self._tokens:
            self._tokens.remove(self._key)


class Attentive:
    """A router that always answers."""

    heard = True

    def __init__(self, *_: object) -> None: ...

    @staticmethod
    def silent_since(_t: float, _arrived: int = 0) -> float:
        return math.inf


class Session(_Closing):
    """Session, in the parts that zenpark uses."""

    def __init__(self, net: Net) -> None:
        self._net = net
        self.zid = lambda: "f00d"
        self.liveliness = lambda: self
        self.info = SimpleNamespace(declare_transport_events_listener=lambda *_, **__: Mute())
        self.declare_publisher = lambda *_, **__: Mute()

    def declare_subscriber(self, key: str, handler: object = None, **_: object) -> Channel:
        return self._net.listen(key, handler)

    def declare_queryable(self, key: str, handler: object, **_: object) -> Channel:
        return self._net.listen(key, handler, asked=True)

    def declare_token(self, key: str) -> Token:
        return Token(self._net.tokens, key)

    def get(self, key: str, *_: object, **__: object) -> list[Reply]:
        asked = expression(str(key).partition("?")[0])
        own = [token for token in self._net.tokens if asked is not None and asked.intersects(zenoh.KeyExpr(token))]
        return [*self._net.replies, *(Reply(Sample(token, "", b""), good=True) for token in own)]


@lru_cache(4096)
def expression(key: str) -> zenoh.KeyExpr | None:
    """A key expression, if it is one: no other arrives."""
    try:
        return zenoh.KeyExpr(key)
    except zenoh.ZError:
        return None


class Net:
    """Every channel that was declared.

    Attributes:
        first: What waits for whoever subscribes, by key.
        replies: What every question is answered with, besides `tokens` that it asks for.
        tokens: Keys of the tokens of the session.
    """

    def __init__(self) -> None:
        self.channels: list[Channel] = []
        self.first: dict[str, Sample] = {}
        self.replies: list[Reply] = []
        self.tokens: list[str] = []
        self.session = Session(self)
        self.forget = self.channels.clear

    def listen(self, key: str, handler: object = None, *, asked: bool = False) -> Channel:
        """The end of a key; its samples are given to `handler` as well if that is a callback."""
        made = Channel(key, asked=asked)
        if isinstance(handler, Callback):
            made.obey = handler
        self.channels.append(made)
        if key in self.first:
            made.add(self.first[key])
        return made

    def deliver(self, data: bytes, *, gone: bool = False) -> None:
        """Key, MIME type and payload, with zero bytes between them; a key that is none becomes somebody's."""
        raw, mime, payload, *_ = *data.split(b"\0", 2), b"", b""
        key, kind = raw.decode("utf-8", "replace"), mime.decode("utf-8", "replace")
        there = expression(key)
        if there is None:
            if not self.channels:
                return
            key = self.channels[len(data) % len(self.channels)].key.replace("**", "x/y").replace("*", "KH01")
            there = zenoh.KeyExpr(key)
        for channel in self.channels:
            if channel.expression.intersects(there):
                make: Callable[..., Sample] = Query if channel.asked else Sample
                channel.add(make(key, kind, payload, gone=gone))

    @contextmanager
    def worn(self) -> Iterator[Net]:
        """`agents.network` has this network: advanced publishers and subscribers are plain, nobody asks for values."""
        declared: dict[str, Any] = {
            "declare_advanced_publisher": lambda *_, **__: Mute(),
            "declare_advanced_subscriber": lambda _session, key, handler, **_: self.listen(key, handler),
            "NumberedPublisher": lambda *_: Mute(),
            "LastValue": lambda *_: Mute(),
        }
        opened: dict[str, Any] = {
            "connected": lambda _session: True,
            "RouterWatch": Attentive,
            "open_session": lambda *_, **__: self.session,
        }
        with (
            mock.patch.multiple("agents.network.pubsub", **declared),
            mock.patch.multiple("agents.network.session", **opened),
        ):
            yield self
