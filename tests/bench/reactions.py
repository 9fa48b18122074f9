"""Reaction times of robots: to an emergency stop, to a neighbour that was killed, to one that hangs.

Twenty robots run as processes of their own. The command to cut the motors is stamped where the body obeys it, by the
clock by which the stop was sent: for twins in the robot's process, for external bodies here. The knowledge of a death
is stamped when a status arrives here: one way over the router more than the robot needs. Callbacks of Zenoh stamp.
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
from math import cos, inf, pi, sin
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import zenoh
from zenoh.handlers import Callback

from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from experiments.definition.experiment import Arena, Formation, Rates, RobotTable
from experiments.definition.plan import Plan
from experiments.file.document import write_json
from experiments.real_time.conductor import orders
from experiments.real_time.hosts.launcher import ROUTER, Launcher, Router
from tests.bench.measuring import Figure
from tests.reliability import spoilt_process
from tests.reliability.spoilt_process import ROBOT, Switch

ROBOTS: Final = 20
BODIES: Final = ("twin", "external")
STOPS: Final = 5  # emergency stops of each kind of body; each ends its run, so that there is one fresh run for each
DEATHS: Final = 3  # runs in which robots die
KILLED, FROZEN = 7, 3  # robots of each such run; their neighbours in the ring stay, to notice
SETTLE_S: Final = 2.0  # robots run for so long before anything happens
PATIENCE_S: Final = 60.0
MISSED_S: Final = 10.0  # a reaction that has not come by then never will
SPACING: Final = 0.8  # [m] around the ring
PINGS: Final = 20  # round trips of nothing, before each measurement

LIMITS_S: Final = {
    "emergency stop until motors off, twin": 0.020,
    "emergency stop until motors off, external": 0.020,
    "neighbour killed until known": 0.1,
    "neighbour frozen until known": 1.5,
}


def safety() -> Iterator[Figure]:
    """Reaction times with twenty robots running, beside an empty way over the router in the same run."""
    pings: list[float] = []
    taken: dict[str, list[float]] = {what: [] for what in LIMITS_S}
    wrong = 0
    deaths = [("killed", signal.SIGKILL)] * KILLED + [("frozen", signal.SIGSTOP)] * FROZEN
    for number, body in enumerate((*BODIES * STOPS, *BODIES[:1] * DEATHS)):
        with ExitStack() as stack:
            park = _Park(stack, body)
            pings += park.pings()
            if number < len(BODIES) * STOPS:
                taken[f"emergency stop until motors off, {body}"] += park.stop()
            else:  # of every second robot at most: both neighbours of each must live to notice
                for row, (what, cause) in enumerate(deaths):
                    taken[f"neighbour {what} until known"] += park.lose(2 * row, cause)
            wrong += park.wrong()
    empty = statistics.median(pings)
    yield from _figures("an empty way over the router", pings, empty, empty, "yardstick")
    for what, limit_s in LIMITS_S.items():
        yield from _figures(what, taken[what], empty, limit_s, f"of {limit_s:g} s")
    missed = sum(time == inf for times in taken.values() for time in times)
    for what, count in (("reactions that did not come", missed), ("robots held for dead that were not", wrong)):
        yield Figure("safety", what, float(count), "", float(count), "wanted: 0")
    load = os.getloadavg()[0]
    yield Figure("safety", "load of the machine", load, "", load / (os.cpu_count() or 1), "× its cores")


def _figures(what: str, taken: Sequence[float], empty: float, wanted: float, of: str) -> Iterator[Figure]:
    """Median, 99th percentile and largest of some times [s]; the median over an empty way, the others over the aim."""
    ordered = sorted(time for time in taken if time < inf)
    if not ordered:
        return
    middle = statistics.median(ordered)
    late = ordered[round(0.99 * (len(ordered) - 1))]
    yield Figure("safety", f"{what}, median of {len(ordered)}", 1e3 * middle, "ms", middle / empty, "× an empty way")
    yield Figure("safety", f"{what}, 99 %", 1e3 * late, "ms", late / wanted, of)
    yield Figure("safety", f"{what}, slowest", 1e3 * ordered[-1], "ms", ordered[-1] / wanted, of)


def ring(count: int, body: str) -> Plan:
    """Robots on wheels in a ring, each listening to the one before and the one behind, all with such a body."""
    radius, names = 0.5 * SPACING / sin(pi / count), [f"R{k:03}" for k in range(count)]
    size = 2.0 * radius + 2.0
    robots = {}
    for k, name in enumerate(names):
        angle = 2.0 * pi * k / count
        start = [radius * cos(angle), radius * sin(angle)]
        robots[name] = RobotTable(kind="khepera4", start=start, body=body, sensors=[])
    return Plan.made(
        title="a ring",
        robots=robots,
        duration_s=600.0,
        arena=Arena(size=(size, size, 2.0)),
        rates=Rates(state_hz=10.0),
        formation=Formation(links={f"{names[k - 1]} - {name}": SPACING for k, name in enumerate(names)}),
        trigger={"kind": "periodic", "period_s": 0.1},
    )


def places(endpoint: str, realm: str, starts: Mapping[str, Sequence[float]]) -> None:
    """Publish the start places of all robots, x, y [m], until the process is ended."""
    keys, pause = Keys(realm), threading.Event()
    with network.open_session([endpoint], name="places") as session:
        publishers = {name: pubsub.publisher(session, keys.position(name), messages.JSON) for name in starts}
        while not pause.wait(0.02):
            now = time.time()
            for name, (x, y) in starts.items():
                publishers[name].put(messages.encode(messages.Position(name, now, (x, y, 0.0), 0.0)))


class _Park:
    """The processes of a run of the ring, and the far end of all bodies.

    Attributes:
        missing: (robot, its missing neighbour) -> since [monotonic s].
    """

    def __init__(self, stack: ExitStack, body: str) -> None:
        """Start the processes, and wait until all robots are running; `stack` ends them."""
        plan = ring(ROBOTS, body)
        self._names, self._keys = list(plan.names), Keys(plan.experiment.network.realm)
        self._ended: set[str] = set()
        self._pong, self._pinged = threading.Event(), 0.0
        # filled by callbacks, all times are monotonic [s]
        self._phase: dict[str, str] = {}
        self.missing: dict[tuple[str, str], float] = {}
        self._stopped: dict[str, float] = {}  # first stop of an external body, by robot
        self._cuts: dict[str, Switch] = {}  # and that of a twin
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self._launcher = stack.enter_context(Launcher(folder / "logs"))
        stack.callback(lambda: [*map(self._launcher.kill, self._names)])  # a frozen process cannot land
        file = folder / "ring.json"
        file.write_bytes(write_json(plan))
        endpoints = [free_endpoint(0)]
        Router(ROUTER, endpoints).start(self._launcher)
        self._session = stack.enter_context(network.open_session(endpoints, name="bench"))
        listener = stack.enter_context(network.open_session(endpoints, name="bench listens"))
        callbacks: dict[str, Callable[[zenoh.Sample], None]] = {
            self._keys.status("*"): self._take_status,
            self._keys.setpoint("*"): self._take_command,
            f"{self._keys.realm}/bench/ping": self._take_pong,
        }
        self._held = [
            listener.declare_subscriber(key, Callback(take, indirect=False)) for key, take in callbacks.items()
        ]
        start = [ROBOT]
        if body == "external":
            # in a process of its own: arriving messages would wait for an interpreter that is busy with this
            starts = {name: tuple(robot.start) for name, robot in plan.experiment.robots.items()}
            arguments = (endpoints[0], self._keys.realm, starts)
            far_end = get_context("spawn").Process(target=places, args=arguments, daemon=True)
            far_end.start()
            stack.callback(far_end.join)
            stack.callback(far_end.terminate)
        else:
            self._cuts = {name: Switch(folder / f"cut-{name}") for name in self._names}
            start = [spoilt_process.MODULE, str(folder), ROBOT]
        for name in self._names:
            self._launcher.start(name, *start, str(file), name, "--connect", endpoints[0], "--lifeline")
        self._await_phase("ready")
        self._order(messages.Order("takeoff"))
        self._await_phase("airborne")
        self._order(messages.Order("start", at=time.time() + 0.5))
        self._await_phase("running")
        time.sleep(SETTLE_S)
        self.missing.clear()  # at the begin of the run no pose had been received

    def _await_phase(self, phase: str) -> None:
        if not _wait(lambda: all(self._phase.get(name) == phase for name in self._names), PATIENCE_S):
            raise RuntimeError(f"after {PATIENCE_S:g} s not all robots were {phase}: {self._phase}")

    def _order(self, order: messages.Order) -> None:
        for name, reply in orders.send_order(self._session, self._keys, self._names, order).items():
            if not reply.ok:
                raise RuntimeError(f"{name} refuses {order.order}: {reply.reason}")

    def pings(self) -> list[float]:
        """Times of empty messages from one session to a callback of the other [s]."""
        taken = []
        for number in range(PINGS):
            self._pong.clear()
            began = time.monotonic()
            self._session.put(f"{self._keys.realm}/bench/ping", str(number))
            if self._pong.wait(1.0):
                taken.append(self._pinged - began)
            time.sleep(0.01)
        return taken

    def stop(self) -> list[float]:
        """Times from an emergency stop to the command at each body [s]; inf: it never came."""
        payload = messages.encode(messages.Stop("bench", "to see how long it takes"))
        for cut in self._cuts.values():  # a body that is opened has its motors cut
            cut.write(0.0)
        self._stopped.clear()
        began = time.monotonic()
        urgent = zenoh.Priority.REAL_TIME
        self._session.put(self._keys.estop, payload, encoding=messages.JSON, priority=urgent, express=True)
        _wait(lambda: len(self._stops()) == len(self._names), MISSED_S)
        stops = self._stops()
        return [stops.get(name, inf) - began for name in self._names]

    def _stops(self) -> dict[str, float]:
        """Time of the first command to cut the motors, by robot [monotonic s]."""
        return self._stopped | {name: at for name, cut in self._cuts.items() if (at := cut.read())}

    def lose(self, row: int, cause: signal.Signals) -> list[float]:
        """Times from the end of a robot until each of its two neighbours knows [s]; inf: it never did."""
        name = self._names[row]
        around = [(self._names[(row + step) % len(self._names)], name) for step in (-1, 1)]
        self._ended.add(name)
        began = time.monotonic()
        os.kill(self._launcher.get(name).handle.pid, cause)
        _wait(lambda: all(pair in self.missing for pair in around), MISSED_S)
        time.sleep(0.3)  # the next measurement begins undisturbed
        return [self.missing.get(pair, inf) - began for pair in around]

    def wrong(self) -> int:
        """Number of reports that a robot is missing which is there."""
        return sum(name not in self._ended for _, name in self.missing)

    def _take_status(self, sample: zenoh.Sample) -> None:
        now = time.monotonic()
        status = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Status)
        self._phase[status.robot] = status.phase
        for name in status.missing:
            self.missing.setdefault((status.robot, name), now)

    def _take_command(self, sample: zenoh.Sample) -> None:
        now = time.monotonic()
        payload = sample.payload.to_bytes()
        if b'"action":"stop"' in payload:  # the others come two thousand times a second
            command = messages.decode(payload, str(sample.encoding), messages.Command)
            self._stopped.setdefault(command.robot, now)

    def _take_pong(self, _sample: zenoh.Sample) -> None:
        self._pinged = time.monotonic()
        self._pong.set()


def _wait(true: Callable[[], bool], limit_s: float) -> bool:
    """Wait until something is true; False if it is not in time."""
    deadline = time.monotonic() + limit_s
    while not (over := true()) and time.monotonic() < deadline:
        time.sleep(0.01)
    return over
