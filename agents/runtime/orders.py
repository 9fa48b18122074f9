"""Orders to the robots of a process: reception, execution or the reason of a refusal, reply."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite, isnan
from typing import Final

import msgspec
import zenoh

from agents.body.interface import Body, BodyState
from agents.decision.lifecycle import Phase
from agents.network import messages, pubsub
from agents.network.keys import Keys
from agents.network.messages import Order
from agents.network.zenoh_config import ASK_S
from agents.robot import Robot
from agents.runtime.telemetry import Counts
from agents.safety.hazards import BY_OPERATOR, Cause, HazardChange, Outcome
from agents.vectors import Setpoint

SOON_S: Final = 30.0  # a common start further ahead results from a wrong clock: people are near by then
LAND: Final = "ordered to land"
STOP: Final = "ordered to stop"
OWN: Final = ("clamp", "tracking_gain")
NEEDS_AT: Final = "a start needs `at`, a UTC time in seconds"

Answer = tuple[str, float | None]  # reason of a refusal (empty: none), and the value of a parameter


class OrderDesk:
    """Answers the orders to the robots of a process, between two ticks of their loop.

    Declare it before their liveliness tokens: a client that sees a token may then give orders.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        encoding: messages.Encoding,
        *,
        robots: Sequence[Robot],
        body: Body,  # inspected on request
        counts: Counts,  # refused orders are counted there
        on_start: Callable[[float, float], object],  # time of a common start of a waiting robot, present time [s]
    ) -> None:
        self.leaving: set[int] = set()  # rows that were ordered to leave the run
        self._encoding, self._robots, self._body = encoding, robots, body
        self._counts, self._on_start = counts, on_start
        self._keys = [keys.order(robot.assignment.name) for robot in robots]
        self._inboxes = [pubsub.Orders(session, key, Order) for key in self._keys]

    @property
    def malformed(self) -> int:
        """Refused payloads."""
        return sum(inbox.malformed for inbox in self._inboxes)

    def answer(self, t: float, utc: float, states: Sequence[BodyState]) -> None:
        """Answers all until `t` [s] of a clock that was 0 at `utc` [s]; `states`: last reading of the body, if any."""
        for row, inbox in enumerate(self._inboxes):
            for query, order in inbox.read() if inbox.queue else ():
                with query:
                    reply = self._obey(row, order, t, utc, states)
                    payload = messages.encode(reply, self._encoding)
                    query.reply(self._keys[row], payload, encoding=messages.MIME[self._encoding])

    def _obey(self, row: int, order: Order, t: float, utc: float, states: Sequence[BodyState]) -> messages.Reply:
        robot = self._robots[row]
        airborne = robot.lifecycle.phase == Phase.AIRBORNE
        slept = robot.health.suspended_s
        # the conductor has given up waiting
        if order.order == "takeoff" and slept > ASK_S and robot.health.just_resumed(t):
            refusal, value = f"the process stood still for {slept:.1f} s; ask again", None
        else:
            refusal, value = carry_out(robot, order, t, utc)
        self._counts.refused += bool(refusal)
        if order.order == "leave":
            self.leaving.add(row)
        # a running robot keeps its ticks
        if order.order == "start" and order.at is not None and not refusal and airborne:
            self._on_start(order.at - utc, t)
        phase = Phase(robot.lifecycle.phase).word
        found = self._inspect(row, t, states) if order.order == "inspect" else None
        return messages.Reply(robot.assignment.name, not refusal, phase, refusal, value, found)

    def _inspect(self, row: int, t: float, states: Sequence[BodyState]) -> messages.Inspection:
        known = self._body.inspect(row)
        if not states:
            return known
        state = states[row]
        return msgspec.structs.replace(
            known,
            flying=state.flying,
            age_s=messages.number(t - state.time),
            ahead_s=None if isnan(state.ahead) else messages.number(state.ahead),
        )


def carry_out(robot: Robot, order: Order, t: float, utc: float) -> Answer:
    """Carries out an order to one robot at `t` [s] of a clock that was 0 at `utc` [s]."""
    refusal = ""  # also of "inspect": the desk adds the inspection to the reply
    match order.order:
        case "takeoff" | "start":
            refusal = _begin(robot, order, t, utc)
        case "go":
            if not (refusal := robot.go(order.goal, t)) and order.goal is not None:
                _tell(robot, t, "sent to x = {:g} m, y = {:g} m".format(*order.goal))
        case "hold":
            refusal = robot.hold()
        case "resume":
            robot.resume()
        case "leave":
            robot.lifecycle.land("ordered to leave")
        case "land":
            robot.lifecycle.land(LAND)
        case "stop":
            robot.lifecycle.stop(STOP)
        case "get" | "set":
            refusal, value = _parameter(robot, order)
            if order.order == "set" and not refusal:
                _tell(robot, t, f"given {order.name} = {order.value:g}")
            return refusal, value
    return refusal, None


def _tell(robot: Robot, t: float, what: str) -> None:
    """Notes an order that makes the run another one than that of its file."""
    text = f"warn: was {what} {BY_OPERATOR}"
    robot.hazards.incidents.append(HazardChange(t, Cause.ORDERED, Outcome.WARN, text))


def _begin(robot: Robot, order: Order, t: float, utc: float) -> str:
    """Common start, or take-off: into a run under way if the order says when that began."""
    if order.at is None:
        return robot.lifecycle.takeoff() if order.order == "takeoff" else NEEDS_AT
    if refusal := _misdated(robot, order.at, order.origin, t, utc):
        return refusal
    if order.order == "start":
        return robot.start(order.at - utc, t, order.origin)
    refusal = robot.lifecycle.takeoff()
    if not refusal:
        robot.join(order.at - utc, t, order.origin)
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
    field = of_trigger.get(name)
    if order.order == "set" and (refusal := _set(robot, name, field, order.value)):
        return refusal, None
    value = getattr(robot.goals, name) if field is None else getattr(robot.transmitter.asking.trigger, field)
    return ("", float(value)) if isinstance(value, int | float) else (f"'{name}' is not set", None)


def _set(robot: Robot, name: str, of_trigger: str | None, value: float | None) -> str:
    if value is None or not isfinite(value) or value < 0.0:
        return f"'{name}' needs a `value`, a number that is not negative"
    if of_trigger is None:
        setattr(robot.goals, name, value)
        return ""
    trigger = robot.transmitter.asking.trigger
    try:
        changed = {**msgspec.structs.asdict(trigger), of_trigger: value}
        robot.transmitter.replace_trigger(msgspec.convert(changed, type(trigger)))
    except msgspec.ValidationError as error:
        return f"'{name}' cannot be {value:g}: {error}"
    return ""
