"""Commands that look at the network: members and their keys (`keys`), samples (`echo`), their rates (`hz`)."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
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

    from agents.network.pubsub import pose_subscriber
    from agents.network.session import received

    expression = key_expression(key)
    deadline = math.inf if seconds is None else time.monotonic() + seconds
    left = math.inf if count is None else count
    with session("echo", connect, lab, identity) as opened, pose_subscriber(opened, expression, DEPTH) as samples:
        while left > 0 and time.monotonic() < deadline:
            for sample in received(samples.handler):
                deleted = sample.kind == zenoh.SampleKind.DELETE
                text = "(deleted)" if deleted else readable(sample.payload.to_bytes(), str(sample.encoding))
                print(f"{printable(str(sample.key_expr))} {text}", flush=True)
                left -= 1
                if left <= 0:
                    return
            time.sleep(POLL_S)


@dataclass
class Rate:
    """Rate of a key in a window: [1/s], [bytes/s], and its intervals [s] (NaN when there are none)."""

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
    _samples: defaultdict[str, list[tuple[float, int]]] = field(default_factory=lambda: defaultdict(list))

    def add(self, key: str, stamp: float, size: int) -> None:
        """A sample of `size` bytes, stamped [s]."""
        self._samples[key].append((stamp - self._last.get(key, math.nan), size))
        self._last[key] = stamp

    def window(self, length_s: float) -> list[Rate]:
        """The rates of the window of this length that ends now, by key; the next window begins."""
        import statistics

        rates = []
        for key in sorted(self._last):
            samples = self._samples.pop(key, [])
            gaps = [gap for gap, _ in samples if not math.isnan(gap)]
            times = [of(gaps) if gaps else math.nan for of in (statistics.fmean, statistics.pstdev, min, max)]
            rates.append(Rate(key, len(samples) / length_s, sum(size for _, size in samples) / length_s, *times))
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

    from agents.network.pubsub import subscriber
    from agents.network.session import received

    expression = key_expression(key)
    cadence = Cadence()
    with session("hz", connect, lab, identity) as opened, subscriber(opened, expression, DEPTH) as samples:
        if not as_json:
            print(HEADING, flush=True)
        began = printed = time.monotonic()
        end = math.inf if seconds is None else began + seconds
        while printed < end:
            now = time.monotonic()
            for sample in received(samples.handler):
                stamp = sample.timestamp
                # the router's stamp, which this process cannot delay
                at = now if stamp is None else stamp.get_time_as_ntp64().as_nanos() / 1e9
                cadence.add(str(sample.key_expr), at, len(sample.payload))
            if now - printed >= WINDOW_S or now >= end:
                for rate in cadence.window(now - printed):
                    print(msgspec.json.encode(rate).decode() if as_json else printable(str(rate)), flush=True)
                printed = now
            time.sleep(POLL_S)
