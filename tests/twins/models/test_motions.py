"""Quadrotor against the law that it claims to follow, integrated by other means; wheels: arcs are arcs."""

import math

import numpy as np
import pytest

from agents.vectors import NO_SETPOINT, ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from tests.cases import mostly_slow
from twins.models.differential import Differential
from twins.models.onboard_flight import CLIMB, TOUCHDOWN
from twins.models.quadrotor import Quadrotor

DT = 0.01


def flying(kind=CRAZYFLIE, height=0.8, yaw=0.0):
    made = Quadrotor(kind, ZERO, 0.0)
    made.place((0.0, 0.0, height), yaw, flying=True)
    return made


def path_of(model, setpoint, seconds, dt=DT):
    """(T, 4) positions and yaws under one setpoint."""
    path = []
    for _ in range(round(seconds / dt)):
        model.command(setpoint)
        model.move(dt)
        path.append((*model.position, model.yaw))
    return np.array(path)


def step(axis, size, seconds):
    """The way along an axis after a step, in ticks of 1 ms."""
    setpoint = np.array([0.0, 0.0, 0.8, 0.0]) + size * np.eye(4)[axis]
    return path_of(flying(), tuple(setpoint), seconds, 0.001)[:, axis] - (0.8 if axis == 2 else 0.0)


def exact(response, axis, target, times):
    """Fourth-order Runge-Kutta solution of a' = k_t (k_v (clip(k_p (target − p)) − v) − a) from rest at 0."""
    gain, rate, limit, tilt = (getattr(response, name)[axis] for name in ("position", "velocity", "speed", "tilt"))

    def slope(y):
        wanted = rate * (np.clip(gain * (target - y[0]), -limit, limit) - y[1])
        return np.array([y[1], y[2], tilt * (wanted - y[2])] if math.isfinite(tilt) else [y[1], wanted, 0.0])

    y, found, h = np.zeros(3), [], times[1] - times[0]
    for _ in times[1:]:
        found.append(y[0])
        k1 = slope(y)
        k2 = slope(y + 0.5 * h * k1)
        k3 = slope(y + 0.5 * h * k2)
        y = y + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + slope(y + h * k3))
    return np.array([*found, y[0]])


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("target", mostly_slow([0.05, 1.0, 0.3, 3.0], 3))
def test_steps_solve_stated_law(axis, target):
    path = step(axis, target, 5.0)
    truth = exact(CRAZYFLIE.motion, axis, target, 0.001 * np.arange(5001))
    np.testing.assert_allclose(path, truth[1:], atol=3e-3 * target)
    assert path[-1] == pytest.approx(target, rel=0.01)


@pytest.mark.parametrize(
    ("axis", "size", "rise_ms"), [(0, 0.3, 487), (0, 1.0, 730), (2, 0.3, 566), (2, 1.0, 733), (3, 1.0, 284)]
)
def test_steps_rise_like_firmware(axis, size, rise_ms):
    """Rise times are those of the maker's firmware, compiled and run on a rigid body of 29 g."""
    path = step(axis, size, 3.0) / size
    assert (path > 0.9).argmax() - (path > 0.1).argmax() == pytest.approx(rise_ms, rel=0.10)


def test_yaw_turns_short_way_up_to_rate():
    begin = math.radians(178.0)
    yaw = path_of(flying(yaw=begin), (0.0, 0.0, 0.8, math.radians(-178.0)), 3.0)[:, 3]
    assert yaw[-1] - begin == pytest.approx(math.radians(4.0), abs=1e-3)
    assert np.diff(yaw).min() >= 0.0
    yaw = path_of(flying(), (0.0, 0.0, 0.8, 3.0), 1.0)[:, 3]
    assert np.diff(yaw, prepend=0.0).max() / DT == pytest.approx(CRAZYFLIE.turn_rate)
    yaw = path_of(flying(), (0.0, 0.0, 0.8, 1.0), 0.5)[-1, 3]
    assert yaw == pytest.approx(1.0 - math.exp(-CRAZYFLIE.turn_response * 0.5), abs=0.01)


