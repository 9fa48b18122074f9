"""Flying twins against the law that they claim to follow, integrated by other means."""

import math

import numpy as np
import pytest

from agents.body.kinds import CRAZYFLIE, TELLO
from tests.twins.runge_kutta import runge_kutta
from twins.models.onboard_flight import CLIMB, TOUCHDOWN
from twins.models.quadrotor import RESPONSES, Quadrotor


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


def exact(target, kp, kv, limit, times):
    """Fourth-order Runge-Kutta solution of v' = kv (clip(kp (target − p)) − v) from rest at 0."""

    def slope(y):
        return np.array([y[1], kv * (np.clip(kp * (target - y[0]), -limit, limit) - y[1])])

    y, found, h = np.zeros(2), [], times[1] - times[0]
    for _ in times[1:]:
        found.append(y[0])
        y = runge_kutta(slope, y, h)
    return np.array([*found, y[0]])


def test_a_small_step_is_the_closed_form_of_a_damped_oscillator():
    dt, step = 0.001, 0.2
    path = fly(flying(dt=dt), [[step, 0.0, 0.8 + step, 0.0]], 4.0, dt)[:, 0]
    t = dt * np.arange(1, len(path) + 1)
    for axis, (kp, kv) in ((0, (2.0, 3.5)), (2, (2.5, 4.0))):
        omega = math.sqrt(kp * kv)
        zeta = kv / (2.0 * omega)
        damped = omega * math.sqrt(1.0 - zeta**2)
        envelope = np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t))
        start = 0.8 if axis == 2 else 0.0
        np.testing.assert_allclose(path[:, axis], start + step * (1.0 - envelope), atol=5e-4)


@pytest.mark.parametrize("target", [0.3, 1.0, 3.0])
def test_a_step_of_any_size_is_the_solution_of_its_law(target):
    response = RESPONSES["crazyflie"]
    path = fly(flying(), [[target, 0.0, 0.8, 0.0]], 5.0)[:, 0, 0]
    times = 0.001 * np.arange(5001)
    truth = exact(target, response.position[0], response.velocity[0], response.speed[0], times)
    np.testing.assert_allclose(path, truth[10::10], atol=0.012)  # steps of 10 ms at 1 m/s
    assert path[-1] == pytest.approx(target, abs=0.01)


def test_it_is_never_faster_than_its_limit():
    quadrotor = flying()
    path = fly(quadrotor, [[50.0, -50.0, 30.0, 0.0]], 3.0)
    speed = np.abs(np.diff(path, axis=0)) / 0.01
    assert speed.max() <= 1.0 + 1e-9
    assert speed[-1].min() > 0.99


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
    assert path[:, 2].max() < 0.8 + 0.05


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
    assert touch.argmax() * 0.01 > 0.8 / CLIMB


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
