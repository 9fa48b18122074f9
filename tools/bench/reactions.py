"""Reaction times of robots: to an emergency stop, to a neighbour that was killed, to one that hangs.

Twenty robots run as processes of their own. The command to cut the motors is stamped where the body obeys it, by the
monotonic clock by which the stop was sent: in the robot's own process for twins (`tools.bench.reactions_robot`), as for
a device that is driven from there; here for external bodies, of which the bench is the far end. The knowledge of a
death is stamped when a status, which names the missing neighbours, arrives here: one way over the router more than the
robot itself needs.

Messages are stamped in callbacks of Zenoh's own threads, not in a loop.
"""

from __future__ import annotations

import os
import signal
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import cos, pi, sin
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import zenoh
from zenoh.handlers import Callback

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from experiments.definition.experiment import Arena, Experiment, Formation, Rates, Robot
from experiments.file.document import write_json
from experiments.real_time.conductor import orders
from experiments.real_time.conductor.support import start_router
from experiments.real_time.hosts.launcher import Launcher
from tools.bench.measuring import Figure

ROBOTS: Final = 20
BODIES: Final = ("twin", "external")
STOPS: Final = 5  # emergency stops of each kind of body; each ends its run, so that there is one fresh run for each
DEATHS: Final = 3  # runs in which robots die
KILLED, FROZEN = 7, 3  # robots of each such run; their neighbours in the ring stay, to notice
SETTLE_S: Final = 2.0  # robots run for so long before anything happens
PATIENCE_S: Final = 60.0
MISSED_S: Final = 10.0  # a reaction that has not come by then never will
SPACING: Final = 0.8  # [m] around the ring
POSITION_HZ: Final = 50.0
PINGS: Final = 20  # round trips of nothing, before each measurement

STOP_S, KILL_S, FREEZE_S = 0.020, 0.1, 1.5  # limits


def safety() -> Iterator[Figure]:
    """Reaction times with twenty robots running, beside an empty way over the router in the same run."""
    pings: list[float] = []
    stops: dict[str, list[float]] = {body: [] for body in BODIES}
    killed: list[float] = []
    frozen: list[float] = []
    missed = wrong = 0
    for _ in range(STOPS):
        for body, ways in stops.items():
            with _Park(ROBOTS, body) as park:
                pings += park.pings()
                taken, lost = park.stop()
                ways.extend(taken)
                missed, wrong = missed + lost, wrong + park.wrong()
    for _ in range(DEATHS):
        with _Park(ROBOTS) as park:
            pings += park.pings()
            # every second robot at most: both neighbours of each dead robot must live to notice
            for number, row in enumerate(range(0, 2 * (KILLED + FROZEN), 2)):
                cause = signal.SIGKILL if number < KILLED else signal.SIGSTOP
                found, lost = park.lose(row, cause)
                (killed if cause == signal.SIGKILL else frozen).extend(found)
                missed += lost
            wrong += park.wrong()
    empty = statistics.median(pings)
    yield from _figures("an empty way over the router", pings, empty, empty, "yardstick")
    for body, ways in stops.items():
        yield from _figures(f"emergency stop until motors off, {body}", ways, empty, STOP_S, "of 20 ms")
    yield from _figures("neighbour killed until known", killed, empty, KILL_S, "of 0.1 s")
    yield from _figures("neighbour frozen until known", frozen, empty, FREEZE_S, "of 1.5 s")
    yield Figure("safety", "reactions that did not come", float(missed), "", float(missed), "wanted: 0")
    yield Figure("safety", "robots held for dead that were not", float(wrong), "", float(wrong), "wanted: 0")
    load = os.getloadavg()[0]
    yield Figure("safety", "load of the machine", load, "", load / (os.cpu_count() or 1), "× its cores")


def _figures(what: str, taken: Sequence[float], empty: float, wanted: float, of: str) -> Iterator[Figure]:
    """Median, 99th percentile and largest of some times [s]; the median over an empty way, the others over the aim."""
    ordered = sorted(taken)
    if not ordered:
        return
    middle = statistics.median(ordered)
    late = ordered[min(len(ordered) - 1, round(0.99 * (len(ordered) - 1)))]
    yield Figure("safety", f"{what}, median of {len(ordered)}", 1e3 * middle, "ms", middle / empty, "× an empty way")
    yield Figure("safety", f"{what}, 99 %", 1e3 * late, "ms", late / wanted, of)
    yield Figure("safety", f"{what}, slowest", 1e3 * ordered[-1], "ms", ordered[-1] / wanted, of)


