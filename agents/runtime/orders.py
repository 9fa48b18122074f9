"""Execution of orders to a robot, or the reason of a refusal. Pure; the loop receives and replies."""

from __future__ import annotations

from math import isfinite
from typing import Final

import msgspec

from agents.agent import Agent
from agents.network.messages import Order

SOON_S: Final = 3600.0  # a common start further ahead results from a wrong clock
LAND: Final = "ordered to land"
STOP: Final = "ordered to stop"
OWN: Final = ("clamp", "tracking_gain")
PAUSED: Final = "ordered to hold"

Answer = tuple[str, float | None]  # reason of a refusal (empty: none), and the value of a parameter


def carry_out(agent: Agent, row: int, order: Order, t: float, utc: float) -> Answer:
    """Carries out an order to one row at `t` [s] of a clock that was 0 at `utc` [s]."""
    refusal = ""  # also of "inspect": the loop adds the inspection to the reply, it has the body
    match order.order:
        case "takeoff":
            refusal = agent.lifecycle.takeoff(row)
        case "start":
            refusal = _start(agent, row, order, t, utc)
        case "go":
            refusal = _send_to_goal(agent, row, order.goal, t)
        case "hold":
            refusal = _hold(agent, row)
        case "resume":
            _resume(agent, row)
        case "leave":
            agent.lifecycle.land(row, "ordered to leave")
        case "land":
            agent.lifecycle.land(row, LAND)
        case "stop":
            agent.lifecycle.stop(row, STOP)
        case "get" | "set":
            return _parameter(agent, order)
    return refusal, None


def _hold(agent: Agent, row: int) -> str:
    refusal = agent.hold(row)
    if not refusal:
        agent.lifecycle.reason[row] = PAUSED
    return refusal


def _resume(agent: Agent, row: int) -> None:
    agent.resume(row)
    if agent.lifecycle.reason[row] == PAUSED:
        agent.lifecycle.reason[row] = ""


def _send_to_goal(agent: Agent, row: int, goal: tuple[float, float] | None, t: float) -> str:
    if goal is None or not all(map(isfinite, goal)):
        return "an order to go needs a `goal`, x and y in metres"
    return agent.go(row, goal, t)


def _start(agent: Agent, row: int, order: Order, t: float, utc: float) -> str:
    at, origin = order.at, order.origin
    if at is None or not isfinite(at):
        return "a start needs `at`, a UTC time in seconds"
    if not t - agent.assignment.duration < at - utc < t + SOON_S:
        return f"start at {at} is not within this experiment; are the clocks set?"
    if origin is not None and not all(map(isfinite, origin)):
        return "the `origin` of a start is x, y, z, yaw, all of them known"
    if refusal := agent.start(row, at - utc, t, origin):
        return refusal
    _resume(agent, row)
    return ""


def _parameter(agent: Agent, order: Order) -> Answer:
    """Reads or changes the clamp, the tracking gain or a number of the trigger, for all robots of this process."""
    of_trigger = {f"trigger.{field}": field for field in agent.transmitter.trigger.__struct_fields__}
    name = order.name or ""
    if name not in of_trigger and name not in OWN:
        return f"no parameter '{name}'; known: {', '.join(sorted([*of_trigger, *OWN]))}", None
    if name in OWN and agent.all_guided:
        return f"'{name}' is the centre's: change the experiment file, and start the centre again", None
    if order.order == "set":
        refusal = _set(agent, name, of_trigger.get(name), order.value)
        if refusal:
            return refusal, None
    value = (
        getattr(agent.transmitter.trigger, of_trigger[name])
        if name in of_trigger
        else getattr(agent.goal_computer, name)
    )
    return ("", float(value)) if isinstance(value, int | float) else (f"'{name}' is not set", None)


def _set(agent: Agent, name: str, of_trigger: str | None, value: float | None) -> str:
    if value is None or not isfinite(value) or value < 0.0:
        return f"'{name}' needs a `value`, a number that is not negative"
    if of_trigger is None:
        setattr(agent.goal_computer, name, value)
        return ""
    try:
        changed = {**msgspec.structs.asdict(agent.transmitter.trigger), of_trigger: value}
        agent.transmitter.trigger = msgspec.convert(changed, type(agent.transmitter.trigger))
    except msgspec.ValidationError as error:
        return f"'{name}' cannot be {value:g}: {error}"
    return ""
