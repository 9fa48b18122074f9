"""A robot process on the network in memory: with a body that writes down its orders, or on a simulated clock."""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import Any

import pytest

from agents.body.fleet import assemble
from agents.body.interface import Body, BodyState
from agents.decision.lifecycle import Phase
from agents.network import name_ownership
from agents.network.keys import Keys
from agents.runtime import descent, loop
from agents.runtime.descent import DescentTiming
from agents.runtime.loop import Runtime, Setup
from experiments.definition import bodies
from experiments.definition.experiment import Experiment
from experiments.definition.plan import Plan
from tests.network import Net
from tests.small import small
from tests.waiting import ManualClock

BEGIN = 1000.0  # of simulated clocks [s]
DRONE = small({"F": "crazyflie"})
TICKS = 5  # that a loop makes before something breaks
QUICK = DescentTiming(landing_s=0.3, stop_s=0.1, slowest=inf)


def twins(experiment: Experiment, names: Sequence[str] = ()) -> Body:
    plan = Plan(experiment)
    return assemble(bodies.body_request(plan, tuple(names or plan.names), 1))


def setup(rows: int = 1, **changes: Any) -> Setup:
    given = {"keys": Keys(), "endpoints": [], "encoding": "json", "state_hz": 50.0, "lifeline": False}
    return Setup(**{**given, "externally_measured": [False] * rows, **changes})


def process(experiment: Experiment, body: Body | None = None, names: Sequence[str] = (), **changes: Any) -> Runtime:
    """A process of robots, of all if no `names` are given; with their twins if no body is. `changes` of its setup."""
    plan = Plan(experiment)
    names = names or plan.names
    assignments = [plan.assignment(name) for name in names]
    return Runtime(assignments, body or twins(experiment, names), setup(len(names), **changes))


class Airborne:
    """A body that flies until `steps` reads after it was told to land, and fails in the calls `broken`.

    `command` breaks the loop after `TICKS` reads; each later read calls `looks`.
    """

    def __init__(self, *broken: str, steps: int = 3, rows: int = 1) -> None:
        self.broken, self.steps, self.rows = broken, steps, rows
        self.calls: list[str] = []
        self.reads = 0
        self.landing = self.stopped = False
        self.looks: Callable[[], object] = lambda: None

    def open(self) -> None:
        self.calls.append("open")

    def read(self, t: float) -> list[BodyState]:
        self.reads += 1
        if self.reads > TICKS:
            self.looks()
            self.fail("read")
        self.steps -= self.landing
        flying = self.steps > 0 and not self.stopped
        return [BodyState(t, flying=flying) for _ in range(self.rows)]

    def command(self, _setpoints: Sequence[object]) -> None:
        if self.reads == TICKS:
            raise OSError("the loop breaks")

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None: ...

    def locate(self, *_: object) -> None: ...

    def land(self, _rows: Sequence[int]) -> None:
        self.landing = True
        self.note("land")

    def stop(self, _rows: Sequence[int]) -> None:
        self.stopped = True
        self.note("stop")

    def close(self) -> None:
        self.note("close")

    def note(self, what: str) -> None:
        self.calls.append(what)
        self.fail(what)

    def fail(self, what: str) -> None:
        if what in self.broken:
            raise OSError(f"{what} fails")

    @property
    def order(self) -> list[str]:
        """The calls, each once, in the order of the first."""
        return list(dict.fromkeys(self.calls))


def clocked(monkeypatch: pytest.MonkeyPatch, clock: ManualClock, *, asks_for_owners: bool = True) -> None:
    """Let the loops of processes take their time from a clock; with `asks_for_owners` after a standstill, too."""
    for module in (loop, descent):
        monkeypatch.setattr(module, "time", clock)
    for module in (loop, name_ownership) if asks_for_owners else (loop,):
        monkeypatch.setattr(module, "uptime", clock.monotonic)


class Stage:
    """A process on a simulated clock.

    Attributes:
        orders: Times [s] and names of take-offs, landings and stops of its body.
        ticks: Times of its ticks [s].
        in_between: Called before each take-off and setpoint.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        net: Net,
        experiment: Experiment,
        names: Sequence[str] = (),
        *,
        clock: ManualClock | None = None,
        asks_for_owners: bool = True,  # after a standstill
        **changes: Any,
    ) -> None:
        self.net, self.clock = net, clock or ManualClock(BEGIN)
        clocked(monkeypatch, self.clock, asks_for_owners=asks_for_owners)
        self.body = twins(experiment, names)
        self.runtime = process(experiment, self.body, names, **changes)
        self.orders: list[tuple[float, str]] = []
        self.ticks: list[float] = []
        self.in_between: Callable[[], object] = lambda: None
        for order in ("takeoff", "land", "stop", "command"):
            setattr(self.body, order, partial(self._note, order, getattr(self.body, order)))

    def _note(self, order: str, call: Callable[..., object], *args: object) -> None:
        if order in ("takeoff", "command"):
            self.in_between()
        if order != "command":
            self.orders.append((self.clock.now, order))
        call(*args)

    @property
    def robot(self):
        return self.runtime.robots[0]

    def run(self, visit: Callable[[Phase], object], *, joined: bool = False) -> None:
        """Join, and tick until `visit`, called after each tick with the phase, is true."""
        if not joined:
            self.runtime.subscribe_to_stops(self.net.session)
            self.body.open()
            self.runtime.join(self.net.session)
        life, tick = self.robot.lifecycle, self.runtime.tick

        def ticked(t: float) -> None:
            self.ticks.append(t)
            tick(t)

        def stopping() -> str | None:
            if not visit(Phase(life.phase)):
                return None
            life.phase = int(Phase.DONE)
            return "enough"

        self.runtime.tick = ticked  # type: ignore[method-assign]
        self.runtime.run_ticks(stopping)