def ring(count: int, body: str) -> Experiment:
    """Robots on wheels in a ring, each listening to the one before and the one behind, all with such a body."""
    names = [f"R{k:03}" for k in range(count)]
    radius = 0.5 * SPACING / sin(pi / count)
    turns = [2.0 * pi * k / count for k in range(count)]
    size = 2.0 * radius + 2.0
    return Experiment(
        title="a ring",
        robots={
            name: Robot(kind="khepera4", start=[radius * cos(turn), radius * sin(turn)], body=body, sensors=[])
            for name, turn in zip(names, turns, strict=True)
        },
        duration_s=600.0,
        arena=Arena(size=(size, size, 2.0)),
        rates=Rates(state_hz=10.0),
        formation=Formation(links={f"{a} - {b}": SPACING for a, b in zip(names, [*names[1:], names[0]], strict=True)}),
        trigger={"kind": "periodic", "period_s": 0.1},
    )


def places(endpoint: str, realm: str, starts: Mapping[str, Sequence[float]]) -> None:
    """Publish the start places of all robots, x, y [m], until the process is ended."""
    keys, pause = Keys(realm), threading.Event()
    with network.open_session([endpoint], name="places") as session:
        publishers = {name: pubsub.publisher(session, keys.position(name), messages.JSON) for name in starts}
        while not pause.wait(1.0 / POSITION_HZ):
            now = time.time()
            for name, (x, y) in starts.items():
                publishers[name].put(messages.encode(messages.Position(name, now, (x, y, 0.0), 0.0)))


@dataclass
class _Arrivals:
    """Messages with their times of arrival; filled by callbacks."""

    phase: dict[str, str] = field(default_factory=dict)
    missing: dict[tuple[str, str], float] = field(
        default_factory=dict
    )  # (robot, its missing neighbour) -> since [monotonic s]
    stopped: dict[str, float] = field(default_factory=dict)  # time of the first stop by robot [monotonic s]

    def status(self, sample: zenoh.Sample) -> None:
        """Take a robot's status."""

        now = time.monotonic()
        status = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Status)
        self.phase[status.robot] = status.phase
        for name in status.missing:
            self.missing.setdefault((status.robot, name), now)

    def command(self, sample: zenoh.Sample) -> None:
        """Take a command to a body."""

        now = time.monotonic()
        payload = sample.payload.to_bytes()
        if b'"action":"stop"' in payload:  # the others come two thousand times a second
            command = messages.decode(payload, str(sample.encoding), messages.Command)
            self.stopped.setdefault(command.robot, now)


