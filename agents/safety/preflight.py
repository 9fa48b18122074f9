"""Preflight checks: conditions for take-off, with the reason where one fails. `Preflight.passes` alone is quiet.

The plug-ins of a robot are rehearsed: called before take-off, and their results are checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from math import degrees, hypot, inf, isnan, radians, remainder, tau
from numbers import Real
from typing import ClassVar, Final

from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.goals import GoalComputer
from agents.decision.neighbours import Neighbour, Neighbours
from agents.decision.perception import Perception
from agents.decision.situation import ProcessHealth, Situation
from agents.decision.transmission import Transmitter
from agents.plugins.calls import wrong
from agents.plugins.triggers import LastEvent, Trigger, TriggerView
from agents.safety.detection import clock_off, clock_text, nearest_robot, tilt_angle, tilted
from agents.vectors import NO_SETPOINT, ZERO, Vector, is_finite, norm, planar

LOST_S: Final = 0.5  # time of a failing check after which a ready robot is not ready any more
FLOOR_M: Final = 0.5  # largest height of a standing drone: positioning systems differ about the floor
REST_M_S: Final = 0.3  # largest speed at rest
LEVEL: Final = 0.35  # [rad] largest tilt at rest
WALL_M: Final = 0.05  # a place measured this far outside the arena may be inside
TURNED: Final = radians(20.0)  # largest difference of a yaw from that of its start
SURE: Final = 0.99  # share of a limit below which rounding decides nothing
ABOVE_M: Final = 0.1  # [m] a robot higher than this is above one that stands,
BESIDE_M: Final = 0.1  # [m] enough distance of the two, seen from above
# remedy for a measured yaw that is not that of the robot
FRAME: Final = "turn the frame of its object in the motion capture, until the x axis points along its nose"
NUMBERS: Final = {1: "a number", 3: "three numbers", 4: "four numbers"}  # kinds of a result


class Preflight:
    """Checks of a robot, and the duration of their failure."""

    RARE: ClassVar = ("_other_starts",)

    def __init__(self, assignment: Assignment) -> None:
        self._assignment, self._limits = assignment, assignment.limits
        self._since, self._covered = inf, False  # covered: a drone with a robot above it
        x, y = assignment.start or (0.0, 0.0)
        starts = [(hypot(each[1] - x, each[2] - y), each) for each in assignment.starts]
        starts = [(away, each) for away, each in starts if away > assignment.kind.radius + each[3]]
        self._other_starts = [each for _, each in starts]
        self._nearest_start = min((away for away, _ in starts), default=inf)
        self._flies, self._placed = assignment.kind.flies, assignment.start is not None
        self._start, self._yaw = (x, y), assignment.start_yaw
        self._near = SURE * min(assignment.start_within, 0.5 * self._nearest_start)

    def check(self, now: Situation, missing: Sequence[str], neighbours: Neighbours, health: ProcessHealth) -> str:
        """First reason why the robot must not take off, empty if there is none.

        `missing`: neighbours with a required pose that is not there.
        """
        above = self._robot_above(now, neighbours)
        self._covered = above is not None
        reasons = chain(
            self._situation(now, missing, health), self._at_start(now), self._at_rest(now, now.state),
            self._surroundings(now, neighbours, above),
        )  # fmt: skip
        return next(reasons, "")

    def passes(self, now: Situation, neighbours: Neighbours, health: ProcessHealth) -> bool:
        """Whether `check` surely finds nothing, as it did before; where that is not sure, False. Quiet."""
        state, limits = now.state, self._limits
        if self._since < inf or state.refusal or limits.separation is not None or health.offline_since < inf:
            return False
        if now.invalid or now.excess > WALL_M or state.battery < limits.battery_min:
            return False
        if self._placed:
            x, y = now.position[0] - self._start[0], now.position[1] - self._start[1]
            if x * x + y * y > self._near * self._near or abs(now.yaw - self._yaw) > SURE * TURNED:
                return False
        if self._flies:
            if now.position[2] > FLOOR_M or norm(now.velocity) > REST_M_S or tilted(state.attitude, LEVEL):
                return False
            for sender in neighbours.all:
                if sender.position[2] - now.position[2] > ABOVE_M:
                    return False
        return True

    def lost(self, t: float, failing: str) -> bool:
        """Whether a check with the reason `failing` has failed for too long for the robot to stay ready."""
        if not failing:
            self._since = inf
            return False
        self._since = -inf if self._covered else min(self._since, t)  # a covered one at once
        return t - self._since >= LOST_S

    def _situation(self, now: Situation, missing: Sequence[str], health: ProcessHealth) -> Iterator[str]:
        """Own position, neighbours, router, arena."""
        state = now.state
        if now.invalid:
            yield self._nowhere(now)
        if state.refusal:
            yield state.refusal
        if missing:
            yield "never received " + ", ".join(missing)
        if health.offline_since < inf:
            yield "no connection to a router"
        if now.excess > WALL_M:
            yield f"it is {now.excess:.2f} m outside the arena"

    def _nowhere(self, now: Situation) -> str:
        state, limits = now.state, self._limits
        if isnan(now.yaw) and is_finite(now.position) and now.t - state.time <= limits.position_timeout_s:
            return "it does not know which way it looks"
        text = "no position of its own"
        return (
            f"{text}: {clock_text(self._assignment.name, state.ahead)}"
            if clock_off(state.ahead, limits.behind_s)
            else text
        )

    def _at_start(self, now: Situation) -> Iterator[str]:
        """Body where the experiment begins: swapped addresses or markers, and a wrong origin, show here."""
        start, limit = self._assignment.start, self._assignment.start_within
        if start is None:
            return
        x, y, _ = now.position  # NaN without a position, which has failed already
        away = hypot(x - start[0], y - start[1])
        if 2.0 * away >= self._nearest_start:  # else nearer to its own than to any: none of a thousand need be asked
            places = [(hypot(x - other_x, y - other_y), name) for name, other_x, other_y, _ in self._other_starts]
            if places and min(places)[0] < away:
                yield f"it stands where {min(places)[1]} begins: addresses or markers are swapped"
        if away > limit:
            yield f"it is {away:.2f} m from its start ({start[0]:g}, {start[1]:g}), more than {limit:g} m"
        turned = remainder(now.yaw - self._assignment.start_yaw, tau)
        if abs(turned) > TURNED:
            yield f"it is turned by {degrees(turned):.0f}° from the yaw of its `start`: turn it, or {FRAME}"

    def _at_rest(self, now: Situation, state: BodyState) -> Iterator[str]:
        """Drones on the floor, at rest and level; charge of all."""
        if self._assignment.kind.flies:
            if now.position[2] > FLOOR_M:
                yield f"it does not stand on the floor, but at z = {now.position[2]:.2f} m"
            if norm(now.velocity) > REST_M_S:
                yield f"it is not at rest: {norm(now.velocity):.2f} m/s"
            if tilted(state.attitude, LEVEL):
                yield f"it is not level: it leans {degrees(tilt_angle(state.attitude)):.0f}°"
        if state.battery < self._limits.battery_min:
            yield f"its battery is at {state.battery:.0%}, less than {self._limits.battery_min:.0%}"

    def _surroundings(self, now: Situation, neighbours: Neighbours, above: Neighbour | None) -> Iterator[str]:
        """Robots above it, and robots too near."""
        if above is not None:
            yield f"{above.name} is {above.position[2] - now.position[2]:.2f} m above it"
        limit = self._limits.separation
        if limit is not None:
            distance, other = nearest_robot(now.position, neighbours, self._assignment.predictor, now.t)
            if distance < limit:
                yield f"it is {distance:.2f} m from {other}, nearer than {limit:g} m"

    def _robot_above(self, now: Situation, neighbours: Neighbours) -> Neighbour | None:
        """Robot above a drone, where it was received last: a take-off passes all heights."""
        kind = self._assignment.kind
        if kind.flies:
            for sender in neighbours.all:
                beside = BESIDE_M + kind.radius + sender.radius
                if sender.position[2] - now.position[2] > ABOVE_M and planar(sender.position, now.position) < beside:
                    return sender
        return None


def rehearse(
    assignment: Assignment, goals: GoalComputer, transmitter: Transmitter, perception: Perception | None,
    *, position: Vector, t: float,
) -> None:  # fmt: skip
    """Call each plug-in of a robot at `position` [m]; raises PluginError where a result is not what it must be."""
    predictor, law = transmitter.predictor, goals.law
    sent = LastEvent()
    sent.position = position
    _expect("predictor", predictor, "position", predictor.position(sent, 0.0), 3)
    _expect("predictor", predictor, "velocity", predictor.velocity(sent, 0.0), 3)
    if goals.stepping is not None:
        goals.is_sound(t, position)
    for sender in goals.neighbours.all:
        if sender.active:
            apart = sender.apart(position, predictor, t)
            if goals.stepping is None:
                _expect("law", law, "pull", law.pull(apart, sender.link), 3)
            _expect("law", law, "error", law.error(apart, sender.link), 1)
    for trigger in (transmitter.asking.trigger, assignment.update):
        if trigger is not None:
            _expect_bool(trigger, trigger.fires(TriggerView(trigger.MEMORY)))
    for leg in assignment.legs:
        _expect("planner", leg.planner, "target", leg.planner.target(0.0, position, 0.0), 4)
    if perception is not None:
        avoidance, own, near = perception.avoidance, perception.own, perception.near
        _expect("avoidance", avoidance, "deviate", avoidance.deviate(ZERO, own, near, 1.0), 3)
        _expect("avoidance", avoidance, "restrain", avoidance.restrain(NO_SETPOINT, own, near), 4)


def _expect(what: str, plugin: object, method: str, result: object, count: int) -> None:
    # `tuple` and `float` first: `abc` takes ten times as long
    numbers = [result] if count == 1 else list(result) if isinstance(result, (tuple, Iterable)) else []
    if len(numbers) != count or not all(isinstance(each, (float, Real)) for each in numbers):
        raise wrong(what, plugin, method, result, NUMBERS[count])


def _expect_bool(trigger: Trigger, result: object) -> None:
    plain = result.item() if hasattr(result, "item") else result  # comparisons of numpy's numbers give its own kind
    if not isinstance(plain, bool):
        raise wrong("trigger", trigger, "fires", result, "True or False")