def test_velocity_robot_follows_with_lag():
    tello, gain = flying(TELLO), TELLO.motion.velocity[0]
    x = path_of(tello, (0.5, 0.0, 0.0, 0.3), 3.0)[-1, 0]
    assert x == pytest.approx(0.5 * (3.0 - (1.0 - math.exp(-gain * 3.0)) / gain), abs=0.01)
    assert tello.yaw == pytest.approx(0.9)
    path_of(tello, (9.0, 0.0, 0.0, 0.0), 5.0)
    assert tello.velocity[0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_take_off_climbs_over_its_place(kind):
    quadrotor = Quadrotor(kind, (0.3, -0.2, 0.0), 0.5)
    path_of(quadrotor, (1.0, 1.0, 1.0, 1.0), 1.0)  # on the ground of no effect, now or later
    quadrotor.land()
    assert path_of(quadrotor, (1.0, 1.0, 1.0, 1.0), 1.0)[-1].tolist() == [0.3, -0.2, 0.0, 0.5]
    quadrotor.takeoff(0.8)
    path = path_of(quadrotor, NO_SETPOINT, 9.0)
    assert path[-1] == pytest.approx([0.3, -0.2, 0.8, 0.5], abs=1e-3)
    halfway = 0.8 / CLIMB  # by then the polynomial has ended; the body lags behind it
    assert 0.4 < path[round(halfway / DT) - 1, 2] < 0.8
    assert path[:, 2].max() < 0.8 * 1.08  # the firmware's overshoot is 7 to 11 %

    if kind is CRAZYFLIE:  # a setpoint ends a climb, and is kept
        quadrotor.takeoff(2.0)
        quadrotor.command((0.5, 0.0, 0.6, 0.0))
        assert path_of(quadrotor, NO_SETPOINT, 8.0)[-1] == pytest.approx([0.5, 0.0, 0.6, 0.0], abs=1e-3)


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_landing_ends_on_floor_with_motors_off(kind):
    quadrotor = flying(kind)
    quadrotor.land()
    begun = path_of(quadrotor, (5.0, 5.0, 5.0, 1.0), 1.0)  # setpoints do not interrupt a landing
    quadrotor.land()  # nor does a second order prolong it
    height = np.concatenate([begun, path_of(quadrotor, (5.0, 5.0, 5.0, 1.0), 7.0)])[:, 2]
    assert (quadrotor.flying, quadrotor.position, quadrotor.velocity) == (False, ZERO, ZERO)
    assert (height >= 0.0).all()
    aloft = height[height > 0.0]
    assert np.diff(aloft).min() > -2.2 * CLIMB * DT  # it does not drop: the polynomial peaks at 35/16 of its mean
    assert 0.95 * 0.8 / CLIMB < (height < TOUCHDOWN).argmax() * DT < 6.0


def test_motors_off_is_a_fall():
    quadrotor = flying(height=1.5)
    quadrotor.stop()
    height = path_of(quadrotor, (0.0, 0.0, 9.0, 0.0), 1.5)[:, 2]
    assert (height <= TOUCHDOWN).argmax() * DT == pytest.approx(math.sqrt(2 * 1.5 / 9.81), abs=0.03)
    assert height[round(0.3 / DT) - 1] == pytest.approx(1.5 - 0.5 * 9.81 * 0.3**2, abs=0.02)


def test_wobble_is_added_to_place_not_motion():
    still, wobbling = flying(), flying()
    wobbling.wobble = (0.01, -0.02)
    path, other = (path_of(each, (0.3, 0.2, 0.9, 0.0), 1.0) for each in (still, wobbling))
    np.testing.assert_allclose(other - path, np.tile([0.01, -0.02, 0.0, 0.0], (100, 1)), atol=1e-15)
    assert (wobbling.held, wobbling.velocity) == (still.position, still.velocity)


def drive(twin, twist, seconds):
    return path_of(twin, (*twist, 0.0, 0.0), seconds)


@pytest.mark.parametrize(("v", "w"), [(0.2, 0.5), (0.2, 1e-9), (0.15, -1.5), (-0.1, 0.8)])
def test_constant_twist_is_a_circle(v, w):
    twin = Differential(KHEPERA4, ZERO, 0.4)
    drive(twin, (v, w), 0.5)  # up to speed
    begin, heading = twin.position, twin.yaw
    path, angle = drive(twin, (v, w), 3.0), heading + w * DT * np.arange(1, 301)
    np.testing.assert_allclose(path[:, 3], angle, atol=1e-12)
    circle = begin[:2] + v / w * np.stack([np.sin(angle) - np.sin(heading), np.cos(heading) - np.cos(angle)], axis=1)
    # chords of the length of the arc: longer than the circle's by (w dt)²/24
    np.testing.assert_allclose(path[:, :2], circle, atol=max(1e-6, abs(v / w) * (w * DT) ** 2 / 10))


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3], ids=lambda kind: kind.name)
def test_limit_of_wheels_keeps_the_curve(kind):
    limits, twin = kind.motion, Differential(kind, ZERO, 0.0)
    speeds = np.diff(drive(twin, (kind.speed, 0.0), 1.0)[:, 0]) / DT
    assert [np.diff(speeds).max() / DT, speeds[-1]] == pytest.approx([limits.acceleration, kind.speed])
    yaws = drive(twin, (3.0, 6.0), 2.0)[:, 3]
    speed, rate = np.linalg.norm(twin.velocity), (yaws[-1] - yaws[-2]) / DT
    assert [speed / rate, speed + 0.5 * limits.base * rate] == pytest.approx([0.5, limits.speed], rel=1e-9)


def test_command_holds_until_next_or_landing():
    twin = Differential(KHEPERA4, ZERO, 0.0)
    drive(twin, (0.2, 0.0), 0.5)
    for _ in range(1000):
        twin.move(DT)
    for no_command in ((np.nan, np.nan), (np.nan, 0.0), (0.0, np.nan)):
        drive(twin, no_command, 0.5)
        assert np.linalg.norm(twin.velocity) == pytest.approx(0.2)
    assert np.isfinite(twin.position).all()
    twin.land()
    for _ in range(20):
        twin.move(DT)
    assert twin.velocity == ZERO
