"""Whatever a body, a network or an operator says: a robot's tick raises nothing, and its setpoint keeps the limits."""

import random
from functools import partial
from math import inf, isfinite, nan

import pytest

from agents.body.interface import BodyState, RangeScan
from agents.decision.lifecycle import AIRBORNE
from agents.plugins import registry
from agents.robot import Robot
from experiments.file.document import load
from tests.cases import mostly_slow

ODD = (nan, inf, -inf, 0.0, -0.0, 1e308, -1e308, 1e-308, 5e-324, 1e154, -1e154, 1e6, -1e6)
SLOW = partial(pytest.param, marks=pytest.mark.slow)


class Nonsense:
    """Numbers, some of which are odd."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self._share = self.random.choice((0.0, 0.02, 0.3))

    def number(self, size: float = 1.0) -> float:
        return self.random.choice(ODD) if self.happens(self._share) else self.random.uniform(-size, size)

    def numbers(self, count: int, size: float = 1.0) -> tuple[float, ...]:
        return tuple(self.number(size) for _ in range(count))

    def happens(self, share: float) -> bool:
        return self.random.random() < share

    def state(self, t: float, *, flies: bool) -> BodyState:
        state = BodyState(
            t + self.number(0.02), self.numbers(3, 1.5), self.numbers(3, 0.5), self.number(3.0),
            battery=self.number(), flying=flies and self.happens(0.7), attitude=self.numbers(4),
            ahead=self.number(0.1), received=t - self.number(0.1),
        )  # fmt: skip
        if self.happens(0.1):
            state.scan = RangeScan(t - self.number(0.1), *(self.numbers(5, size) for size in (3.0, 0.3, 2.0)))
        return state


def disturb(robot: Robot, t: float, some: Nonsense) -> None:
    """Poses, losses, orders, goals of a centre and external positions."""
    neighbours = robot.neighbours
    for k in range(len(neighbours.all)):
        if some.happens(0.3):
            place, velocity = (tuple(some.random.uniform(-2.0, 2.0) for _ in range(3)) for _ in range(2))
            neighbours.receive(k, place, velocity, t - some.random.uniform(0.0, 0.1), t)
        if some.happens(0.006):
            neighbours.mark_alive(k)
        if some.happens(0.004):
            neighbours.mark_lost(k, t)
    for share, order in (
        (0.02, robot.lifecycle.takeoff), (0.03, lambda: robot.start(t + 0.05, t)), (0.005, robot.hold),
        (0.005, robot.resume), (0.01, lambda: robot.go(some.numbers(2), t)),
        (0.1, lambda: robot.believes(t - some.number(0.1), some.numbers(3))),
        (0.1, lambda: robot.believed_yaw(t, some.number(3.0))),
    ):  # fmt: skip
        if some.happens(share):
            order()
    if robot.guidance is not None and some.happens(0.2):
        robot.guidance.receive(some.numbers(3), some.number(3.0), t)


def keeps_limits(robot: Robot) -> bool:
    """Whether the setpoint is whole or none, and within what the kind can and the arena allows."""
    kind, limits, setpoint = robot.assignment.kind, robot.assignment.limits, robot.setpoint
    if not any(map(isfinite, setpoint)):
        return True
    fits = abs(setpoint[0]) <= kind.speed + 1e-9
    if kind.takes == "position":
        inside = [low <= x <= high for low, x, high in zip(limits.low, setpoint, limits.high, strict=False)]
        fits = all(inside) or not robot.now.sound
    return fits and all(map(isfinite, setpoint))


@pytest.mark.parametrize("name", ["robotic-park", *map(SLOW, ["obstacle-course", "convoy", "architectures"])])
@pytest.mark.parametrize("trigger", mostly_slow(registry.names(registry.TRIGGERS), 3))
def test_nonsense_raises_nothing(name, trigger):
    for number, given in enumerate(load(name).cases().values()):
        plan = given.changed(trigger={"kind": trigger})
        for row, robot_name in enumerate(plan.names[:4]):
            some, robot, t = Nonsense(hash((number, row)) & 0xFFFF), Robot(plan.assignment(robot_name)), 0.0
            for tick in range(150):
                t += 0.01 if some.happens(0.99) else some.random.choice((0.5, 3.0))
                disturb(robot, t, some)
                if tick == 20:
                    robot.lifecycle.phase = max(robot.lifecycle.phase, AIRBORNE)
                robot.transmit(t, some.state(t, flies=robot.assignment.kind.flies))
                robot.act(t)
                assert keeps_limits(robot), (robot_name, tick, robot.setpoint)
