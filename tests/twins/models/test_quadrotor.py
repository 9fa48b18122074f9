"""Flying twins against the law that they claim to follow, integrated by other means."""

import math

import numpy as np
import pytest

from agents.body.kinds import CRAZYFLIE, TELLO
from tests.twins.runge_kutta import runge_kutta
from twins.models.onboard_flight import CLIMB, TOUCHDOWN
from twins.models.quadrotor import RESPONSES, Quadrotor, linear_step


def flying(kinds=(CRAZYFLIE,), height=0.8, dt=0.01, yaw=0.0):
    """In the air, at rest."""
    rows = len(kinds)
    start = np.tile([0.0, 0.0, height], (rows, 1))
    made = Quadrotor(kinds, start, np.full(rows, yaw), dt)
    made.flying[:] = True
    return made


def fly(quadrotor, setpoint, seconds, dt=0.01):
    """(T, rows, 3) positions under one setpoint."""
    path = []
    for _ in range(round(seconds / dt)):
        quadrotor.command(np.array(setpoint, dtype=float))
        quadrotor.advance()
        path.append(quadrotor.position.copy())
    return np.array(path)


def exact(response, axis, target, times):
    """Fourth-order Runge-Kutta solution of a' = k_t (k_v (clip(k_p (target − p)) − v) − a) from rest at 0."""
    gain, rate, limit, tilt = (getattr(response, name)[axis] for name in ("position", "velocity", "speed", "tilt"))

    def slope(y):
        wanted = rate * (np.clip(gain * (target - y[0]), -limit, limit) - y[1])
        return np.array([y[1], y[2], tilt * (wanted - y[2])] if math.isfinite(tilt) else [y[1], wanted, 0.0])

    y, found, h = np.zeros(3), [], times[1] - times[0]
    for _ in times[1:]:
        found.append(y[0])
        y = runge_kutta(slope, y, h)
    return np.array([*found, y[0]])


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("target", [0.05, 0.3, 1.0, 3.0])
def test_steps_solve_the_stated_law(axis, target):
    dt, setpoint = 0.001, [0.0, 0.0, 0.8, 0.0]
    setpoint[axis] += target
    path = fly(flying(dt=dt), [setpoint], 5.0, dt)[:, 0, axis] - (0.8 if axis == 2 else 0.0)
    truth = exact(RESPONSES["crazyflie"], axis, target, dt * np.arange(5001))
    np.testing.assert_allclose(path, truth[1:], atol=3e-3 * target)
    assert path[-1] == pytest.approx(target, rel=0.01)


@pytest.mark.parametrize(
    ("axis", "step", "rise_ms"), [(0, 0.3, 487), (0, 1.0, 730), (2, 0.3, 566), (2, 1.0, 733), (3, 1.0, 284)]
)
def test_steps_rise_like_the_firmware(axis, step, rise_ms):
    """Rise times are those of the maker's firmware, compiled and run on a rigid body of 29 g."""
    dt, setpoint, quadrotor = 0.001, np.array([0.0, 0.0, 0.8, 0.0]), flying(dt=0.001)
    setpoint[axis] += step
    path = []
    for _ in range(3000):
        quadrotor.command(setpoint[None])
        quadrotor.advance()
        path.append([*(quadrotor.position[0] - [0.0, 0.0, 0.8]), quadrotor.yaw[0]][axis] / step)
    path = np.array(path)
    assert dt * ((path > 0.9).argmax() - (path > 0.1).argmax()) == pytest.approx(1e-3 * rise_ms, rel=0.10)


@pytest.mark.parametrize("axis", [0, 2])
def test_linear_step_is_the_model(axis):
    quadrotor, dt = flying(dt=0.01), 0.01
    state, path = np.array([0.0, 0.0, 0.0, 0.1]), []
    setpoint = np.array([[0.0, 0.0, 0.8, 0.0]])
    setpoint[0, axis] += 0.1
    for _ in range(200):
        quadrotor.command(setpoint)
        quadrotor.advance()
        state = linear_step(RESPONSES["crazyflie"], axis, dt) @ state
        path.append((quadrotor.position[0, axis] - (0.8 if axis == 2 else 0.0), state[0]))
    np.testing.assert_allclose(*np.transpose(path), atol=1e-12)


