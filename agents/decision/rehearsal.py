"""Rehearsal: the plug-ins of a robot are called before take-off, and their results are checked. Not quiet."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from numbers import Real
from typing import Final

from agents.decision.assignment import Assignment
from agents.decision.goals import GoalComputer
from agents.decision.perception import Perception
from agents.decision.transmission import Transmitter
from agents.plugins.calls import wrong
from agents.plugins.triggers import LastEvent, Trigger, View
from agents.vectors import NO_SETPOINT, ZERO, Vector

NUMBERS: Final = {1: "a number", 3: "three numbers", 4: "four numbers"}


def rehearse(
    assignment: Assignment, goals: GoalComputer, transmitter: Transmitter, perception: Perception | None,
    *, position: Vector, t: float,
) -> None:  # fmt: skip
    """Call each plug-in of a robot at `position` [m]; raises PluginError where a result is not what it must be."""
    predictor, law, sent = transmitter.predictor, goals.law, LastEvent()
    sent.position = position
    _expect("predictor", predictor, "position", predictor.position(sent, 0.0), 3)
    _expect("predictor", predictor, "velocity", predictor.velocity(sent, 0.0), 3)
    for sender in goals.neighbours.all:
        if sender.active:
            apart = sender.apart(position, predictor, t)
            _expect("law", law, "pull", law.pull(apart, sender.link), 3)
            _expect("law", law, "error", law.error(apart, sender.link), 1)
    trigger, update = transmitter.asking.trigger, assignment.update
    _expect_bool(trigger, trigger.fires(deepcopy(transmitter.asking.view)))
    if update is not None:
        _expect_bool(update, update.fires(View(update.MEMORY)))
    for leg in assignment.legs:
        _expect("planner", leg.planner, "target", leg.planner.target(0.0, position, 0.0), 4)
    if perception is not None:
        avoidance, own, near = perception.avoidance, perception.own, perception.near
        _expect("avoidance", avoidance, "deviate", avoidance.deviate(ZERO, own, near, 1.0), 3)
        _expect("avoidance", avoidance, "restrain", avoidance.restrain(NO_SETPOINT, own, near), 4)


def _expect(what: str, plugin: object, method: str, result: object, count: int) -> None:
    numbers = [result] if count == 1 else list(result) if isinstance(result, Iterable) else []
    if len(numbers) != count or not all(isinstance(each, Real) for each in numbers):
        raise wrong(what, plugin, method, result, NUMBERS[count])


def _expect_bool(trigger: Trigger, result: object) -> None:
    plain = result.item() if hasattr(result, "item") else result  # comparisons of numpy's numbers give its own kind
    if not isinstance(plain, bool):
        raise wrong("trigger", trigger, "fires", result, "True or False")
