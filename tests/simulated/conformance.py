"""Scripts of what happens to routers and clients, each played with real processes and in the simulated network.

A client is an `Actor`, the same code on both sides: it obeys one step after the other, and reports what it notices. The
guess of a script was written down before it was played first.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import zenoh
from zenoh.handlers import Callback, RingChannel

from agents.network import pubsub
from agents.network.endpoints import free_endpoint
from agents.network.zenoh_config import config, settings
from tests.simulated import advanced, links, network
from tests.simulated import kernel as simulated
from tests.simulated.kernel import BEGIN, Kernel, Process

ROOT: Final = Path(__file__).resolve().parents[2]
LEAD_S: Final = 0.5  # time from the start of all real processes until the first step [s]
TOGETHER_S: Final = 0.15  # events nearer than this have no order [s]
READY: Final = "ready"
FAULTS: Final = ("cut", "freeze", "kill", "close")
PATIENCE_S: Final = 30.0  # limit for real events that are expected [s]
QUIET_S: Final = 0.5  # time in which no event follows that is not expected [s]


class Event(NamedTuple):
    """Observation of a client, [s] after the beginning."""

    t: float
    who: str
    kind: str  # "token", "value", or the outcome of a step
    key: str
    value: str


@dataclass(frozen=True)
class Script:
    """Steps (time [s], who, what, arguments) of clients, cables (`cut`, `mend`) and processes.

    The cable of a client is its own, that of a router leads to the routers before it.
    """

    guess: str
    steps: Sequence[tuple[Any, ...]]
    length: float  # [s]
    routers: int = 1
    seen: str = "as guessed"
    quick: bool = False  # played with real processes in every run of the tests
    leases: Mapping[str, float] = field(default_factory=lambda: {"a": 1.2})  # those that are not 2 s [s]

    @property
    def clients(self) -> list[str]:
        return sorted({step[1] for step in self.steps if not step[1].startswith("router")})

    @property
    def cables(self) -> list[str]:
        return sorted({step[1] for step in self.steps if step[2] == "cut"})


REAL: Final = SimpleNamespace(
    open=zenoh.open,
    advanced_publisher=pubsub.pose_publisher,
    advanced_subscriber=lambda session, key, call, kept: pubsub.advanced_subscriber(
        session, key, Callback(call, indirect=False), kept
    ),
    ring=RingChannel,
    callback=lambda call: Callback(call, indirect=False),
    source_info=zenoh.SourceInfo,
    thread=threading.Thread,
)


def library(net: network.Network) -> SimpleNamespace:
    """The same names of the simulation."""
    return SimpleNamespace(
        open=net.open,
        advanced_publisher=advanced.AdvancedPublisher,
        advanced_subscriber=advanced.AdvancedSubscriber,
        ring=links.Ring,
        callback=lambda call: call,
        source_info=links.SourceInfo,
        thread=simulated.Thread,
    )


class Actor:
    """A client that does what the steps of a script say."""

    def __init__(
        self, zenoh: SimpleNamespace, endpoints: Sequence[str], lease_s: float, report: Callable[..., object]
    ) -> None:
        self._zenoh, self._endpoints, self._lease_s, self._report = zenoh, endpoints, lease_s, report
        self._session: Any = None
        self._things: dict[str, Any] = {}  # publishers, tokens and rings by key
        self._kept: list[Any] = []
        self._queries: list[Any] = []

    def obey(self, line: str) -> None:
        what, *arguments = json.loads(line)
        getattr(self, what)(*arguments)

    def open(self, first: int = 0) -> None:
        """Join the first router that answers, from `first` on."""
        endpoints = [*self._endpoints[first:], *self._endpoints[:first]]
        chosen = config(settings("client", connect=endpoints, lease_s=self._lease_s))
        try:
            self._session = self._zenoh.open(chosen)
        except zenoh.ZError:
            self._report("open", "", "failed")
        else:
            self._report("open", "", "done")

    def close(self) -> None:
        self._session.close()

    # samples

    def publisher(self, key: str) -> None:
        self._things[key] = self._session.declare_publisher(key)

    def advanced(self, key: str, kept: int) -> None:
        self._things[key] = self._zenoh.advanced_publisher(self._session, key, "text/plain", kept)

    def put(self, key: str, *values: str) -> None:
        for value in values:
            self._things[key].put(value.encode())

    def put_numbered(self, key: str, number: int, *values: str) -> None:
        for value in values:
            publisher = self._things[key]
            publisher.put(value.encode(), source_info=self._zenoh.source_info(publisher.id, number))

    def subscribe(self, key: str) -> None:
        self._kept.append(self._session.declare_subscriber(key, self._zenoh.callback(self._note_value)))

    def subscribe_advanced(self, key: str, kept: int) -> None:
        self._kept.append(self._zenoh.advanced_subscriber(self._session, key, self._note_value, kept))

    def subscribe_ring(self, key: str, depth: int) -> None:
        self._things[key] = self._session.declare_subscriber(key, self._zenoh.ring(depth))

    def drain(self, key: str) -> None:
        take = self._things[key].handler.try_recv
        self._report("drained", key, " ".join(bytes(each.payload.to_bytes()).decode() for each in iter(take, None)))

    def _note_value(self, sample: Any) -> None:
        self._report("value", str(sample.key_expr), sample.payload.to_bytes().decode())

    # tokens

    def token(self, key: str, name: str = "") -> None:
        self._things[name or key] = self._session.liveliness().declare_token(key)

    def withdraw(self, name: str) -> None:
        self._things.pop(name).undeclare()

    def watch(self, key: str) -> None:
        made = self._session.liveliness().declare_subscriber(key, self._zenoh.callback(self._note_token), history=True)
        self._kept.append(made)

    def _note_token(self, sample: Any) -> None:
        there = sample.kind == zenoh.SampleKind.PUT
        self._report("token", str(sample.key_expr), "appears" if there else "vanishes")

    def ask_tokens(self, key: str, limit_s: float) -> None:
        self._answers("tokens", key, lambda: self._session.liveliness().get(key, timeout=limit_s))

    # questions

    def queryable(self, key: str, value: str | None) -> None:
        """Answer questions at once, or never if there is no value."""

        def answer(query: Any) -> None:
            self._report("asked", key, "")
            if value is None:
                self._queries.append(query)
                return
            with query:
                query.reply(key, value.encode())

        self._kept.append(self._session.declare_queryable(key, self._zenoh.callback(answer)))

    def ask(self, key: str, limit_s: float) -> None:
        both = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
        self._answers("answers", key, lambda: self._session.get(key, timeout=limit_s, **both))

    def _answers(self, kind: str, key: str, ask: Callable[[], Any]) -> None:
        def wait() -> None:
            found = []
            for reply in ask():
                good = reply.ok is not None
                sample = reply.ok if good else reply.err
                text = sample.payload.to_bytes().decode() or str(sample.key_expr) if good else "no answer in time"
                found.append(text)
            self._report(kind, key, " ".join(sorted({*found})))  # the router may say as well that it waits no longer

        self._zenoh.thread(target=wait, daemon=True).start()


# ---------------------------------------------------------------------- the two stages


def simulate(script: Script, seed: int = 1) -> list[Event]:
    """Observations of the clients in the simulation."""
    events: list[Event] = []
    places = [f"tcp/127.0.0.1:{7447 + row}" for row in range(script.routers)]
    with Kernel(seed) as kernel:
        net = network.Network()
        processes: dict[str, Process] = {}

        def route(row: int) -> None:
            net.open(config(settings("router", listen=[places[row]], connect=places[:row])))
            simulated.sleep(1e6)

        def act(who: str) -> None:
            def report(*words: str) -> None:
                events.append(Event(kernel.now - BEGIN - LEAD_S, who, *words))

            actor = Actor(library(net), places, script.leases.get(who, 2.0), report)
            end, rest = simulated.LifelineEnd(), b""
            while end.wait(1e6):
                *lines, rest = (rest + end.read()).split(b"\n")
                for line in lines:
                    actor.obey(line.decode())

        def start(who: str) -> None:
            row = int(who.removeprefix("router") or 1) - 1 if who.startswith("router") else None
            main = (lambda: act(who)) if row is None else (lambda: route(row))
            processes[who] = Process(who, main)

        def step(who: str, what: str, *arguments: object) -> None:
            process = processes[who]
            if what in ("cut", "mend") and who.startswith("router"):
                beyond = {
                    who,
                    *(each.process.name for each in net.sessions if each.link and each.link.far.process is process),
                }
                net.split(beyond.__contains__ if what == "cut" else None)
            elif what in ("cut", "mend"):
                for session in process.sessions:
                    net.cut(session, what == "cut")
            elif what in ("freeze", "thaw", "kill"):
                {"freeze": process.pause, "thaw": process.resume, "kill": process.kill}[what]()
            elif what == "start":
                start(who)
            else:
                process.give(json.dumps([what, *arguments]).encode() + b"\n")

        for row in range(script.routers):
            start(f"router{row + 1 if row else ''}")
        for who in script.clients:
            start(who)
        for t, *words in script.steps:
            kernel.at(BEGIN + LEAD_S + t, step, *words)
        kernel.run(limit=BEGIN + LEAD_S + script.length)
        assert not kernel.crashes, kernel.crashes[0][-1]
    return events


class RealStage:
    """Real processes: routers, a relay for each client that is cut off, clients."""

    def __init__(self, script: Script) -> None:
        self._script, self._zero = script, 0.0
        self._processes: dict[str, subprocess.Popen[str]] = {}  # newest of each name
        self._started: list[subprocess.Popen[str]] = []
        self._readers: list[threading.Thread] = []
        self._lines: list[tuple[str, str]] = []
        self._places = [free_endpoint(preferred_port=0) for _ in range(script.routers)]
        self._ready = threading.Semaphore(0)

    def play(self, expected: Sequence[Event] = ()) -> list[Event]:
        """Events until all that are expected are there, and for as long as the script lasts."""
        with ExitStack() as stack:
            stack.callback(self._end)
            for row in range(self._script.routers):
                self._start(f"router{row + 1 if row else ''}")
                self._await(1)
            for who in self._script.clients:
                self._start(who)
            self._await(len(self._script.clients))
            self._zero = time.monotonic() + LEAD_S
            pause, disturbed = threading.Event(), False
            for t, who, what, *arguments in self._script.steps:
                pause.wait(max(0.0, self._zero + t - time.monotonic()))
                self._step(who, what, *arguments)
                disturbed = disturbed or what in FAULTS
                if not disturbed:  # a slow machine gets its time
                    self._await(1)
                    self._zero = max(self._zero, time.monotonic() - t)
            pause.wait(max(0.0, self._zero + self._script.length - time.monotonic()))
            limit = time.monotonic() + PATIENCE_S
            while expected and time.monotonic() < limit and differences(list(self._events()), expected):
                pause.wait(0.1)
            pause.wait(QUIET_S)
            return list(self._events())  # clients notice the end of the router, which follows

    def _await(self, count: int) -> None:
        for _ in range(count):
            assert self._ready.acquire(timeout=60.0), f"not all is ready, but {self._lines}"

    def _start(self, who: str) -> None:
        if who.startswith("router"):
            row = int(who.removeprefix("router") or 1) - 1
            link = [word for place in self._reached(who, self._places[:row]) for word in ("--connect", place)]
            self._spawn(who, "agents.runtime.router", "--listen", self._places[row], *link)
            return
        lease_s = self._script.leases.get(who, 2.0)
        self._spawn(who, "tests.simulated.conformance", str(lease_s), *self._reached(who, self._places))

    def _reached(self, who: str, places: Sequence[str]) -> Sequence[str]:
        """Endpoints by which a process reaches routers: through its cable, if it has one."""
        if who not in self._script.cables:
            return places
        near = [free_endpoint(preferred_port=0) for _ in places]
        ports = [place.rpartition(":")[2] for pair in zip(near, places, strict=True) for place in pair]
        self._spawn(f"cable {who}", "tests.simulated.cable", *ports)
        return near

    def _spawn(self, who: str, module: str, *arguments: str) -> None:
        command = [sys.executable, "-m", module, *arguments]
        pipe = subprocess.PIPE
        made = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True, bufsize=1)
        self._processes[who] = made
        self._started.append(made)

        def read() -> None:
            assert made.stdout is not None
            for line in made.stdout:
                if READY in line:
                    self._ready.release()
                else:
                    self._lines.append((who, line))

        self._readers.append(threading.Thread(target=read))
        self._readers[-1].start()

    def _step(self, who: str, what: str, *arguments: object) -> None:
        signals = {"freeze": signal.SIGSTOP, "thaw": signal.SIGCONT, "kill": signal.SIGKILL}
        if what in ("cut", "mend"):
            self._processes[f"cable {who}"].send_signal(signal.SIGSTOP if what == "cut" else signal.SIGCONT)
        elif what in signals:
            self._processes[who].send_signal(signals[what])
            if what == "kill":
                self._processes[who].wait(30.0)
        elif what == "start":
            self._start(who)
        else:
            stdin = self._processes[who].stdin
            assert stdin is not None
            stdin.write(json.dumps([what, *arguments]) + "\n")

    def _end(self) -> None:
        for each in self._started:
            each.kill()
        for each in self._started:
            each.wait(30.0)
        for reader in self._readers:
            reader.join(30.0)
        for each in self._started:
            for stream in (each.stdin, each.stdout):
                if stream is not None:
                    stream.close()

    def _events(self) -> Iterator[Event]:
        for who, line in list(self._lines):
            t, *words = json.loads(line)
            yield Event(t - self._zero, who, *words)  # early ones seem earlier if the machine was slow


def act_in_process(lease_s: str, *places: str) -> None:
    """The process of a real client: steps come by standard input, events go to standard output."""
    lock = threading.Lock()

    def report(*words: object) -> None:
        with lock:  # callbacks have threads of their own
            print(json.dumps([time.monotonic(), *words]), flush=True)

    actor = Actor(REAL, places, float(lease_s), report)
    report(READY)
    for line in sys.stdin:
        actor.obey(line)
        report(READY)


# ---------------------------------------------------------------------- comparison


def histories(events: Sequence[Event]) -> dict[tuple[str, str, str], list[Event]]:
    """Events of each client, kind and key; of a value that is seen again and again the last one alone counts."""
    found: dict[tuple[str, str, str], list[Event]] = {}
    for event in sorted(events):
        known = found.setdefault((event.who, event.kind, event.key), [])
        if event.kind == "value":
            known.clear()
        known.append(event)
    return found


def differences(real: Sequence[Event], simulated: Sequence[Event]) -> list[str]:
    """Sentences about events that only one side has, or that both have in another order."""
    one, other = histories(real), histories(simulated)
    told = [
        f"{' '.join(key)}: really {[each.value for each in one.get(key, [])]}, "
        f"simulated {[each.value for each in other.get(key, [])]}"
        for key in sorted(one.keys() | other.keys())
        if [each.value for each in one.get(key, [])] != [each.value for each in other.get(key, [])]
    ]
    if told:
        return told
    pairs = [pair for key in one if key[1] != "value" for pair in zip(one[key], other[key], strict=True)]
    for a, a_simulated in pairs:
        for b, b_simulated in pairs:
            if a.who == b.who and a.t < b.t - TOGETHER_S and a_simulated.t > b_simulated.t + TOGETHER_S:
                told.append(f"{a} is before {b}, but simulated behind it")
    return told


def delays(real: Sequence[Event], simulated: Sequence[Event]) -> list[tuple[float, Event]]:
    """Delay of each real event after the simulated one [s]."""
    other = histories(simulated)
    return [
        (event.t - twin.t, event)
        for key, events in histories(real).items()
        for event, twin in zip(events, other.get(key, []), strict=False)
    ]


if __name__ == "__main__":
    act_in_process(*sys.argv[1:])
