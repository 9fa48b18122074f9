"""Actions of agents, in place of the law, and perhaps of the trigger, of their robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Literal

import msgspec
import numpy as np

from agents.decision.assignment import Assignment
from agents.errors import ExplainedError, did_you_mean
from agents.plugins.extras.policy import steered
from agents.plugins.law import Control, Law, Memory, View
from agents.plugins.triggers import Trigger, TriggerView

Action = Literal["velocity", "goal"]

SILENT: Final = ("x", "y")  # numbers of an action
TALKING: Final = (*SILENT, "whether to transmit")


class LearningError(ExplainedError, ValueError):
    """An environment of learning cannot be made, or cannot use what it is given."""


class Actions(Law, frozen=True):
    """Law of an agent: its last action."""

    action: Action = "velocity"
    # by the names of robots; written between two decisions
    actions: dict[str, tuple[float, float]] = msgspec.field(default_factory=dict)

    def step(self, view: View, memory: Memory) -> Control:
        x, y = self.actions.get(view.robot.name, (0.0, 0.0))
        return steered(view, x, y, self.action)


class ActionsAlone(Actions, frozen=True):
    """The same in place of a law that also moves robots without neighbours."""

    ALONE = True


class Voice(Trigger, frozen=True):
    """Transmits where the agent says so, once."""

    name: str = ""
    asked: set[str] = msgspec.field(default_factory=set)  # names of robots; written between two decisions

    def fires(self, view: TriggerView) -> bool:
        due = self.name in self.asked
        self.asked.discard(self.name)
        return due


class AgentActions:
    """Last actions of all agents."""

    def __init__(self, action: Action, law: Law, *, talk: bool) -> None:
        """Replace a `law`; `talk`: agents decide when to transmit, within the intervals of the file's trigger."""
        self._actions, self._asked = dict[str, tuple[float, float]](), set[str]()
        self._law = (ActionsAlone if law.ALONE else Actions)(action, self._actions)
        self.numbers = TALKING if talk else SILENT

    def assignment(self, given: Assignment) -> Assignment:
        """Assignment of an agent, with its law and perhaps its trigger."""
        trigger = given.trigger
        if self.numbers == TALKING:
            limits = {name: getattr(trigger, name) for name in Trigger.__struct_fields__} | {"evaluate_every_s": 0.0}
            trigger = Voice(name=given.name, asked=self._asked, **limits)
        return replace(given, law=self._law, trigger=trigger)

    def clear(self) -> None:
        """Forget all actions."""
        self._actions.clear()
        self._asked.clear()

    def take(self, actions: Mapping[str, Any], agents: Sequence[str]) -> None:
        """Take the actions of all `agents`; raises LearningError where one is missing, or not finite."""
        for name in actions:
            if name not in agents:
                raise LearningError(f"actions: no agent {name!r} flies now; {did_you_mean(str(name), agents)}")
        for name in agents:
            if name not in actions:
                raise LearningError(f"actions: there is none for {name}; give one for each of `env.agents`")
            numbers = np.asarray(actions[name], dtype=float)
            if numbers.shape != (len(self.numbers),):
                wanted = f"give {len(self.numbers)} numbers: {', '.join(self.numbers)}"
                raise LearningError(f"actions: that of {name} has the shape {numbers.shape}; {wanted}")
            x, y, *said = numbers.tolist()
            if not np.isfinite(numbers).all():
                remedy = "look for NaN in its observation and in the weights of the policy"
                raise LearningError(f"actions: that of {name} is {numbers.tolist()}, not finite; {remedy}")
            self._actions[name] = x, y
            if said and said[0] > 0.0:
                self._asked.add(name)
