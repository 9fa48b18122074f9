"""The virtual clock: the whole experiment in one process, without sleeping, reproducible to the bit from its seed.

The decision is `agents.robot`, the bodies are the twins, the network is `experiments.virtual_time.network`; this file
is only the loop.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any, Final

import numpy as np

from agents.body.interface import BodyState
from agents.body.shadow_twin import shadowed
from agents.decision.assignment import Assignment
from agents.decision.lifecycle import AIRBORNE, DONE, RUNNING
from agents.plugins.calls import explain, supervised
from agents.plugins.law import View
from agents.plugins.registry import FAILURES
from agents.robot import Robot
from agents.safety.hazards import HazardChange
from experiments.arrays import PoseTable
from experiments.definition.bodies import body_request, shadow_periods, shared_world
from experiments.definition.plan import Plan
from experiments.recording.trace import OPTIONAL
from experiments.virtual_time.conductor import PATIENCE_S, Stuck, VirtualConductor
from experiments.virtual_time.network import CentreLog, VirtualNetwork
from experiments.virtual_time.steps import Steps
from experiments.virtual_time.stretch import Stretches, TornError, stretches_of
from experiments.virtual_time.tick import LEAN, PLACES, WIDTH, Display, Ledger
from twins.arrays import Array, Index
from twins.body import TwinBody
from twins.engines.engine import Engine, Touch

STATE: Final = ("position", "velocity", "yaw", "true_position", "true_yaw")  # columns from the state of the bodies


@dataclass(frozen=True)
class VirtualRunLog:
    """Everything recorded of a virtual run; times since the common start [s], arrays over samples (K), robots (N)."""

    names: tuple[str, ...]  # (N)
    seed: int
    lean: bool  # only `true_position`, and of poses only numbers and times, are kept
    time: Array  # (K,) at state_hz, from before take-off (negative) to the end
    phase: Index  # (K, N) `agents.decision.lifecycle.Phase`
    position: Array  # (K, N, 3) [m] measured
    velocity: Array  # (K, N, 3) [m/s] measured
    yaw: Array  # (K, N) [rad] measured
    true_position: Array  # (K, N, 3) [m]
    true_yaw: Array  # (K, N) [rad]
    goal: Array  # (K, N, 3) [m]
    setpoint: Array  # (K, N, 4)
    error: Array  # (K, N) [m]
    sent: PoseTable  # poses of all robots; `link` is the row
    received: PoseTable  # poses on all links
    lost: Index  # (E,) samples lost on each link, from the common start to the landing
    decisions: int  # coordination decisions of each robot
    updates: Index  # (N,) recomputed goals
    interventions: Index  # (N,) ticks on which safety changed the decision, from the common start on
    avoided: Index  # (N,) ticks on which avoidance changed the decision, from the common start on
    touches: tuple[Touch, ...]  # contacts, by their beginning
    ticks: int  # ticks from the common start to the end
    airborne: float  # [s] all robots were up (negative)
    ended: float  # [s] all robots were done
    attitude: Array | None  # (K, N, 4) unit quaternions w, x, y, z from robot to room; None if the engine has none
    obstacles: Array  # (K, M, 3) x, y [m], yaw [rad] of each
    # (K, N, 3) of the twins beside the robots, NaN for robots without one; None if there is none
    shadow_position: Array | None
    shadow_yaw: Array | None  # (K, N) of those twins
    says: Mapping[str, int] = field(default_factory=dict)  # sizes of variables beside poses, which are `sent.extra`
    # of laws that remember, by name: variables (K, N, k), none if lean, and measures (K, N); NaN where unknown
    memory: Mapping[str, Array] = field(default_factory=dict)
    measures: Mapping[str, Array] = field(default_factory=dict)
    velocities: tuple[bool, ...] = ()  # (N) robots with a velocity from the last step of their law
    centre: CentreLog | None = None  # None if each robot decides for itself
    incidents: tuple[tuple[int, HazardChange], ...] = ()  # hazards, each with the row of its robot, in order of time


@dataclass(frozen=True)
class Snapshot:
    """Present state of a run in virtual time, for observers; read only."""

    time: float  # [s] time since the common start; NaN before it is known
    now: float  # [s] time of the clock of the decision
    robots: Sequence[Robot]
    states: Sequence[BodyState]  # states of their bodies
    engine: Engine  # engine of the bodies


@supervised()
def simulate(
    plan: Plan,
    seed: int,
    *,
    quiet: bool = False,
    lean: bool = False,
    landing: bool = True,
    progress: Callable[[float], object] = lambda _: None,
    patience_s: float = PATIENCE_S,
) -> VirtualRunLog:
    """Flies one case, compiled.

    Args:
        seed: Of all that is random.
        quiet: Fly without noise.
        lean: Keep `true_position`, measures of laws, and of the poses sent numbers and times: a seventh of the memory,
            for sweeps. The other columns are empty, and so is the table of received poses.
        landing: Let the robots land; else the log ends with the run.
        progress: Called at state_hz with the time of the experiment [s]; NaN before its start is known.
        patience_s: Limit for robots to become ready, airborne or done [s].

    Raises:
        Stuck: If robots do not become ready, airborne or done.
        PluginError: If a plug-in fails; the error names it.
    """
    flight = VirtualRun(plan, seed, quiet=quiet, lean=lean, patience_s=patience_s)
    try:
        flight.fly(landing=landing, progress=progress)
    except FAILURES as error:
        plugins = [each for robot in flight.robots for each in robot.assignment.plugins]
        raise explain(error, plugins) from error
    return flight.log()


class VirtualRun:
    """A run in virtual time."""

    def __init__(
        self,
        plan: Plan,
        seed: int,
        *,
        quiet: bool = False,
        lean: bool = False,
        patience_s: float = PATIENCE_S,
        assignments: Mapping[str, Assignment] | None = None,
        window: Display | None = None,
    ) -> None:
        """Set up a run; for the arguments see `simulate`.

        Args:
            assignments: By the names of robots, of those with a law or a trigger other than the file's.
            window: Display of a learner, for `fly_ticks`.
        """
        self.window = window
        self._begin = partial(self._set_up, plan, seed, assignments or {}, quiet=quiet, patience_s=patience_s)
        self.lean = lean
        self._begin()

    def _set_up(
        self, plan: Plan, seed: int, others: Mapping[str, Assignment], *, quiet: bool, patience_s: float
    ) -> None:
        self.plan, self._seed = plan, seed
        self.names = names = plan.names
        self.robots = [Robot(others.get(name) or plan.assignment(name)) for name in names]
        request = body_request(plan, names, seed, quiet=quiet)
        request = replace(request, external=(False,) * len(names))  # no motion capture in virtual time
        self.twin = TwinBody(request, shared_world(plan, names))
        self._body = shadowed(self.twin, request, shadow_periods(plan, names))
        self.network = VirtualNetwork(plan, self.robots, seed, lean=self.lean)
        moves = self.twin.lonely or self.twin.together
        self.compiles = self._body is self.twin and moves and self.network.is_quiet
        self._laws = [robot.stepping for robot in self.robots]  # those of guided robots are the centre's
        if (centre := self.network.centre) is not None:
            guides = centre.centre.robots
            self._laws = [
                guide.computer.stepping if guide.guided else law for guide, law in zip(guides, self._laws, strict=True)
            ]
        self._conductor = VirtualConductor(self.robots, patience_s)
        rates = plan.experiment.rates
        self.dt, self.log_every = 1.0 / rates.body_hz, round(rates.body_hz / rates.state_hz)
        self._duration = plan.experiment.duration_s - 0.5 * self.dt  # [s] robots that land later are not lost
        self._tick = 0
        self.stretches: Stretches | None = None  # compiled ones, where they pay
        self._columns: dict[str, list[Array]] = {}
        self.touches: list[Touch] = []  # contacts that began so far
        self._memory, self._measures = LawColumns(), LawColumns()

    def fly(self, *, landing: bool, progress: Callable[[float], object] = lambda _: None) -> None:
        """Flies until all robots are done, or to the end of the run without `landing`."""
        try:
            self._fly(stretches_of(self, DONE if landing else RUNNING), landing, progress)
        except TornError:
            self._begin()
            self._fly(None, landing, progress)

    def _fly(self, stretches: Stretches | None, landing: bool, progress: Callable[[float], object]) -> None:
        conductor, dt = self._conductor, self.dt
        first, self.stretches = self.robots[0], stretches
        while not conductor.over:
            self.observe(self.time)
            self._fly_stretch()
            t = self.time
            self._act(t)
            if (first.tick - 1) % self.log_every == 0:  # the robots' count restarts at the common start
                progress(t - conductor.start_at)
                self._sample(t)
            if not landing and t - conductor.start_at >= self.plan.experiment.duration_s - 0.5 * dt:
                return
            self._give_orders()
            self._tick += 1

    def _fly_stretch(self, end: int = sys.maxsize) -> bool:
        """Fly a compiled stretch, where one pays now, from between the halves of this tick to those of another.

        It stays open where it leads beyond tick `end`. Returns whether there was one.
        """
        stretches, first = self.stretches, self._tick
        if stretches is None or self.network.retired or not (stretches.open or stretches.begin(first)):
            return False
        last, goes_on = min(end, stretches.end), True
        while goes_on and (self._tick < last or stretches.moved):
            goes_on = stretches.go(min(last, self._conductor.next_order(first, self.dt)))
            self._tick = first = stretches.tick
            if goes_on and first < last and not stretches.moved:
                stretches.order(self._give_orders)
                first, goes_on = first + 1, not self._conductor.over
        if not (goes_on and end < stretches.end) and stretches.leave():
            self._detect(self.time)
        return True

    def _give_orders(self) -> None:
        self._conductor.give_orders(self.time, self.dt)
        self.twin.begun_at = self._conductor.start_at

    @property
    def time(self) -> float:
        """Time of the tick that is next, or half done [s]."""
        return self._tick * self.dt

    def begin(self) -> float:
        """Fly to the common start; returns its time [s]. There all robots have observed, and `decide` comes next.

        Raises Stuck if robots do not become ready or airborne, or end before.
        """
        self.stretches = None if self.twin.together else stretches_of(self, AIRBORNE)
        while not self._conductor.over:
            self.observe(self.time)
            self._fly_stretch()
            if any(robot.begun for robot in self.robots):
                return self.time
            self.decide(self.time)
        raise Stuck(f"no robot begins: {self.robots[0].lifecycle.reason}")

    def observe(self, t: float) -> None:
        """First half of the tick at `t` [s]: bodies are read, poses received and sent, hazards detected."""
        self._receive(t)
        self._detect(t)

    def decide(self, t: float) -> None:
        """Second half of the tick at `t` [s]: goals, setpoints and commands, then the orders of the conductor."""
        self._act(t)
        self._give_orders()
        self._tick += 1

    def fly_ticks(self, count: int) -> None:
        """Fly `count` ticks from between the halves of this one, compiled where that pays; then fill the window.

        For anything else of the robots call `read`.
        """
        end = self._tick + count
        while self._tick < end:
            if not self._fly_stretch(end):
                self.decide(self.time)
                self.observe(self.time)
        self.show()

    def rewind(self, t: float) -> bool:
        """Go back to `t` [s], if compiled ticks flew all since; returns whether that was possible."""
        k = round(t / self.dt)
        if self.stretches is None or not self.stretches.rewind(k):
            return False
        self._tick = k
        return True

    def show(self) -> None:
        """Fill the window, unless compiled ticks did."""
        window = self.window
        if window is not None and not window.is_of(self.time):
            self.read(everything=False)
            for row, robot in enumerate(self.robots):
                window.place(robot, row, self.network.seq[row])
            for row, robot in enumerate(self.robots):
                window.show(robot, row, self.time)
                self._keep(robot)

    def read(self, *, everything: bool = True) -> None:
        """Read the robots as they are, if compiled ticks fly them; not `everything`: states, phases and views alone."""
        if self.stretches is not None and self.stretches.open:
            self.stretches.read(None if everything else self._seen())

    def _seen(self) -> Iterator[object]:
        """Objects that states, phases and views show."""
        for robot in self.robots:
            yield from (robot.now.state, robot.now, robot.lifecycle, robot.goals)
            yield from robot.goals.rare_parts()

    def view(self, row: int) -> View:
        """View of a robot, as its law would get it now; once in a tick."""
        view = self.robots[row].view(self.time)
        self._keep(self.robots[row])
        return view

    def _keep(self, robot: Robot) -> None:
        """Let compiled ticks know what a view changed."""
        goals = robot.goals
        if self.stretches is not None and (goals.changes_shape or goals.itinerary is not None):
            self.stretches.write([goals, *goals.rare_parts()])

    def __getstate__(self) -> dict[str, Any]:
        if self.stretches is not None and self.stretches.open:
            self.stretches.leave()
        return self.__dict__ | {"stretches": None, "window": None}

    def snapshot(self, t: float) -> Snapshot:
        """State of the run at `t` [s]."""
        return Snapshot(t - self._conductor.start_at, t, self.robots, self._states, self.twin.engine)

    @property
    def start_at(self) -> float:
        """Common start [s], NaN before it is known."""
        return self._conductor.start_at

    def _receive(self, t: float) -> None:
        self._states = self._body.read(t)
        self.network.deliver(t)
        for robot, state in zip(self.robots, self._states, strict=True):
            robot.take(t, state)

    def _detect(self, t: float) -> None:
        self._transmit(t)
        for robot in self.robots:
            robot.detect(t)

    def _act(self, t: float) -> None:
        body, network = self._body, self.network
        begin = self._conductor.start_at
        for row, robot in enumerate(self.robots):
            robot.finish(t)
            if robot.takes_off:
                body.takeoff((row,), (robot.assignment.hover,))
            if robot.lands:
                body.land((row,))
            if robot.stops:
                body.stop((row,))
            if robot.descending and row not in network.retired and t < begin + self._duration:
                network.retire(row, t)
        body.command([robot.setpoint for robot in self.robots])
        if touches := self.twin.touches():
            self.touches += touches

    def _transmit(self, t: float) -> None:
        """Phases move on, poses are transmitted, and goals of a central controller."""
        robots, network = self.robots, self.network
        start, sent = self._conductor.start_at, False
        for row, robot in enumerate(robots):
            if not robot.is_steady(t):
                robot.live(t)
            if robot.transmission_due(t) and row not in network.retired:
                network.transmit(row, robot, t, robot.now.state.yaw, start)
                sent = True
        if sent and network.instant:
            network.deliver(t)
        if network.centre is not None and robots[0].decision_due:
            network.centre.decide(t)
            if network.centre.instant:
                network.centre.deliver(t)

    def _sample(self, t: float) -> None:
        """Note the state of all robots."""
        states = [robot.now.state for robot in self.robots]
        sample: dict[str, Any] = {"time": t, "true_position": [state.true_position for state in states]}
        if any(self._laws):
            self._measures.add([{} if law is None else law.measures for law in self._laws])
            if not self.lean:
                self._memory.add([{} if law is None else law.memory for law in self._laws])
        if not self.lean:
            for what in (*STATE, *OPTIONAL):
                sample[what] = [getattr(state, what) for state in states]
            sample["phase"] = [robot.lifecycle.phase for robot in self.robots]
            for what in ("goal", "setpoint", "error"):
                sample[what] = [getattr(robot, what) for robot in self.robots]
            sample["obstacles"] = [tuple(each) for each in self.twin.engine.obstacles]
        for what, value in sample.items():
            self._columns.setdefault(what, []).append(np.array([value]))

    def note(self, ledger: Ledger, steps: Steps) -> None:
        """Note the samples of a compiled stretch."""
        count, rows = ledger.sample, len(self.robots)
        columns = self._columns
        columns.setdefault("time", []).append(np.array(ledger.times[:count]))
        if any(self._laws):
            memory, measures = steps.columns(ledger)
            self._memory.extend(count, memory)
            self._measures.extend(count, measures)
        wide = LEAN if self.lean else WIDTH
        numbers = np.frombuffer(ledger.samples)[: count * rows * wide].reshape(count, rows, wide)
        if self.lean:
            columns.setdefault("true_position", []).append(numbers.copy())
            return
        for what, (begin, end) in PLACES.items():
            column = numbers[:, :, begin] if end == begin + 1 else numbers[:, :, begin:end]
            columns.setdefault(what, []).append(column.astype(np.intp if what == "phase" else float))
        obstacles = [tuple(each) for each in self.twin.engine.obstacles]
        moved = [steps.obstacles.get(t, obstacles) for t in ledger.times[:count]]
        columns.setdefault("obstacles", []).append(np.array(moved).reshape(count, *np.array(obstacles).shape))
        for what in OPTIONAL:
            values = np.array([getattr(robot.now.state, what) for robot in self.robots])
            columns.setdefault(what, []).append(np.repeat(values[None], count, axis=0))

    def log(self) -> VirtualRunLog:
        """Everything recorded so far."""
        conductor, names = self._conductor, self.names
        begin, time = conductor.start_at, np.concatenate(self._columns["time"])
        columns: dict[str, Any] = {}
        for what in (*STATE, *OPTIONAL, "phase", "goal", "setpoint", "error", "obstacles"):
            if self.lean and what != "true_position":
                columns[what] = None if what in OPTIONAL else np.zeros((len(time), len(names), 0))
                continue
            columns[what] = np.concatenate(self._columns[what])
            self._columns[what] = [columns[what]]  # parts of many robots take as much as the whole does
            if what in OPTIONAL and np.isnan(columns[what]).all():
                columns[what] = None
        incidents = [(row, each) for row, robot in enumerate(self.robots) for each in robot.hazards.incidents]
        declared = chain.from_iterable(law.law.MEASURES for law in self._laws if law is not None)
        return VirtualRunLog(
            names=names,
            seed=self._seed,
            lean=self.lean,
            time=time - begin,
            decisions=max(robot.decisions for robot in self.robots),
            updates=np.array([robot.updates for robot in self.robots], dtype=np.intp),
            interventions=np.array([robot.interventions for robot in self.robots], dtype=np.intp),
            avoided=np.array([robot.evasions for robot in self.robots], dtype=np.intp),
            touches=tuple(replace(touch, time=touch.time - begin) for touch in self.touches),
            ticks=round(self.plan.experiment.duration_s / self.dt),
            airborne=conductor.airborne_at - begin,
            ended=self._tick * self.dt - begin,
            memory=self._memory.columns(),
            measures=self._measures.columns(declared),
            velocities=tuple(law is not None and law.gives_velocity for law in self._laws),
            incidents=tuple(
                (row, each._replace(time=each.time - begin))
                for row, each in sorted(incidents, key=lambda pair: pair[1].time)
            ),
            **self.network.logged(begin),
            **columns,
        )


class LawColumns:
    """Variables or measures of the laws of N robots, by name, as columns over samples."""

    def __init__(self) -> None:
        self._parts: list[tuple[int, dict[str, Array]]] = []  # numbers of samples, each with their columns

    def add(self, sample: Sequence[Mapping[str, Any]]) -> None:
        """Add a sample, by robot."""
        known = dict(chain.from_iterable(row.items() for row in sample))
        blank = {name: np.full_like(value, np.nan, dtype=float) for name, value in known.items()}
        columns = {
            name: np.array([[row.get(name, none) for row in sample]], dtype=float) for name, none in blank.items()
        }
        self._parts.append((1, columns))

    def extend(self, count: int, columns: dict[str, Array]) -> None:
        """Add columns over `count` samples."""
        if count:
            self._parts.append((count, columns))

    def columns(self, order: Iterable[str] = ()) -> dict[str, Array]:
        """(K, N) of numbers, (K, N, k) of tuples; NaN where a robot has no such value. Names in this `order` first."""
        blank = {name: np.full_like(column[0], np.nan) for _, part in self._parts for name, column in part.items()}
        return {
            name: np.concatenate([part.get(name, np.repeat(blank[name][None], k, axis=0)) for k, part in self._parts])
            for name in dict.fromkeys((*order, *blank))
            if name in blank
        }
