"""Looking at the network: who is there (`keys`), what is said (`echo`), how often (`hz`)."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec
import zenoh

from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.messages import JSON, MSGPACK
from agents.network.pubsub import pose_subscriber, subscriber
from agents.network.session import open_session, received

WAIT_S: Final = 1.0  # for a router that is on this machine or not at all
POLL_S: Final = 0.02
DEPTH: Final = 8192  # samples between two polls

Printer = Callable[[str], None]


def at_once(line: str) -> None:
    """Prints a line without delay, into a pipe too."""
    print(line, flush=True)


class KeyExpressionError(ValueError):
    """Not a key expression of Zenoh."""


class Member(msgspec.Struct):
    """A session on the network: its name, its Zenoh id, and the keys that it holds."""

    name: str
    id: str
    alive: list[str] = []
    publishers: list[str] = []
    subscribers: list[str] = []
    queryables: list[str] = []


_KINDS: Final = {"token": "alive", "publisher": "publishers", "subscriber": "subscribers", "queryable": "queryables"}


def key_expression(text: str) -> str:
    """The text, if it is a key expression.

    Raises:
        KeyExpressionError: If not, saying why.
    """
    try:
        return str(zenoh.KeyExpr(text))
    except zenoh.ZError as error:
        why = str(error).partition(" at /")[0].partition("`: ")[2]
        raise KeyExpressionError(f"'{text}' is not a key expression: {why}. Write it like park/*/pose") from None


def members(session: zenoh.Session, timeout_s: float = 2.0) -> list[Member]:
    """Who is on the network, by name, from the admin space of routers and members of a mesh, without `session` itself.

    A frozen process is still listed, for its router knows it; only its name is then unknown.
    """
    held: dict[str, dict[str, list[str]]] = {}
    places = [*_admin(session, "@/*/router/**", timeout_s), *_admin(session, "@/*/peer/**", timeout_s)]
    for place, value in places:
        _, _, mode, kind, key = (*place.split("/", 4), *[""] * 4)[:5]
        if kind not in _KINDS or not isinstance(value, dict):
            continue
        # a member of a mesh tells of its neighbours too, but not all of it; its own it calls those of a client
        of_peers = _words(value.get("peers")) if mode == "router" else []
        for owner in {*_words(value.get("clients")), *of_peers}:
            held.setdefault(owner, {}).setdefault(_KINDS[kind], []).append(key)
    names = {
        place.split("/")[1]: _name(value)
        for place, value in _admin(session, "@/*/*", timeout_s)
        if isinstance(value, dict) and "/" in place
    }
    mine = str(session.zid())
    everyone = (held.keys() | names.keys()) - {mine}
    found = [
        Member(names.get(owner) or "?", owner, **{kind: sorted(keys) for kind, keys in held.get(owner, {}).items()})
        for owner in everyone
    ]
    return sorted(found, key=lambda member: (member.name, member.id))


def _words(value: object) -> list[str]:
    """The words of a list, if it is one: what stands in the admin space is another program's."""
    return [word for word in value if isinstance(word, str)] if isinstance(value, list) else []


def _name(value: dict[str, object]) -> str | None:
    """The name that a session gave itself."""
    about = value.get("metadata")
    name = about.get("name") if isinstance(about, dict) else None
    return name if isinstance(name, str) else None


def printable(text: str) -> str:
    """Text of others, without what could steer the terminal."""
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def _admin(session: zenoh.Session, selector: str, timeout_s: float) -> Iterator[tuple[str, object]]:
    """Keys and JSON values in the admin space."""
    for reply in session.get(selector, timeout=timeout_s):
        sample = reply.ok
        if sample is not None and str(sample.encoding) == JSON:
            try:
                yield str(sample.key_expr), msgspec.json.decode(sample.payload.to_bytes())
            except (msgspec.MsgspecError, ValueError, RecursionError):
                continue  # somebody else's idea of JSON


def keys(
    connect: Sequence[str] = (), *, as_json: bool = False, out: Printer = at_once, identity: str = "observer"
) -> None:
    """Prints who is on the network now.

    Raises:
        Unreachable: If no router answers.
    """
    with open_session(connect or [DEFAULT_ENDPOINT], name="zenpark keys", wait_s=WAIT_S, identity=identity) as session:
        found = members(session)
    if as_json:
        out(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
        return
    for member in found:
        out(f"{printable(member.name)}  ({member.id})")
        for title, held in (
            ("alive", member.alive),
            ("publishes", member.publishers),
            ("answers", member.queryables),
            ("listens to", member.subscribers),
        ):
            for place, key in enumerate(held):
                out(f"  {'' if place else title:10}  {printable(key)}")


def readable(payload: bytes, mime: str) -> str:
    """One line for a payload: JSON and MessagePack as JSON, text as a JSON string, the rest by its size.

    Everything is decoded and encoded again, so that nothing in it can steer the terminal.
    """
    try:
        if mime.startswith(MSGPACK):
            value = msgspec.msgpack.decode(payload)
        elif mime.startswith(JSON):
            value = msgspec.json.decode(payload)
        else:
            value = payload.decode()
        return json.dumps(value, ensure_ascii=True, separators=(",", ":"))
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError):
        return f"<{len(payload)} bytes, {printable(mime)}>"


