"""Position controllers: they arrive, within the limits, as the wheels allow."""

from math import cos, hypot, inf, isfinite, isnan, nan, pi, radians, remainder, sin, tau

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.body.kinds import KINDS, Agility
from agents.decision.position_control import REACHED, TURNED, PositionController, TwoWheels
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from tests.cases import examples
from twins.models.differential import Differential

GROUND = pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3], ids=lambda kind: kind.name)
PLACE, YAW = st.tuples(*[st.floats(-0.6, 0.6)] * 2), st.floats(-pi, pi)


def drive_to(kind, start, yaw, goal, goal_yaw, *, late=0):
    """Setpoints of 16 s, and the last yaw, of a twin that arrives at its goal; it is measured some ticks late."""
    twin, control = Differential(kind, (*start, 0.0), yaw), PositionController(kind)
    seen, setpoints = [(twin.position, twin.yaw)] * late, []
    for _ in range(800):
        seen.append((twin.position, twin.yaw))
        setpoints.append(control.setpoint((*goal, 0.0), goal_yaw, *seen[-1 - late]))
        twin.command(setpoints[-1])
        twin.move(0.02)
    assert hypot(twin.position[0] - goal[0], twin.position[1] - goal[1]) <= REACHED
    return setpoints, twin.yaw


@GROUND
@examples(25)
@given(PLACE, YAW, PLACE, st.one_of(YAW, st.just(nan)))
def test_ground_robots_arrive_and_stand(kind, start, yaw, goal, goal_yaw):
    setpoints, end = drive_to(kind, start, yaw, goal, goal_yaw)
    assert not any(any(setpoint) for setpoint in setpoints[-25:])
    assert not isfinite(goal_yaw) or abs(remainder(goal_yaw - end, tau)) <= TURNED + 1e-3
    assert all(abs(v) <= kind.speed and abs(omega) <= kind.turn_rate for v, omega, *_ in setpoints)
    assert not any(third or fourth for *_, third, fourth in setpoints)


@GROUND
@pytest.mark.parametrize("late", [0, 2], ids=["at once", "two ticks late"])
def test_end_that_drives_ahead_is_chosen_once(kind, late):
    """Abeam to the last bit too, without any noise."""
    for degrees in (*range(-180, 180, 30), 88.0, 89.0, 89.9, 90.1, 91.0, 92.0):
        for yaw, distance in ((0.0, 0.02), (0.0, 0.3), (0.3, 1.0), (-2.0, 0.3)):
            x, y = distance * cos(yaw + radians(degrees)), distance * sin(yaw + radians(degrees))
            goal = (0.0 if abs(degrees) == 90 and yaw == 0.0 else x, y)
            setpoints, _ = drive_to(kind, (0.0, 0.0), yaw, goal, nan, late=late)
            assert len({v > 0.0 for v, *_ in setpoints if v}) <= 1


def test_setpoints_toward_a_goal():
    unit = Agility(response=1.0, turn_response=1.5, speed=1.0, turn_rate=9.0)
    for x, y, twist in (
        (0.2, 0.0, (0.2, 0.0)),
        (-0.2, 0.0, (-0.2, 0.0)),  # backward to what lies behind
        (0.3 * cos(0.7), 0.3 * sin(0.7), (0.3 * (pi - 0.7) / pi, 1.5 * sin(0.7))),  # the law of Farias
    ):
        assert TwoWheels().twist(x, y, 0.0, nan, unit) == pytest.approx(twist)
    hover, crazyflie, tello = (0.0, 0.0, 0.8), PositionController(CRAZYFLIE), PositionController(TELLO)
    assert crazyflie.setpoint((1.0, 2.0, 0.8), 0.4, hover, 0.0) == (1.0, 2.0, 0.8, 0.4)
    assert crazyflie.setpoint((1.0, 2.0, 0.8), nan, hover, 0.0) == (1.0, 2.0, 0.8, 0.0)
    velocity = tello.setpoint((0.3, -0.1, 0.9), pi - 0.1, hover, 0.1 - pi)
    assert velocity == pytest.approx((0.3, -0.1, 0.1, -0.2))  # the short way round
    assert tello.setpoint((9.0, -9.0, 0.8), nan, hover, 1.0) == (1.0, -1.0, 0.0, 0.0)


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
@pytest.mark.parametrize("missing", ["goal", "position", "yaw"])
@pytest.mark.parametrize("number", [nan, inf])
def test_unknown_input_gives_no_number(kind, missing, number):
    known = {"goal": (1.0, 1.0, 1.0), "position": (0.0, 0.0, 0.0), "yaw": 0.0}
    known[missing] = number if missing == "yaw" else (number,) * 3
    setpoint = PositionController(kind).setpoint(known["goal"], 0.3, known["position"], known["yaw"])
    if kind.takes == "position" and missing != "goal":
        assert setpoint == (1.0, 1.0, 1.0, 0.3)
    elif kind.takes == "velocity" and missing == "yaw":
        v = min(kind.response, kind.speed)
        assert setpoint[:3] == (v, v, v if kind.flies else 0.0)
    elif isnan(number) or kind.takes == "twist":
        assert any(map(isnan, setpoint))
    else:
        assert kind.takes == "velocity" or inf in setpoint
    here = (0.1, 0.2, 0.5)
    if kind.takes != "position":  # an unknown yaw turns no robot at its goal
        for yaws in ((number, 0.3), (0.3, number)):
            assert PositionController(kind).setpoint(here, yaws[0], here, yaws[1]) == (0.0, 0.0, 0.0, 0.0)
