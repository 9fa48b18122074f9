"""Robots of an experiment on a clock: one without a twin, or all with theirs; and what is near a robot, by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from math import inf, isfinite
from typing import Any

from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.lifecycle import AIRBORNE, READY, RUNNING
from agents.decision.situation import ProcessHealth
from agents.plugins.avoidance import Nearby, OwnState
from agents.robot import Robot
from agents.vectors import ZERO, Vector
from bridges.khepera4.kind import KHEPERA4
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, RobotTable
from experiments.definition.plan import Plan
from tests.small import PERIODIC, small
from twins.body import TwinBody

DT, CLIMB = 0.01, 0.5  # [s], [m/s]


class Bench:
    """One robot; a drone is on the floor until it climbs."""

    def __init__(self, assignment: Assignment, position: Vector) -> None:
        self.robot, self.position, self.height = Robot(assignment), position, 0.0
        self.velocity, self.yaw, self.t = ZERO, 0.0, 0.0
        self.values: dict[str, Any] = {"battery": 0.9}  # of each measurement
        self.said: list[float] = []  # times of transmissions
        for link in range(len(self.neighbours.all)):
            self.neighbours.mark_alive(link)

    @property
    def neighbours(self):
        return self.robot.neighbours

    @property
    def life(self):
        return self.robot.lifecycle

    def hear(self, link: int, position: Vector, *, velocity: Vector = ZERO, stamp: float | None = None) -> None:
        self.neighbours.receive(link, position, velocity, self.t if stamp is None else stamp, self.t)

    def state(self) -> BodyState:
        x, y, z = self.position
        flies = self.robot.assignment.kind.flies
        if flies:
            waits = self.life.phase <= READY and not self.life.active
            self.height = 0.0 if waits else self.height + CLIMB * DT
            z = min(z, self.height)
        given = {"time": self.t, "flying": flies, **self.values}
        return BodyState(position=(x, y, z), velocity=self.velocity, yaw=self.yaw, **given)

    def step(self, seconds: float = DT, every_tick: Callable[[Bench], object] | None = None) -> Bench:
        """Let time pass; `every_tick` may change what the next tick finds."""
        for _ in range(max(1, round(seconds / DT))):
            if every_tick is not None:
                every_tick(self)
            if self.robot.transmit(self.t, self.state()):
                self.said.append(self.t)
            self.robot.act(self.t)
            self.t = round(self.t + DT, 9)
        return self

    def running(self, every_tick: Callable[[Bench], object] | None = None) -> Bench:
        self.step(DT, every_tick)
        assert self.life.takeoff() == ""
        while self.life.phase != AIRBORNE:
            self.step(DT, every_tick)
            assert self.t < 10.0, self.life.reason
        assert self.robot.start(self.t) == ""
        return self.step(DT, every_tick)


def own(kind, position, *, yaw=0.0, velocity=(0.0, 0.0, 0.0)):
    """State of a robot of a kind, at x, y (, z) [m]."""
    made = OwnState()
    made.position = (*position, 0.0)[:3] if len(position) < 3 else tuple(position)
    made.velocity, made.yaw, made.flies = tuple(velocity), yaw, kind.flies
    made.radius, made.height, made.speed, made.lag = kind.radius, kind.height, kind.speed, kind.lag
    made.turn_rate, made.response = kind.turn_rate, kind.response
    made.by_position, made.by_twist = kind.takes == "position", kind.takes == "twist"
    return made


def near(*places, velocity=(0.0, 0.0), radius=0.0, is_robot=False, lag=0.0):
    """Things at x, y [m] that are alike otherwise."""
    made = Nearby()
    made.reserve(len(places))
    for x, y in places:
        thing = made.add()
        thing.x, thing.y, thing.radius, thing.lag, thing.is_robot = x, y, radius, lag, is_robot
        thing.velocity_x, thing.velocity_y = velocity
        thing.low, thing.high = 0.0, KHEPERA4.height
    return made


NOTHING = near()


LOGGED = ("phase", "goal", "error", "setpoint", "position", "truth")


class Group:
    """Robots of one process: their decisions, and the body that they share."""

    def __init__(self, plan: Plan, names: Sequence[str]) -> None:
        self.names, health = tuple(names), ProcessHealth()
        self.robots = [Robot(plan.assignment(name), health) for name in names]
        self.body = TwinBody(bodies.body_request(plan, self.names, plan.experiment.seed))
        self.states: list[BodyState] = []
        self.sending: list[int] = []  # rows
        self.spoil: dict[str, Callable[[BodyState], None]] = {}  # changes of measurements, by name
        for robot in self.robots:
            for link in range(len(robot.neighbours.all)):
                robot.neighbours.mark_alive(link)

    def receive(self, sender: str, position: Vector, velocity: Vector, stamp: float, arrival: float) -> None:
        known = velocity if isfinite(velocity[0]) else ZERO  # as the inbox of a process does
        for robot in self.robots:
            for link, neighbour in enumerate(robot.neighbours.all):
                if neighbour.name == sender:
                    robot.neighbours.receive(link, position, known, stamp, arrival)

    def step(self, t: float) -> None:
        """One tick of the process."""
        self.states = [copy(state) for state in self.body.read(t)]
        for name, change in self.spoil.items():
            change(self.states[self.names.index(name)])
        self.sending = [row for row, robot in enumerate(self.robots) if robot.transmit(t, self.states[row])]
        for row, robot in enumerate(self.robots):
            robot.act(t)
            if robot.stops:
                self.body.stop([row])
            if robot.lands:
                self.body.land([row])
            if robot.takes_off:
                self.body.takeoff([row], [robot.assignment.hover])
        self.body.command([robot.setpoint for robot in self.robots])


class Swarm:
    """All robots of an experiment, in any number of processes."""

    def __init__(self, experiment: Experiment, groups: Iterable[Sequence[str]] | None = None) -> None:
        plan = Plan(experiment)
        self.groups = [Group(plan, group) for group in (groups or [[name] for name in experiment.robots])]
        self.where = {name: (group, row) for group in self.groups for row, name in enumerate(group.names)}
        self.names = tuple(name for name in experiment.robots if name in self.where)
        self.dt, self.tick, self.start_at = 1.0 / experiment.rates.body_hz, 0, inf
        self.sent: list[tuple[int, str]] = []
        self.log: list[dict[str, dict[str, Any]]] = []  # of each tick, by name
        self.under_way: list[tuple[str, Vector, Vector, float]] = []
        self.muted: set[tuple[str, str]] = set()  # senders and receivers that no pose passes between

    @property
    def t(self) -> float:
        return self.tick * self.dt

    def robot(self, name: str) -> Robot:
        group, row = self.where[name]
        return group.robots[row]

    def phase(self, name: str) -> int:
        return self.robot(name).lifecycle.phase

    def spoil(self, name: str, change: Callable[[BodyState], object] | None) -> None:
        """Change each measurement of a robot from now on; None: no longer."""
        self.where[name][0].spoil[name] = change or (lambda _state: None)

    def link(self, receiver: str, sender: str) -> int:
        return [each.name for each in self.robot(receiver).neighbours.all].index(sender)

    def lose(self, sender: str, receiver: str, since: float = 0.0) -> None:
        """The receiver loses the token of a sender, `since` [s] ago, and receives it no more."""
        self.robot(receiver).neighbours.mark_lost(self.link(receiver, sender), self.t - since)
        self.muted.add((sender, receiver))

    def find(self, sender: str, receiver: str) -> None:
        """The receiver sees the token of a sender again, and receives it."""
        self.robot(receiver).neighbours.mark_alive(self.link(receiver, sender))
        self.muted.discard((sender, receiver))

    def last(self, name: str, what: str) -> Any:
        """A value of one robot on the last tick."""
        return self.log[-1][name][what]

    def column(self, name: str, what: str, since: int = 0) -> list[Any]:
        """Values of one robot from a tick on."""
        return [moment[name][what] for moment in self.log[since:]]

    def conduct(self) -> None:
        phases = [self.phase(name) for name in self.names]
        if min(phases) == READY:
            for name in self.names:
                assert self.robot(name).lifecycle.takeoff() == ""
        elif min(phases) == AIRBORNE and self.start_at == inf:
            self.start_at = self.t + 0.5
            for name in self.names:
                assert self.robot(name).start(self.start_at) == ""

    def step(self) -> None:
        """One tick of all; what is sent on it is received on the next one."""
        arriving, self.under_way = self.under_way, []
        for sender, *pose in arriving:
            for group in self.groups:
                if not any((sender, name) in self.muted for name in group.names):
                    group.receive(sender, *pose, self.t)
        for group in self.groups:
            group.step(self.t)
        for name in self.names:  # in one order, however they are grouped
            group, row = self.where[name]
            if row in group.sending:
                robot = group.robots[row]
                self.sent.append((self.tick, name))
                self.under_way.append((name, robot.sent_position, robot.sent_velocity, self.t))
        self.log.append({name: self._values(name) for name in self.names})
        self.tick += 1

    def _values(self, name: str) -> dict[str, Any]:
        (group, row), robot = self.where[name], self.robot(name)
        now = group.states[row]
        values = (robot.lifecycle.phase, robot.goal, robot.error, robot.setpoint, now.position, now.true_position)
        return dict(zip(LOGGED, values, strict=True))

    def until(self, phase: int, most_s: float = 60.0) -> Swarm:
        deadline = self.t + most_s
        while min(self.phase(name) for name in self.names) < phase:
            assert self.t < deadline, {name: self.phase(name) for name in self.names}
            self.step()
            self.conduct()
        return self

    def run(self, seconds: float) -> Swarm:
        for _ in range(round(seconds / self.dt)):
            self.step()
        return self

    def running(self) -> Swarm:
        return self.until(RUNNING)


def followed(kind: str = "khepera4", distance: float = 0.5, **parts: object) -> Swarm:
    """L at the origin, and F behind it, which follows it."""
    robots: dict[str, str | RobotTable] = {"L": kind, "F": RobotTable(kind="khepera4", start=[-0.5, 0.0])}
    return Swarm(small(robots, {"L > F": distance}, **{"trigger": PERIODIC, "duration_s": 60.0, **parts}))


def drone(**parts: object) -> Swarm:
    """One Crazyflie, 0.5 m above the origin."""
    return Swarm(small({"F": "crazyflie"}, **{"duration_s": 60.0, "trigger": PERIODIC, **parts}))
