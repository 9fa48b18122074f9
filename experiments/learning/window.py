"""Robots as a learner sees them after each decision: quiet functions."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from math import hypot, isfinite, nan
from typing import ClassVar, Final

import numpy as np

from agents.body.kinds import Kind
from agents.plugins.extras.observation import Observation
from agents.plugins.law import Law
from agents.robot import Robot
from agents.vectors import Vector, difference
from twins.arrays import Array

# columns of a robot: true position [m], phase, number of its last transmission, mean true error of its links [m], 1 if
# it is near another robot and 2 if it is outside of the arena, time [s] of what is shown, and its observation
PHASE, SENT, ERROR, HURT, TIME, SEEN = 3, 4, 5, 6, 7, 8
NEAR: Final = 1.0
OUTSIDE: Final = 2.0


class Window:
    """Table of all robots, filled at the end of each stretch of ticks."""

    FIXED: ClassVar = ("sees",)
    RARE: ClassVar = ("show",)

    def __init__(  # noqa: PLR0917 - six facts of a case
        self, law: Law, kinds: Sequence[Kind], low: Vector, high: Vector, agents: Sequence[int],
        observation: Observation,
    ) -> None:  # fmt: skip
        """Of robots of these `kinds`, in an arena from `low` to `high` [m]; `agents`: rows of those that observe."""
        self.law, self.observation = law, observation
        self.low, self.high = low, high
        self.radii = array("d", [kind.radius for kind in kinds])
        self.agents = array("d", [float(row in agents) for row in range(len(kinds))])
        self.sees = observation.size > 0
        self.wide = SEEN + observation.size
        self.numbers = array("d", bytes(8 * self.wide * len(kinds)))

    @property
    def table(self) -> Array:
        """Columns of all robots (N, 8 + K), where they stand."""
        return np.frombuffer(self.numbers).reshape(-1, self.wide)

    def place(self, robot: Robot, row: int, sent: int) -> None:
        """Note the true place of a robot; of all of them before the first is shown. Quiet."""
        k, numbers = self.wide * row, self.numbers
        numbers[k], numbers[k + 1] = robot.now.state.true_position[0], robot.now.state.true_position[1]
        numbers[k + 2] = robot.now.state.true_position[2]
        numbers[k + PHASE], numbers[k + SENT] = float(robot.lifecycle.phase), float(sent)

    def show(self, robot: Robot, row: int, t: float) -> None:
        """Show a robot at `t` [s]; quiet."""
        wide, numbers = self.wide, self.numbers
        k = wide * row
        place = numbers[k], numbers[k + 1], numbers[k + 2]
        total, count = 0.0, 0
        for sender in robot.neighbours.all:
            if sender.active:
                j = wide * sender.sender
                other = numbers[j], numbers[j + 1], numbers[j + 2]
                error = self.law.error(difference(place, other), sender.link)
                if isfinite(error):
                    total, count = total + error, count + 1
        numbers[k + ERROR] = total / float(count) if count > 0 else 0.0
        hurt = 0.0
        for other_row in range(len(self.radii)):
            j = wide * other_row
            apart = hypot(place[0] - numbers[j], place[1] - numbers[j + 1])
            if other_row != row and apart < self.radii[row] + self.radii[other_row]:
                hurt = NEAR
        for x, low, high in zip(place, self.low, self.high, strict=True):
            if not low <= x <= high:
                hurt = OUTSIDE
        numbers[k + HURT] = hurt
        if self.sees and robot.goals.stepping is not None and self.agents[row] > 0.0:
            for j in range(k + SEEN, k + wide):
                numbers[j] = 0.0
            self.observation.write(robot.view(t), numbers, k + SEEN)
        numbers[k + TIME] = t

    def is_of(self, t: float) -> bool:
        """Whether all robots are shown as they are at `t` [s]."""
        return all(self.numbers[k] == t for k in range(TIME, len(self.numbers), self.wide))

    def clear(self) -> None:
        """Forget what was shown."""
        for k in range(TIME, len(self.numbers), self.wide):
            self.numbers[k] = nan