def test_no_axis_exceeds_its_speed():
    quadrotor = flying()
    path = fly(quadrotor, [[50.0, -50.0, 30.0, 0.0]], 3.0)
    speed = np.abs(np.diff(path, axis=0))[:, 0] / 0.01
    limit = RESPONSES["crazyflie"].speed
    # a third state may pass a limit by its overshoot
    assert (speed.max(axis=0) <= np.multiply(1.2, limit)).all()
    np.testing.assert_allclose(speed[-1], limit, rtol=0.01)


def test_yaw_turns_the_shorter_way():
    quadrotor = flying(yaw=math.radians(178.0))
    turned = []
    for _ in range(300):
        before = quadrotor.yaw[0]
        fly(quadrotor, [[0.0, 0.0, 0.8, math.radians(-178.0)]], 0.01)
        turned.append(quadrotor.yaw[0] - before)
    assert sum(turned) == pytest.approx(math.radians(4.0), abs=1e-3)
    assert min(turned) >= 0.0


def test_yaw_keeps_the_largest_rate():
    quadrotor, turned = flying(), []
    for _ in range(100):
        before = quadrotor.yaw[0]
        fly(quadrotor, [[0.0, 0.0, 0.8, 3.0]], 0.01)
        turned.append((quadrotor.yaw[0] - before) / 0.01)
    assert max(turned) == pytest.approx(CRAZYFLIE.turn_rate)


def test_a_velocity_robot_follows_velocities_with_its_lag():
    tello = flying((TELLO,))
    path = fly(tello, [[0.5, 0.0, 0.0, 0.3]], 3.0)
    t = 3.0
    gain = RESPONSES["tello"].velocity[0]
    wanted = 0.5 * (t - (1.0 - math.exp(-gain * t)) / gain)
    assert path[-1, 0, 0] == pytest.approx(wanted, abs=0.01)
    np.testing.assert_allclose(tello.velocity, [[0.5, 0.0, 0.0]], atol=1e-3)
    assert tello.yaw[0] == pytest.approx(0.9)
    fly(tello, [[9.0, 0.0, 0.0, 0.0]], 5.0)
    assert tello.velocity[0, 0] == pytest.approx(1.0, abs=1e-3)


