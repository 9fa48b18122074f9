"""Commands that look at the network: members and their keys (`keys`), samples and their rates (`echo`)."""

from __future__ import annotations

import math
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Option

from agents.errors import ExplainedError
from agents.ticks import POLL_S
from tools.options import As, AsJson, Connect, KeyExpression, Lab, Seconds, example, place, print_json, session
from tools.terminal import printable

if TYPE_CHECKING:
    import zenoh

app: Final = typer.Typer()

LAST_S: Final = 0.5  # limit for the answers with last poses: a frozen robot gives none
WINDOW_S: Final = 1.0
DEPTH: Final = 8192  # samples between two polls


@dataclass
class NetworkMember:
    """Robot or process, by the chunk of its keys behind the realm."""

    name: str
    phase: str = ""  # phase of a robot
    sessions: list[str] = field(default_factory=list)  # Zenoh ids that its tokens tell
    alive: list[str] = field(default_factory=list)  # liveliness tokens
    publishes: list[str] = field(default_factory=list)


def key_expression(text: str) -> str:
    """The text, if it is a key expression."""
    import zenoh

    try:
        return str(zenoh.KeyExpr(text))
    except zenoh.ZError as error:
        why = str(error).partition(" at /")[0].partition("`: ")[2]
        raise ExplainedError(f"'{text}' is not a key expression: {why}. Write it like park/*/pose") from None


def members(session: zenoh.Session, below: str = "**", listen_s: float = WINDOW_S) -> list[NetworkMember]:
    """Members of the network below some keys, by name.

    They are known by their liveliness tokens, their last statuses, and what is sent within `listen_s` [s]. The tables
    of routers are not asked: a router that is asked for them may stand still for good. So a session that only listens
    is not seen.
    """
    from agents.network.keys import Keys
    from agents.network.messages import Malformed, Status, decode
    from agents.network.pubsub import last_values, subscriber
    from agents.network.session import received, tokens_present

    found: dict[str, NetworkMember] = {}

    def member(key: str) -> NetworkMember:
        name = key.split("/")[1] if "/" in key else key
        return found.setdefault(name, NetworkMember(name))

    with subscriber(session, below, DEPTH) as heard:
        time.sleep(listen_s)
        keys = {str(sample.key_expr) for sample in received(heard.handler)}
    for token in sorted(tokens_present(session, below) or ()):
        owner = member(token)
        owner.alive.append(token)
        if (zid := Keys.session_of(token)) is not None and zid not in owner.sessions:
            owner.sessions.append(zid)
    for token in tokens_present(session, f"{below}/@adv/pub/**") or ():
        keys.add(token.partition("/@adv/")[0])
    for key in sorted(keys):
        member(key).publishes.append(key)
    for sample in last_values(session, f"{below}/status", LAST_S):
        with suppress(Malformed):
            status = decode(sample.payload.to_bytes(), str(sample.encoding), Status)
            member(str(sample.key_expr)).phase = status.phase
    return sorted(found.values(), key=lambda each: each.name)


@app.command(epilog=example("keys", "keys --connect tcp/192.168.0.10:7447 --json"))
def keys(connect: Connect = None, as_json: AsJson = False, lab: Lab = None, identity: As = "observer") -> None:
    """Show the members of the network: their phase, their liveliness tokens, and what they publish."""
    from agents.network.lab import lab_of

    where = place(connect, lab)
    with session("keys", where, identity) as opened:
        # in a lab no member may look beyond the keys of the experiment
        found = members(opened, "**" if lab_of(where.endpoints) is None else f"{where.realm}/**")
    if as_json:
        print_json(found)
        return
    for member in found:
        print("  ".join(map(printable, filter(None, (member.name, member.phase, *member.sessions)))))
        for title, held in (("alive", member.alive), ("publishes", member.publishes)):
            for number, key in enumerate(held):
                print(f"  {'' if number else title:10}  {printable(key)}")


def readable(payload: bytes, mime: str) -> str:
    """A line for a payload: JSON and MessagePack as JSON, text as a JSON string, the rest by its size.

    Everything is decoded and encoded again, so that nothing in it can steer the terminal.
    """
    import json

    import msgspec

    from agents.network.messages import JSON, MSGPACK

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


@app.command(epilog=example("echo 'park/*/pose'", "echo park/world/report -n 1", "echo 'park/*/state' --rates"))
def echo(
    key: KeyExpression,
    *,
    connect: Connect = None,
    count: Annotated[int | None, Option("--count", "-n", min=1, help="Number of samples after which to end.")] = None,
    seconds: Seconds = None,
    rates: Annotated[bool, Option("--rates", help="Print rate, bytes and intervals instead.")] = False,
    lab: Lab = None,
    identity: As = "observer",
    as_json: Annotated[bool, Option("--json", help="Print a line of JSON for each key and second of --rates.")] = False,
) -> None:
    """Print the samples of a key, the last poses first; or how often and how regularly they come."""
    import zenoh

    expression = key_expression(key)
    deadline = math.inf if seconds is None else time.monotonic() + seconds
    with session("echo", place(connect, lab), identity) as opened:
        if rates:
            _print_rates(opened, expression, deadline, as_json=as_json)
            return
        for sample in islice(_samples(opened, expression, deadline), count):
            deleted = sample.kind == zenoh.SampleKind.DELETE
            text = "(deleted)" if deleted else readable(sample.payload.to_bytes(), str(sample.encoding))
            print(f"{printable(str(sample.key_expr))} {text}", flush=True)


