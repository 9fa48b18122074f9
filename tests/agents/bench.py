"""A robot of an experiment on a clock, where it is put: no twin, no others but those that it is told of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.lifecycle import AIRBORNE, READY
from agents.robot import Robot
from agents.vectors import ZERO, Vector

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
        """Until the experiment begins."""
        self.step(DT, every_tick)
        assert self.life.takeoff() == ""
        while self.life.phase != AIRBORNE:
            self.step(DT, every_tick)
            assert self.t < 10.0, self.life.reason
        assert self.robot.start(self.t) == ""
        return self.step(DT, every_tick)