def test_yaw_turns_to_where_it_is_told():
    quadrotor = flying()
    fly(quadrotor, [[0.0, 0.0, 0.8, 1.0]], 0.5)
    assert quadrotor.yaw[0] == pytest.approx(1.0 - math.exp(-CRAZYFLIE.turn_response * 0.5), abs=0.01)


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_take_off_climbs_over_the_place_and_stays(kind):
    quadrotor = Quadrotor((kind,), np.array([[0.3, -0.2, 0.0]]), np.array([0.5]), 0.01)
    quadrotor.takeoff(np.array([0]), np.array([0.8]))
    assert quadrotor.flying.tolist() == [True]
    path = []
    for _ in range(900):
        quadrotor.advance()
        path.append(quadrotor.position[0].copy())
    path = np.array(path)
    np.testing.assert_allclose(path[:, :2], np.tile([0.3, -0.2], (900, 1)), atol=1e-12)
    assert path[-1, 2] == pytest.approx(0.8, abs=1e-3)
    assert quadrotor.yaw[0] == pytest.approx(0.5)
    halfway = 0.8 / CLIMB  # by then the polynomial has ended; the body lags behind it
    assert 0.4 < path[round(halfway / 0.01) - 1, 2] < 0.8
    assert path[:, 2].max() < 0.8 * 1.08  # the firmware's overshoot is 7 to 11 %


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_landing_ends_on_the_floor_with_motors_off(kind):
    quadrotor = flying((kind,))
    quadrotor.land(np.array([0]))
    path = fly(quadrotor, [[5.0, 5.0, 5.0, 1.0]], 8.0)[:, 0]  # setpoints do not interrupt a landing
    assert not quadrotor.flying[0]
    np.testing.assert_array_equal(quadrotor.position, [[0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(quadrotor.velocity, [[0.0, 0.0, 0.0]])
    assert (path[:, 2] >= 0.0).all()
    aloft = path[path[:, 2] > 0.0, 2]
    assert np.diff(aloft).min() > -2.2 * CLIMB * 0.01  # it does not drop: the polynomial peaks at 35/16 of its mean
    touch = path[:, 2] < TOUCHDOWN
    assert touch.argmax() * 0.01 > 0.95 * 0.8 / CLIMB


def test_a_landing_that_is_ordered_again_every_half_second_takes_no_longer():
    once, again = flying(), flying()
    for step in range(400):
        if step == 0:
            once.land(np.array([0]))
        if step % 50 == 0:
            again.land(np.array([0]))
        once.advance()
        again.advance()
        np.testing.assert_array_equal(again.position, once.position)
    assert not again.flying[0]


def test_motors_off_is_a_fall():
    quadrotor = flying(height=1.5)
    quadrotor.stop(np.array([0]))
    path = fly(quadrotor, [[0.0, 0.0, 9.0, 0.0]], 1.5)[:, 0, 2]
    seconds = math.sqrt(2 * 1.5 / 9.81)
    landed = int((path <= TOUCHDOWN).argmax()) * 0.01
    assert landed == pytest.approx(seconds, abs=0.03)
    assert path[round(0.3 / 0.01) - 1] == pytest.approx(1.5 - 0.5 * 9.81 * 0.3**2, abs=0.02)
    assert path[-1] == 0.0
    assert not quadrotor.velocity.any()


def test_setpoints_on_the_ground_do_nothing():
    quadrotor = Quadrotor((CRAZYFLIE, TELLO), np.zeros((2, 3)), np.zeros(2), 0.01)
    fly(quadrotor, [[1.0, 1.0, 1.0, 1.0]] * 2, 1.0)
    assert not quadrotor.position.any()
    assert not quadrotor.yaw.any()
    quadrotor.land(np.array([0, 1]))
    fly(quadrotor, [[1.0, 1.0, 1.0, 1.0]] * 2, 1.0)
    assert not quadrotor.position.any()
    quadrotor.takeoff(np.array([0, 1]), np.array([0.5, 0.5]))
    fly(quadrotor, [[np.nan] * 4] * 2, 6.0)
    np.testing.assert_allclose(quadrotor.position, [[0.0, 0.0, 0.5]] * 2, atol=1e-3)  # nothing was kept for later


def test_rows_of_nan_keep_what_they_were_told():
    quadrotor = flying((CRAZYFLIE, CRAZYFLIE))
    quadrotor.command(np.array([[0.5, 0.0, 0.8, 0.0], [0.0, 0.5, 0.8, 0.0]]))
    fly(quadrotor, [[np.nan] * 4, [0.0, 0.3, 0.8, 0.0]], 8.0)
    np.testing.assert_allclose(quadrotor.position, [[0.5, 0.0, 0.8], [0.0, 0.3, 0.8]], atol=1e-3)


def test_a_setpoint_ends_a_climb():
    quadrotor = Quadrotor((CRAZYFLIE,), np.zeros((1, 3)), np.zeros(1), 0.01)
    quadrotor.takeoff(np.array([0]), np.array([2.0]))
    fly(quadrotor, [[np.nan] * 4], 2.0)
    fly(quadrotor, [[0.0, 0.0, 0.6, 0.0]], 8.0)
    assert quadrotor.position[0, 2] == pytest.approx(0.6, abs=1e-3)