def _samples(session: zenoh.Session, expression: str, deadline: float) -> Iterator[zenoh.Sample]:
    """Samples of a key until `deadline` [monotonic s], first the last value of each publisher that keeps one.

    The subscriber is plain: an advanced one drops samples with a source number or a stamp that does not grow.
    """
    from agents.network.pubsub import last_values, subscriber
    from agents.network.session import received

    with subscriber(session, expression, DEPTH) as live:
        kept = last_values(session, expression, LAST_S)
        yield from kept
        known = set(map(_identity, kept))
        while time.monotonic() < deadline:
            yield from (sample for sample in received(live.handler) if _identity(sample) not in known)
            time.sleep(POLL_S)


def _identity(sample: zenoh.Sample) -> tuple[str, ...]:
    """Words by which a kept sample is recognised: a cache keeps numbered samples, or stamped ones."""
    source = sample.source_info
    if source is None:
        return str(sample.key_expr), str(sample.timestamp)
    return str(sample.key_expr), str(source.source_id), str(source.source_sn)


@dataclass
class Rate:
    """Rate of a key in a window: [1/s], [bytes/s], its intervals [s] (NaN when there are none), and its silence [s]."""

    key: str
    hz: float
    bytes_per_s: float
    mean: float
    sigma: float
    shortest: float
    longest: float
    silence: float  # time since the last sample

    def __str__(self) -> str:
        times = (self.mean, self.sigma, self.shortest, self.longest)
        shown = " ".join(f"{'-' if math.isnan(value) else f'{value * 1e3:.2f}':>9}" for value in times)
        silent = "" if self.hz else f"  silent for {self.silence:.0f} s"
        return f"{self.hz:8.2f} {self.bytes_per_s:10.0f} {shown}  {self.key}{silent}"


HEADING: Final = "      Hz    bytes/s   mean ms      σ ms    min ms    max ms  key"


@dataclass
class Cadence:
    """Counts samples per key, window by window; an interval belongs to the window in which it ends."""

    _last: dict[str, float] = field(default_factory=dict)
    _samples: defaultdict[str, list[tuple[float, int]]] = field(default_factory=lambda: defaultdict(list))

    def add(self, key: str, arrived: float, size: int) -> None:
        """A sample of `size` bytes, which arrived at `arrived` [s]."""
        self._samples[key].append((arrived - self._last.get(key, math.nan), size))
        self._last[key] = arrived

    def window(self, length_s: float, now: float) -> list[Rate]:
        """The rates of the window of this length that ends at `now` [s], by key; the next window begins.

        A key that has fallen silent keeps its row.
        """
        import statistics

        rates = []
        for key in sorted(self._last):
            samples = self._samples.pop(key, [])
            gaps = [gap for gap, _ in samples if not math.isnan(gap)]
            mean, sigma, shortest, longest = (
                of(gaps) if gaps else math.nan for of in (statistics.fmean, statistics.pstdev, min, max)
            )
            size, silence = sum(size for _, size in samples), max(0.0, now - self._last[key])
            rates.append(Rate(key, len(samples) / length_s, size / length_s, mean, sigma, shortest, longest, silence))
        return rates


def _print_rates(session: zenoh.Session, expression: str, deadline: float, *, as_json: bool) -> None:
    """Print the rates of all keys, window by window, until `deadline` [monotonic s]."""
    import msgspec
    from zenoh.handlers import Callback

    cadence = Cadence()
    arrived = deque[tuple[str, float, int]](maxlen=DEPTH)

    def note(sample: zenoh.Sample) -> None:  # runs in the receiving thread: this process's poll is no arrival
        arrived.append((str(sample.key_expr), time.monotonic(), len(sample.payload)))

    subscriber = session.declare_subscriber(expression, Callback(note, indirect=False))
    if not as_json:
        print(HEADING, flush=True)
    printed = time.monotonic()
    while printed < deadline:
        time.sleep(POLL_S)
        now = time.monotonic()
        while arrived:
            cadence.add(*arrived.popleft())
        if now - printed >= WINDOW_S or now >= deadline:
            for rate in cadence.window(now - printed, now):
                print(msgspec.json.encode(rate).decode() if as_json else printable(str(rate)), flush=True)
            printed = now
    subscriber.undeclare()
