"""Commands that look at the network: members and their keys (`keys`), samples (`echo`), their rates (`hz`)."""

from __future__ import annotations

import math
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Final

import typer
from typer import Option

from agents.errors import ExplainedError
from tools.options import As, AsJson, Connect, KeyExpression, Lab, Seconds, example, print_json, session
from tools.terminal import printable

if TYPE_CHECKING:
    import zenoh

app: Final = typer.Typer()

POLL_S: Final = 0.02
LAST_S: Final = 0.5  # limit for the answers with last poses: a frozen robot gives none
WINDOW_S: Final = 1.0
DEPTH: Final = 8192  # samples between two polls


@dataclass
class NetworkMember:
    """A session on the network: its name, its Zenoh id, and the keys that it holds."""

    name: str
    id: str
    alive: list[str] = field(default_factory=list)
    publishers: list[str] = field(default_factory=list)
    subscribers: list[str] = field(default_factory=list)
    queryables: list[str] = field(default_factory=list)


_KINDS: Final = {"token": "alive", "publisher": "publishers", "subscriber": "subscribers", "queryable": "queryables"}


def key_expression(text: str) -> str:
    """The text, if it is a key expression."""
    import zenoh

    try:
        return str(zenoh.KeyExpr(text))
    except zenoh.ZError as error:
        why = str(error).partition(" at /")[0].partition("`: ")[2]
        raise ExplainedError(f"'{text}' is not a key expression: {why}. Write it like park/*/pose") from None


def members(session: zenoh.Session, timeout_s: float = 2.0) -> list[NetworkMember]:
    """Members of the network, by name, from the admin space of routers and members of a mesh, without `session` itself.

    A frozen process is still listed, for its router knows it; only its name is then unknown.
    """
    held: dict[str, dict[str, list[str]]] = {}
    places = [*_admin(session, "@/*/router/**", timeout_s), *_admin(session, "@/*/peer/**", timeout_s)]
    for place, value in places:
        _, _, mode, kind, key = (*place.split("/", 4), *[""] * 4)[:5]
        if kind not in _KINDS or not isinstance(value, dict):
            continue
        # a member of a mesh tells of its neighbours too, but not all of it; its own it calls those of a client
        of_peers = _strings(value.get("peers")) if mode == "router" else []
        for owner in {*_strings(value.get("clients")), *of_peers}:
            held.setdefault(owner, {}).setdefault(_KINDS[kind], []).append(key)
    names = {
        place.split("/")[1]: _name(value)
        for place, value in _admin(session, "@/*/*", timeout_s)
        if isinstance(value, dict) and "/" in place
    }
    mine = str(session.zid())
    everyone = (held.keys() | names.keys()) - {mine}
    found = [
        NetworkMember(
            names.get(owner) or "?", owner, **{kind: sorted(keys) for kind, keys in held.get(owner, {}).items()}
        )
        for owner in everyone
    ]
    return sorted(found, key=lambda member: (member.name, member.id))


def _strings(value: object) -> list[str]:
    """The words of a list, if it is one: what stands in the admin space is another program's."""
    return [word for word in value if isinstance(word, str)] if isinstance(value, list) else []


def _name(value: dict[str, object]) -> str | None:
    """The name that a session gave itself."""
    about = value.get("metadata")
    name = about.get("name") if isinstance(about, dict) else None
    return name if isinstance(name, str) else None


def _admin(session: zenoh.Session, selector: str, timeout_s: float) -> Iterator[tuple[str, object]]:
    """Keys and JSON values in the admin space."""
    import msgspec

    from agents.network.messages import JSON

    for reply in session.get(selector, timeout=timeout_s):
        sample = reply.ok
        if sample is not None and str(sample.encoding) == JSON:
            try:
                yield str(sample.key_expr), msgspec.json.decode(sample.payload.to_bytes())
            except (msgspec.MsgspecError, ValueError, RecursionError):
                continue  # not of this project


@app.command(epilog=example("keys", "keys --connect tcp/192.168.0.10:7447 --json"))
def keys(connect: Connect = None, as_json: AsJson = False, lab: Lab = None, identity: As = "observer") -> None:
    """Show the members of the network and the keys that they hold."""
    with session("keys", connect, lab, identity) as opened:
        found = members(opened)
    if as_json:
        print_json(found)
        return
    for member in found:
        print(f"{printable(member.name)}  ({member.id})")
        for title, held in (
            ("alive", member.alive),
            ("publishes", member.publishers),
            ("answers", member.queryables),
            ("listens to", member.subscribers),
        ):
            for place, key in enumerate(held):
                print(f"  {'' if place else title:10}  {printable(key)}")


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


@app.command(epilog=example("echo 'park/*/pose'", "echo park/world/report -n 1"))
def echo(
    key: KeyExpression,
    *,
    connect: Connect = None,
    count: Annotated[int | None, Option("--count", "-n", min=1, help="Number of samples after which to end.")] = None,
    seconds: Seconds = None,
    lab: Lab = None,
    identity: As = "observer",
) -> None:
    """Print the samples of a key, the last poses first."""
    import zenoh

    expression = key_expression(key)
    deadline = math.inf if seconds is None else time.monotonic() + seconds
    with session("echo", connect, lab, identity) as opened:
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
    silence: float  # since the last sample

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


@app.command(epilog=example("hz 'park/*/state' --seconds 5"))
def hz(
    key: KeyExpression,
    *,
    connect: Connect = None,
    seconds: Seconds = None,
    lab: Lab = None,
    identity: As = "observer",
    as_json: Annotated[bool, Option("--json", help="Print a line of JSON for each key and second.")] = False,
) -> None:
    """Print the rate, bytes and intervals of each key, second by second."""
    import msgspec
    from zenoh.handlers import Callback

    expression = key_expression(key)
    cadence = Cadence()
    arrived = deque[tuple[str, float, int]](maxlen=DEPTH)

    def note(sample: zenoh.Sample) -> None:  # in the receiving thread: this process's poll is no arrival
        arrived.append((str(sample.key_expr), time.monotonic(), len(sample.payload)))

    with session("hz", connect, lab, identity) as opened:
        subscriber = opened.declare_subscriber(expression, Callback(note, indirect=False))
        if not as_json:
            print(HEADING, flush=True)
        began = printed = time.monotonic()
        end = math.inf if seconds is None else began + seconds
        while printed < end:
            time.sleep(POLL_S)
            now = time.monotonic()
            while arrived:
                cadence.add(*arrived.popleft())
            if now - printed >= WINDOW_S or now >= end:
                for rate in cadence.window(now - printed, now):
                    print(msgspec.json.encode(rate).decode() if as_json else printable(str(rate)), flush=True)
                printed = now
        subscriber.undeclare()