def echo(
    key: str,
    connect: Sequence[str] = (),
    *,
    count: int | None = None,
    seconds: float | None = None,
    out: Printer = at_once,
    identity: str = "observer",
) -> None:
    """Prints `key payload` for each sample, the last value of every pose first.

    Args:
        key: Key expression.
        connect: Routers.
        count: How many samples [no end].
        seconds: How long [s, no end].
        out: Prints a line.
        identity: Whose certificate is shown to the routers of a lab.

    Raises:
        KeyExpressionError: If `key` is none.
        Unreachable: If no router answers.
    """
    expression = key_expression(key)
    deadline = math.inf if seconds is None else time.monotonic() + seconds
    left = math.inf if count is None else count
    with (
        open_session(connect or [DEFAULT_ENDPOINT], name="zenpark echo", wait_s=WAIT_S, identity=identity) as session,
        pose_subscriber(session, expression, DEPTH) as samples,
    ):
        while left > 0 and time.monotonic() < deadline:
            for sample in received(samples.handler):
                deleted = sample.kind == zenoh.SampleKind.DELETE
                text = "(deleted)" if deleted else readable(sample.payload.to_bytes(), str(sample.encoding))
                out(f"{printable(str(sample.key_expr))} {text}")
                left -= 1
                if left <= 0:
                    return
            time.sleep(POLL_S)


@dataclass(frozen=True)
class Rate:
    """How often a key was heard in a window: [1/s], [bytes/s], and its intervals [s] (NaN when there are none)."""

    key: str
    hz: float
    bytes_per_s: float
    mean: float
    sigma: float
    shortest: float
    longest: float

    def __str__(self) -> str:
        times = (self.mean, self.sigma, self.shortest, self.longest)
        shown = " ".join(f"{'-' if math.isnan(value) else f'{value * 1e3:.2f}':>9}" for value in times)
        return f"{self.hz:8.2f} {self.bytes_per_s:10.0f} {shown}  {self.key}"


HEADING: Final = "      Hz    bytes/s   mean ms      σ ms    min ms    max ms  key"


@dataclass
class Cadence:
    """Counts samples per key, window by window; an interval belongs to the window in which it ends."""

    _last: dict[str, float] = field(default_factory=dict)
    _intervals: dict[str, list[float]] = field(default_factory=dict)
    _sizes: dict[str, list[int]] = field(default_factory=dict)

    def add(self, key: str, stamp: float, size: int) -> None:
        """A sample of `size` bytes, stamped [s]."""
        if key in self._last:
            self._intervals[key].append(stamp - self._last[key])
        else:
            self._intervals[key], self._sizes[key] = [], []
        self._last[key] = stamp
        self._sizes[key].append(size)

    def window(self, length_s: float) -> list[Rate]:
        """The rates of the window of this length that ends now, by key; the next window begins."""
        rates = []
        for key in sorted(self._last):
            gaps, sizes = self._intervals[key], self._sizes[key]
            rates.append(
                Rate(
                    key,
                    len(sizes) / length_s,
                    sum(sizes) / length_s,
                    statistics.fmean(gaps) if gaps else math.nan,
                    statistics.pstdev(gaps) if gaps else math.nan,
                    min(gaps, default=math.nan),
                    max(gaps, default=math.nan),
                )
            )
            self._intervals[key], self._sizes[key] = [], []
        return rates


def hz(
    key: str,
    connect: Sequence[str] = (),
    *,
    seconds: float | None = None,
    window_s: float = 1.0,
    out: Printer = at_once,
    identity: str = "observer",
) -> None:
    """Prints rate, bytes and intervals of each key, window by window.

    Intervals are those between the stamps that the router gives, which this process cannot delay.

    Raises:
        KeyExpressionError: If `key` is none.
        Unreachable: If no router answers.
    """
    expression = key_expression(key)
    cadence = Cadence()
    with (
        open_session(connect or [DEFAULT_ENDPOINT], name="zenpark hz", wait_s=WAIT_S, identity=identity) as session,
        subscriber(session, expression, DEPTH) as samples,
    ):
        out(HEADING)
        began = printed = time.monotonic()
        end = math.inf if seconds is None else began + seconds
        while printed < end:
            now = time.monotonic()
            for sample in received(samples.handler):
                stamp = sample.timestamp
                at = now if stamp is None else stamp.get_time_as_ntp64().as_nanos() / 1e9
                cadence.add(str(sample.key_expr), at, len(sample.payload))
            if now - printed >= window_s or now >= end:
                for rate in cadence.window(now - printed):
                    out(printable(str(rate)))
                printed = now
            time.sleep(POLL_S)
