"""Actions of agents, in place of the law, and perhaps of the trigger, of their robots."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import nan
from typing import Any, Final, Literal

import numpy as np

from agents.decision.assignment import Assignment
from agents.errors import ExplainedError, did_you_mean
from agents.plugins.law import Control, Law, Memory, View
from agents.plugins.triggers import Trigger, TriggerView
from twins.arrays import Array

Action = Literal["velocity", "goal"]

SILENT: Final = ("x", "y")  # numbers of an action
TALKING: Final = (*SILENT, "whether to transmit")


class LearningError(ExplainedError, ValueError):
    """An environment of learning cannot be made, or cannot use what it is given."""


class Actions(Law, frozen=True):
    """Law of an agent: its last action."""

    action: Action
    numbers: array[float]  # x, y of each robot; written between two decisions

    def step(self, view: View, memory: Memory) -> Control:
        k = 2 * view.robot.number
        x, y = self.numbers[k], self.numbers[k + 1]
        if self.action == "velocity":
            return Control(velocity=(x, y, nan))
        return Control(goal=(view.position[0] + x, view.position[1] + y, nan))


class ActionsAlone(Actions, frozen=True):
    """The same in place of a law that also moves robots without neighbours."""

    ALONE = True


class Voice(Trigger, frozen=True):
    """Transmits where the agent says so, once."""

    asked: array[float]  # 1 for each robot that says so; written between two decisions
    number: int

    def fires(self, view: TriggerView) -> bool:
        due = self.asked[self.number] > 0.0
        self.asked[self.number] = 0.0
        return due


class AgentActions:
    """Last actions of all agents."""

    def __init__(self, action: Action, law: Law, rows: Mapping[str, int], *, talk: bool) -> None:
        """Replace a `law` of robots with their numbers in `rows`.

        `talk`: agents decide when to transmit, within the intervals of the file's trigger.
        """
        self._rows = rows
        self._actions, self._asked = array("d", [0.0] * (2 * len(rows))), array("d", [0.0] * len(rows))
        self._law = (ActionsAlone if law.ALONE else Actions)(action=action, numbers=self._actions)
        self.numbers = TALKING if talk else SILENT

    def assignment(self, given: Assignment) -> Assignment:
        """Assignment of an agent, with its law and perhaps its trigger."""
        trigger = given.trigger
        if self.numbers == TALKING:
            limits = {name: getattr(trigger, name) for name in Trigger.__struct_fields__} | {"evaluate_every_s": 0.0}
            trigger = Voice(asked=self._asked, number=self._rows[given.name], **limits)
        return replace(given, law=self._law, trigger=trigger)

    def clear(self) -> None:
        """Forget all actions."""
        for each in (self._actions, self._asked):
            each[:] = array("d", [0.0] * len(each))  # the same array: records refer to it

    def take(self, actions: Mapping[str, Any], agents: Sequence[str]) -> None:
        """Take the actions of all `agents`; raises LearningError where one is missing, or not finite."""
        for name in actions:
            if name not in agents:
                raise LearningError(f"actions: no agent {name!r} flies now; {did_you_mean(str(name), agents)}")
        for name in agents:
            if name not in actions:
                raise LearningError(f"actions: there is none for {name}; give one for each of `env.agents`")
            if (shape := np.shape(actions[name])) != (len(self.numbers),):
                wanted = f"give {len(self.numbers)} numbers: {', '.join(self.numbers)}"
                raise LearningError(f"actions: that of {name} has the shape {shape}; {wanted}")
        self.take_rows(np.array([actions[name] for name in agents], dtype=float), agents)

    def take_rows(self, actions: Array, agents: Sequence[str]) -> None:
        """The same of actions (N, A) in the order of `agents`."""
        if not np.isfinite(actions).all():
            row = int(np.argmin(np.isfinite(actions).all(axis=1)))
            remedy = "look for NaN in its observation and in the weights of the policy"
            raise LearningError(f"actions: that of {agents[row]} is {actions[row].tolist()}, not finite; {remedy}")
        for name, (x, y, *said) in zip(agents, actions.tolist(), strict=True):
            row = self._rows[name]
            self._actions[2 * row], self._actions[2 * row + 1] = x, y
            if said and said[0] > 0.0:
                self._asked[row] = 1.0