class _Park:
    """A run of the ring: its processes, and the far end of all bodies; robots run when it is entered."""

    def __init__(self, count: int, body: str = BODIES[0]) -> None:
        self._experiment, self._body = ring(count, body), body
        self._names = list(self._experiment.robots)
        self._arrivals = _Arrivals()
        self._over = threading.Event()
        self._stack = ExitStack()
        self._ended: set[str] = set()

    def __enter__(self) -> _Park:
        try:
            self._open()
            self._await(lambda: self._all("ready"), "ready")
            self._order(messages.Order("takeoff"))
            self._await(lambda: self._all("airborne"), "airborne")
            self._order(messages.Order("start", at=time.time() + 0.5))
            self._await(lambda: self._all("running"), "running")
            self._over.wait(SETTLE_S)
            self._arrivals.missing.clear()  # at the begin of the run no pose had been received
        except BaseException:
            self._over.set()
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for name in self._names:  # a frozen process cannot land
            process = self._launcher.get(name)
            if process.alive:
                os.kill(process.handle.pid, signal.SIGKILL)
        self._over.set()
        self._stack.close()

    def pings(self) -> list[float]:
        """Times of empty messages from one session to a callback of the other [s]."""
        taken = []
        for number in range(PINGS):
            self._pong.clear()
            began = time.monotonic()
            self._session.put(f"{self._keys.realm}/bench/ping", str(number))
            if self._pong.wait(1.0):
                taken.append(self._pinged - began)
            self._over.wait(0.01)
        return taken

    def stop(self) -> tuple[list[float], int]:
        """Times from an emergency stop to the command at each body [s], and the number of commands that never came."""

        payload = messages.encode(messages.Stop("bench", "to see how long it takes"))
        self._arrivals.stopped.clear()
        self._stamps.write_bytes(b"")  # a body that is opened has its motors cut
        began = time.monotonic()
        self._session.put(self._keys.estop, payload, encoding=messages.JSON, priority=self._urgent, express=True)
        self._wait(lambda: len(self._stopped()) == len(self._names))
        taken = [at - began for at in self._stopped().values()]
        return taken, len(self._names) - len(taken)

    def _stopped(self) -> dict[str, float]:
        """Time of the first command to cut the motors, by robot [monotonic s]."""
        if self._body == "external":
            return self._arrivals.stopped
        first: dict[str, float] = {}
        for line in self._stamps.read_text().splitlines():
            name, at = line.split()
            first.setdefault(name, float(at))
        return first

    def lose(self, row: int, cause: signal.Signals) -> tuple[list[float], int]:
        """Times from the end of a robot until each of its two neighbours knows [s], and the number that never did."""
        name = self._names[row]
        around = [(self._names[(row + step) % len(self._names)], name) for step in (-1, 1)]
        self._ended.add(name)
        began = time.monotonic()
        os.kill(self._launcher.get(name).handle.pid, cause)
        self._wait(lambda: all(pair in self._arrivals.missing for pair in around))
        self._over.wait(0.3)  # the next measurement begins undisturbed
        known = [self._arrivals.missing[pair] - began for pair in around if pair in self._arrivals.missing]
        return known, len(around) - len(known)

    def wrong(self) -> int:
        """Number of reports that a robot is missing which is there."""
        return sum(name not in self._ended for _, name in self._arrivals.missing)

    # ------------------------------------------------------------------ processes and sessions

    def _open(self) -> None:
        self._urgent = zenoh.Priority.REAL_TIME
        self._keys: Keys = Keys(self._experiment.network.realm)
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        self._stamps = folder / "stamps"
        self._stamps.touch()
        self._launcher: Launcher = self._stack.enter_context(Launcher(folder / "logs"))
        file = folder / "ring.json"
        file.write_bytes(write_json(self._experiment))
        endpoints = [free_endpoint(0)]
        start_router(self._launcher, endpoints)
        self._session = self._stack.enter_context(network.open_session(endpoints, name="bench"))
        listener = self._stack.enter_context(network.open_session(endpoints, name="bench listens"))
        self._pong, self._pinged = threading.Event(), 0.0
        callbacks: dict[str, Callable[[zenoh.Sample], None]] = {
            self._keys.status("*"): self._arrivals.status,
            self._keys.setpoint("*"): self._arrivals.command,
            f"{self._keys.realm}/bench/ping": self._pong_arrived,
        }
        self._held = [
            listener.declare_subscriber(key, Callback(take, indirect=False)) for key, take in callbacks.items()
        ]
        external = self._body == "external"
        if external:
            # in a process of its own: arriving messages would wait for an interpreter that is busy with this
            starts = {name: tuple(robot.start) for name, robot in self._experiment.robots.items()}
            far_end = get_context("spawn").Process(
                target=places, args=(endpoints[0], self._keys.realm, starts), daemon=True
            )
            far_end.start()
            self._stack.callback(far_end.join)
            self._stack.callback(far_end.terminate)
        start = (
            ("experiments.real_time.processes.robot",)
            if external
            else ("tools.bench.reactions_robot", str(self._stamps))
        )
        for name in self._names:
            self._launcher.start(name, *start, str(file), name, "--connect", endpoints[0], "--lifeline")

    def _pong_arrived(self, _sample: zenoh.Sample) -> None:
        self._pinged = time.monotonic()
        self._pong.set()

    def _all(self, phase: str) -> bool:
        return all(self._arrivals.phase.get(name) == phase for name in self._names)

    def _order(self, order: messages.Order) -> None:
        for name, reply in orders.send_order(self._session, self._keys, self._names, order).items():
            if not reply.ok:
                raise RuntimeError(f"{name} refuses {order.order}: {reply.reason}")

    def _await(self, true: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not true():
            if time.monotonic() > deadline:
                raise RuntimeError(f"after {PATIENCE_S:g} s not all robots were {what}: {self._arrivals.phase}")
            self._over.wait(0.02)

    def _wait(self, true: Callable[[], bool]) -> None:
        deadline = time.monotonic() + MISSED_S
        while not true() and time.monotonic() < deadline:
            self._over.wait(0.01)
