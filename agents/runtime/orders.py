"""Execution of orders to a robot, or the reason of a refusal. Pure; the loop receives and replies."""

from __future__ import annotations

from math import isfinite
from typing import Final

import msgspec

from agents.network.messages import Order
from agents.robot import Robot
from agents.vectors import Setpoint

SOON_S: Final = 3600.0  # a common start further ahead results from a wrong clock
LAND: Final = "ordered to land"
STOP: Final = "ordered to stop"
OWN: Final = ("clamp", "tracking_gain")
NEEDS_AT: Final = "a start needs `at`, a UTC time in seconds"
PAUSED: Final = "ordered to hold"

Answer = tuple[str, float | None]  # reason of a refusal (empty: none), and the value of a parameter


def carry_out(robot: Robot, order: Order, t: float, utc: float) -> Answer:
    """Carries out an order to one robot at `t` [s] of a clock that was 0 at `utc` [s]."""
    refusal = ""  # also of "inspect": the loop adds the inspection to the reply, it has the body
    match order.order:
        case "takeoff":
            refusal = _take_off(robot, order, t, utc)
        case "start":
            refusal = _start(robot, order, t, utc)
        case "go":
            refusal = _send_to_goal(robot, order.goal, t)
        case "hold":
            refusal = _hold(robot)
        case "resume":
            _resume(robot)
        case "leave":
            robot.lifecycle.land("ordered to leave")
        case "land":
            robot.lifecycle.land(LAND)
        case "stop":
            robot.lifecycle.stop(STOP)
        case "get" | "set":
            return _parameter(robot, order)
    return refusal, None


def _hold(robot: Robot) -> str:
    refusal = robot.hold()
    if not refusal:
        robot.lifecycle.reason = PAUSED
    return refusal


def _resume(robot: Robot) -> None:
    robot.resume()
    if robot.lifecycle.reason == PAUSED:
        robot.lifecycle.reason = ""


def _send_to_goal(robot: Robot, goal: tuple[float, float] | None, t: float) -> str:
    if goal is None or not all(map(isfinite, goal)):
        return "an order to go needs a `goal`, x and y in metres"
    return robot.go(goal, t)


def _take_off(robot: Robot, order: Order, t: float, utc: float) -> str:
    if order.at is None:
        return robot.lifecycle.takeoff()
    refusal = _misdated(robot, order.at, order.origin, t, utc) or robot.lifecycle.takeoff()
    if not refusal:
        robot.join(order.at - utc, t, order.origin)
    return refusal


def _start(robot: Robot, order: Order, t: float, utc: float) -> str:
    if order.at is None:
        return NEEDS_AT
    refusal = _misdated(robot, order.at, order.origin, t, utc) or robot.start(order.at - utc, t, order.origin)
    if not refusal:
        _resume(robot)
    return refusal


def _misdated(robot: Robot, at: float, origin: Setpoint | None, t: float, utc: float) -> str:
    """Reason why a common start `at` [s, UTC], or the origin of a plan, is impossible; empty if it is possible."""
    if not isfinite(at):
        return NEEDS_AT
    if not t - robot.assignment.duration < at - utc < t + SOON_S:
        return f"start at {at} is not within this experiment; are the clocks set?"
    if origin is not None and not all(map(isfinite, origin)):
        return "the `origin` of a start is x, y, z, yaw, all of them known"
    return ""


def _parameter(robot: Robot, order: Order) -> Answer:
    """Reads or changes the clamp, the tracking gain or a number of the trigger, of one robot."""
    of_trigger = {f"trigger.{field}": field for field in robot.transmitter.asking.trigger.__struct_fields__}
    name = order.name or ""
    if name not in of_trigger and name not in OWN:
        return f"no parameter '{name}'; known: {', '.join(sorted([*of_trigger, *OWN]))}", None
    if name in OWN and robot.assignment.guided:
        return f"'{name}' is the centre's: change the experiment file, and start the centre again", None
    if order.order == "set":
        refusal = _set(robot, name, of_trigger.get(name), order.value)
        if refusal:
            return refusal, None
    value = (
        getattr(robot.transmitter.asking.trigger, of_trigger[name])
        if name in of_trigger
        else getattr(robot.goals, name)
    )
    return ("", float(value)) if isinstance(value, int | float) else (f"'{name}' is not set", None)


def _set(robot: Robot, name: str, of_trigger: str | None, value: float | None) -> str:
    if value is None or not isfinite(value) or value < 0.0:
        return f"'{name}' needs a `value`, a number that is not negative"
    if of_trigger is None:
        setattr(robot.goals, name, value)
        return ""
    try:
        changed = {**msgspec.structs.asdict(robot.transmitter.asking.trigger), of_trigger: value}
        robot.transmitter.replace_trigger(msgspec.convert(changed, type(robot.transmitter.asking.trigger)))
    except msgspec.ValidationError as error:
        return f"'{name}' cannot be {value:g}: {error}"
    return ""
