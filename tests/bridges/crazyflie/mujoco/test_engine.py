"""Rigid quadrotors in MuJoCo against mechanics, against the theory of their cascade, and against the fitted law."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest

from agents.body.interface import BodyError, Disturbance
from agents.vectors import NO_SETPOINT, ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from tests.requests import request
from tests.twins.planar_drive import columns, command, stage
from twins.body import TwinBody
from twins.engines.engine import World
from twins.models.quadrotor import GRAVITY, Quadrotor
from twins.scene import Obstacle, Scene

pytest.importorskip("mujoco", reason="the engine mujoco is the extra [mujoco]: ./zenpark install mujoco-core")

from bridges.crazyflie.mujoco.engine import LIFT, RigidBody
from tests.cases import mostly_slow

DT = 0.01


def hovering(kind=CRAZYFLIE, height=1.0, dt=DT, scene=None):
    made = RigidBody().build(stage((kind,), [(0, 0)], scene=scene, dt=dt))
    made.place([0], [(0.0, 0.0, height)], [0.0], [True])
    path_of(made, [[0.0, 0.0, height, 0.0]] if kind is CRAZYFLIE else [[0.0] * 4], 0.5, dt)
    return made


def path_of(engine, setpoints, seconds, dt=DT):
    """(T, robots, 4) positions and yaw under one setpoint each."""
    path, still = [], [(0.0, 0.0)] * len(engine.motions)
    for _ in range(round(seconds / dt)):
        command(engine, setpoints)
        engine.advance(0.0, still)
        path.append([(*motion.position, motion.yaw) for motion in engine.motions])
    return np.array(path)


def lean(engine):
    """Angle of the first drone against level [deg]."""
    _, x, y, _ = engine.motions[0].attitude
    return math.degrees(math.acos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))


def rise_and_overshoot(path, step, dt=DT):
    """From a tenth to nine tenths of a step [s], and what it goes beyond it, as a share of the step."""
    path = np.concatenate([[0.0], path])

    def crossing(level):
        after = int((path >= level * step).argmax())
        return dt * (after - 1 + (level * step - path[after - 1]) / (path[after] - path[after - 1]))

    return crossing(0.9) - crossing(0.1), path.max() / step - 1.0


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_motors_carry_the_weight(kind):
    engine = hovering(kind)
    weight = kind.airframe.mass * GRAVITY
    assert engine.drones.state[0, LIFT].sum() == pytest.approx(weight, rel=2e-3)
    assert engine.motions[0].attitude == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-6)
    assert engine.motions[0].position == pytest.approx((0.0, 0.0, 1.0), abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axis", "step", "rise", "overshoot"),
    [
        (0, 0.3, 0.487, 0.112),
        (0, 1.0, 0.730, 0.029),
        (2, 0.3, 0.572, 0.087),
        (2, 1.0, 0.735, 0.121),
        (3, 1.0, 0.283, 0.035),
    ],
)
def test_steps_beside_the_fitted_law(axis, step, rise, overshoot):
    """Figures are those of docs/results/simulation.md."""
    engine, law = hovering(), Quadrotor(CRAZYFLIE, ZERO, 0.0)
    before = np.array([0.0, 0.0, 1.0, 0.0])
    setpoint = before + step * np.eye(4)[axis]
    law.place(engine.motions[0].position, 0.0, flying=True)
    law.command(tuple(setpoint.tolist()))
    fitted = []
    for _ in range(600):
        law.move(DT)
        fitted.append((*law.position, law.yaw)[axis])
    path = path_of(engine, [setpoint], 6.0)[:, 0, axis] - before[axis]
    mine, fitted = rise_and_overshoot(path, step), rise_and_overshoot(np.array(fitted) - before[axis], step)
    assert fitted[0] == pytest.approx(mine[0], rel=0.10)
    assert abs(mine[1] - fitted[1]) < 0.04
    assert (mine[0], mine[1]) == (pytest.approx(rise, rel=0.02), pytest.approx(overshoot, abs=0.01))
    assert path[-1] == pytest.approx(step, abs=0.06 * step)  # the vertical integrals need some ten seconds


def test_tilt_and_speed_stay_within_the_limits():
    engine = hovering()
    leans, speed = [], []
    for _ in range(300):
        path_of(engine, [[20.0, -20.0, 1.0, 0.0]], DT)
        leans.append(lean(engine))
        speed.append(max(map(abs, engine.motions[0].velocity[:2])))
    assert 20.0 < max(leans) < 32.0  # 20° on each of two axes, and the overshoot of the attitude loop
    assert 1.0 < max(speed) < 1.35
    assert speed[-1] == pytest.approx(1.1, abs=0.03)
    assert np.linalg.norm(engine.motions[0].attitude) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_take_off_and_landing(kind):
    engine = RigidBody().build(stage((kind,), [(0.3, -0.2)]))
    path_of(engine, [[1.0, 1.0, 1.0, 1.0]], 0.5)
    assert engine.motions[0].position == pytest.approx((0.3, -0.2, 0.0), abs=2e-4)  # setpoints on the ground do nothing
    engine.takeoff([0], [0.8])
    path = path_of(engine, [[np.nan] * 4], 8.0)[:, 0]
    np.testing.assert_allclose(path[-1], [0.3, -0.2, 0.8, 0.0], atol=0.03)
    assert path[:, 2].max() < 0.9
    engine.land([0])
    path_of(engine, [[5.0, 5.0, 5.0, 1.0]], 8.0)
    assert not engine.motions[0].flying
    assert engine.motions[0].position == pytest.approx((0.3, -0.2, 0.0), abs=3e-3)
    assert engine.motions[0].velocity == ZERO


def test_motors_off_is_a_fall():
    engine = hovering(height=1.5)
    engine.stop([0])
    heights = path_of(engine, [[0.0, 0.0, 9.0, 0.0]], 1.5)[:, 0, 2]
    lag = 0.03  # the propellers run down: that much later by mechanics
    fallen = 0.3 - lag * (1.0 - math.exp(-0.3 / lag))
    assert heights[29] == pytest.approx(1.5 - 0.5 * GRAVITY * fallen**2, abs=0.02)
    assert (heights < 0.02).argmax() * DT == pytest.approx(math.sqrt(3.0 / GRAVITY) + lag, abs=0.03)
    assert heights[-1] == pytest.approx(0.0, abs=2e-3)

    spinning = hovering(height=2.0)
    path_of(spinning, [[3.0, 0.0, 2.0, 0.0]], 0.08)
    spinning.stop([0])
    path_of(spinning, [[np.nan] * 4], 0.6)
    assert lean(spinning) > 20.0  # it goes on turning as it falls
    path_of(spinning, [[np.nan] * 4], 2.4)
    assert spinning.motions[0].velocity == ZERO


@pytest.mark.slow
def test_drone_on_its_back_is_switched_off():
    engine = hovering()
    engine.drones.state[0, 4:8] = [0.0, 1.0, 0.0, 0.0]
    path_of(engine, [[0.0, 0.0, 1.0, 0.0]], 3.0)
    assert not engine.motions[0].flying
    engine.takeoff([0], [0.5])
    path_of(engine, [[np.nan] * 4], 1.0)
    assert not engine.motions[0].flying
    engine.place([0], [ZERO], [0.0], [False])  # someone puts it on its feet
    engine.takeoff([0], [0.5])
    path_of(engine, [[np.nan] * 4], 4.0)
    assert engine.motions[0].position[2] == pytest.approx(0.5, abs=0.05)


@pytest.mark.slow
def test_drones_are_the_same_alone():
    kinds = (CRAZYFLIE, KHEPERA4, TELLO, CRAZYFLIE)
    start = [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]  # in each other: they do not touch
    commands = np.random.default_rng(7).uniform([-0.5, -0.5, 0.3, -0.5], [0.5, 0.5, 0.9, 0.5], (150, 4, 4))

    def heights_of(rows):
        engine = RigidBody().build(stage([kinds[r] for r in rows], [start[r] for r in rows]))
        seen = []
        for tick in range(150):
            if tick == 5:
                air = [k for k, r in enumerate(rows) if kinds[r].flies]
                engine.takeoff(air, [0.5] * len(air))
            if tick == 120 and 0 in rows:
                engine.stop([rows.index(0)])
            command(engine, commands[tick, rows])
            engine.advance(0.0, [(0.01 * math.sin(tick + r), 0.0) for r in rows])
            seen.append([(*m.position, *m.velocity, m.yaw, *m.attitude) for m in engine.motions])
        return np.array(seen)

    together = heights_of([0, 1, 2, 3])
    for rows in ([0], [3, 1], [2, 0]):
        np.testing.assert_array_equal(heights_of(rows), together[:, rows])
    assert (np.abs(together[-1, :, :3] - np.array(start)).max(axis=1) > 0.05).all()


@pytest.mark.parametrize("dt", mostly_slow([DT, 0.02, 0.004, 1.0 / 64.0, 1.0 / 30.0], 5))
def test_any_step_divides_into_firmware_rate(dt):
    path = path_of(hovering(dt=dt), [[0.3, 0.0, 1.0, 0.0]], 4.0, dt)[:, 0, 0]
    rise, overshoot = rise_and_overshoot(path, 0.3, dt)
    assert rise == pytest.approx(0.487, abs=0.5 * dt + 0.01)
    assert overshoot == pytest.approx(0.112, abs=0.015)


@pytest.mark.slow
def test_fixed_obstacles_are_in_the_way():
    obstacles = {
        "table": Obstacle(box=(0.4, 0.4), at=(0.0, 0.0), height=0.5),
        "post": Obstacle(radius=0.1, at=(1.0, 0.0)),
        "screen": Obstacle(wall=[(-0.5, -0.3), (-0.5, 0.3)], at=(-0.5, 0.0)),
    }
    scene = Scene.furnished((4.0, 4.0, 2.5), obstacles, {}, walled=True)
    engine = hovering(scene=scene)
    engine.stop([0])
    path_of(engine, [[np.nan] * 4], 2.0)
    assert engine.motions[0].position == pytest.approx((0.0, 0.0, 0.5), abs=3e-3)
    for target, reach in (((1.5, 0.0), 0.9), ((-1.5, 0.0), 1.0 - 0.005), ((0.0, 5.0), 2.0)):
        path = path_of(hovering(scene=scene), [[*target, 1.0, 0.0]], 5.0)[:, 0, :2]
        assert np.abs(path).max() == pytest.approx(reach - 0.046, abs=0.02)  # it leans there, a corner ahead or behind


def test_mirrored_robots_are_where_they_are_shown():
    engine = RigidBody().build(stage((CRAZYFLIE, KHEPERA4), [(0, 0), (0, 0)], mirrored=[True, True]))
    assert np.isnan(columns(engine, "position")).all()
    places = [(0.1, 0.2, 0.9), (0.5, 0.5, 0.0)]
    engine.mirror([0, 1], places, [0.3, 1.0], [ZERO] * 2)
    path_of(engine, [[np.nan] * 4] * 2, 0.1)
    assert [motion.position for motion in engine.motions] == places
    assert columns(engine, "attitude")[:, 3] == pytest.approx(np.sin([0.15, 0.5]))
    assert engine.touches() == []


def twin(kinds, disturbance=None):
    rows = len(kinds)
    world = World(Scene.empty(), RigidBody(), ((),) * rows, 1.0, (False,) * rows)
    return TwinBody(request(kinds, start=[(0.0, 0.0)] * rows, disturbance=disturbance), world)


def test_drone_leans_against_the_wind():
    body = twin((CRAZYFLIE, CRAZYFLIE), {"R0": Disturbance(wind=(0.8, 0.0)), "R1": Disturbance()})
    body.takeoff(range(2), [0.5] * 2)
    for tick in range(1000):
        windy, calm = body.read(tick * DT)
    assert 2.0 * np.arcsin(windy.attitude[2]) == pytest.approx(-np.arctan(0.8 / 9.81), rel=0.05)
    assert abs(calm.attitude[2]) < 1e-3


def test_ground_robots_drive_as_point_masses():
    body, plain = twin((KHEPERA4, CRAZYFLIE)), TwinBody(request((KHEPERA4,)))
    for tick in range(100):
        states, others = body.read(tick * DT), plain.read(tick * DT)
        body.command([(0.2, 0.5, 0.0, 0.0), NO_SETPOINT])
        plain.command([(0.2, 0.5, 0.0, 0.0)])
    assert states[0].true_position == others[0].true_position
    assert np.isfinite([state.attitude for state in states]).all()


def test_missing_library_or_airframe_is_named(monkeypatch):
    drone = replace(CRAZYFLIE, name="mine", airframe=None)
    with pytest.raises(BodyError, match="no airframe of 'mine'; give the kind an `airframe`"):
        RigidBody().build(stage((drone,), [(0, 0)]))
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(BodyError, match="mujoco-core"):
        RigidBody().build(stage((CRAZYFLIE,), [(0, 0)]))
