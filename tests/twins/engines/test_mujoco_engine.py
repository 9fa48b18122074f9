"""Rigid quadrotors in MuJoCo against mechanics, against the theory of their cascade, and against the fitted law."""

import math
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from agents.body.interface import BodyError, Disturbance, Jitter
from agents.body.kinds import CRAZYFLIE, KHEPERA4, TELLO
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, Link, Robot, World
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.virtual_time.simulation import simulate
from tests.twins.runge_kutta import runge_kutta
from twins.body import TwinBody
from twins.engines.engine import Stage
from twins.engines.mujoco_model import AIRFRAMES
from twins.models.quadrotor import GRAVITY, RESPONSES, Quadrotor
from twins.scene import Obstacle, Scene

pytest.importorskip("mujoco", reason="the engine mujoco is the extra [mujoco]: ./zenpark install mujoco-core")

from twins.engines.mujoco_engine import LIFT, TRACKED_SHARE, Drones, RigidBody

DT = 0.01


def stage(kinds=(CRAZYFLIE,), start=None, *, scene=None, mirrored=None, dt=DT):
    rows = len(kinds)
    return Stage(
        tuple(kinds),
        np.zeros((rows, 3)) if start is None else np.array(start, dtype=float),
        np.zeros(rows),
        dt,
        np.zeros(rows, dtype=np.intp),
        np.zeros(rows, dtype=bool) if mirrored is None else np.array(mirrored),
        Scene.empty() if scene is None else scene,
    )


def hovering(kind=CRAZYFLIE, height=1.0, dt=DT, lag=0.03, scene=None):
    """One drone that holds its place."""
    made = RigidBody(motor_lag_s=lag).build(stage((kind,), scene=scene, dt=dt))
    place = np.array([[0.0, 0.0, height]])
    made.place(np.array([0]), place, np.zeros(1), np.array([True]))
    fly(made, [[*place[0], 0.0]] if kind is CRAZYFLIE else [[0.0] * 4], 0.5, dt)
    return made


def fly(engine, setpoint, seconds, dt=DT):
    """(T, rows, 4) positions and yaw under one setpoint."""
    path, still = [], np.zeros((len(engine.yaw), 2))
    for _ in range(round(seconds / dt)):
        engine.command(np.array(setpoint, dtype=float))
        engine.advance(0.0, still)
        path.append(np.column_stack([engine.position, engine.yaw]))
    return np.array(path)


def rise_and_overshoot(path, step, dt=DT):
    """From a tenth to nine tenths of a step [s], and what it goes beyond it, as a share of the step."""
    path = np.concatenate([[0.0], path])

    def crossing(level):
        after = int((path >= level * step).argmax())
        return dt * (after - 1 + (level * step - path[after - 1]) / (path[after] - path[after - 1]))

    return crossing(0.9) - crossing(0.1), path.max() / step - 1.0


def linear_cascade(step, seconds, h=0.0005):
    """x of the continuous cascade, tilts small and nothing at its limit, by Runge and Kutta: the paper's figure 6."""
    frame = AIRFRAMES["crazyflie"]
    unit = 2.0 * frame.thrust / 65535.0 * frame.arm / math.sqrt(2.0)  # torque of one unit of roll or pitch [N m]
    lag, inertia = 0.03, frame.inertia[0]

    def slope(s):
        x, v, angle, rate, torque, of_velocity, of_angle, of_rate = s
        missing = 2.0 * (step - x) - v
        lean = 25.0 * missing + of_velocity - math.degrees(angle)
        turn = 6.0 * lean + 3.0 * of_angle - math.degrees(rate)
        wanted = unit * (250.0 * turn + 500.0 * of_rate - 2.5 * math.degrees(torque / inertia))
        return np.array([v, GRAVITY * angle, rate, torque / inertia, (wanted - torque) / lag, missing, lean, turn])

    s, path = np.zeros(8), []
    for tick in range(round(seconds / h)):
        if tick % round(DT / h) == 0:
            path.append(s[0])
        s = runge_kutta(slope, s, h)
    return np.array(path[1:])


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_motors_carry_the_weight_and_the_drone_is_level(kind):
    engine = hovering(kind)
    weight = AIRFRAMES[kind.name].mass * GRAVITY
    np.testing.assert_allclose(engine.quadrotor._state[:, LIFT].sum(axis=1), weight, rtol=2e-3)
    np.testing.assert_allclose(engine.attitude, [[1.0, 0.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(engine.position, [[0.0, 0.0, 1.0]], atol=2e-3)


@pytest.mark.slow
def test_a_small_step_is_that_of_the_linear_cascade():
    path = fly(hovering(), [[0.1, 0.0, 1.0, 0.0]], 4.0)[:, 0, 0]
    theory = linear_cascade(0.1, 4.0)
    np.testing.assert_allclose(path[: len(theory)], theory[: len(path)], atol=0.0025)
    assert rise_and_overshoot(path, 0.1)[0] == pytest.approx(rise_and_overshoot(theory, 0.1)[0], rel=0.02)
    assert rise_and_overshoot(path, 0.1)[1] == pytest.approx(rise_and_overshoot(theory, 0.1)[1], abs=0.015)


STEPS = ((0, 0.3), (0, 1.0), (2, 0.3), (2, 1.0), (3, 1.0))


@pytest.fixture(scope="module")
def flown_steps():
    """(T,) along the axis of each step, from where it began: of the rigid body, and of the law."""
    rows = np.arange(len(STEPS))
    before = np.column_stack([np.zeros(len(rows)), 4.0 * rows, np.ones(len(rows)), np.zeros(len(rows))])  # far apart
    engine = RigidBody().build(stage((CRAZYFLIE,) * len(rows)))
    engine.place(rows, before[:, :3], before[:, 3], np.ones(len(rows), dtype=bool))
    fly(engine, before, 0.5)
    model = Quadrotor((CRAZYFLIE,) * len(rows), engine.position, np.zeros(len(rows)), DT)
    setpoint = before.copy()
    for row, (axis, step) in enumerate(STEPS):
        setpoint[row, axis] += step
    model.flying[:] = True
    path = []
    for _ in range(600):
        model.command(setpoint)
        model.advance()
        path.append(np.column_stack([model.position, model.yaw]))
    paths = [fly(engine, setpoint, 6.0), np.array(path)]
    return {
        wanted: [path[:, row, wanted[0]] - before[row, wanted[0]] for path in paths] for row, wanted in enumerate(STEPS)
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wanted", "rise", "overshoot"),
    [
        (STEPS[0], 0.487, 0.112),
        (STEPS[1], 0.730, 0.029),
        (STEPS[2], 0.572, 0.087),
        (STEPS[3], 0.735, 0.121),
        (STEPS[4], 0.283, 0.035),
    ],
)
def test_steps_beside_the_fitted_law(flown_steps, wanted, rise, overshoot):
    """Figures are those of docs/results/simulation.md."""
    _, step = wanted
    path, other = flown_steps[wanted]
    mine, fitted = rise_and_overshoot(path, step), rise_and_overshoot(other, step)
    assert fitted[0] == pytest.approx(mine[0], rel=0.10)
    assert abs(mine[1] - fitted[1]) < 0.04
    assert mine[0] == pytest.approx(rise, rel=0.02)
    assert mine[1] == pytest.approx(overshoot, abs=0.01)
    assert path[-1] == pytest.approx(step, abs=0.06 * step)  # the vertical integrals need some ten seconds


@pytest.mark.slow
def test_the_lag_of_the_motors_hardly_shows_in_the_position():
    quick, slow = (fly(hovering(lag=lag), [[0.5, 0.2, 1.0, 0.5]], 4.0)[:, 0, :2] for lag in (0.02, 0.06))
    assert np.abs(quick - slow).max() < 0.01


def test_tilt_and_speed_stay_within_the_limits():
    engine = hovering()
    lean, speed = [], []
    for _ in range(300):
        fly(engine, [[20.0, -20.0, 1.0, 0.0]], DT)
        w, x, y, z = engine.attitude[0]
        lean.append(math.degrees(math.acos(1.0 - 2.0 * (x * x + y * y))))
        speed.append(np.abs(engine.velocity[0, :2]).max())
    assert 20.0 < max(lean) < 32.0  # 20° on each of two axes, and the overshoot of the attitude loop
    assert 1.0 < max(speed) < 1.35
    assert speed[-1] == pytest.approx(1.1, abs=0.03)
    w, x, y, z = engine.attitude[0]
    assert w * w + x * x + y * y + z * z == pytest.approx(1.0)


@pytest.mark.slow
def test_the_nose_points_where_it_flies_to():
    engine = hovering()
    fly(engine, [[0.0, 0.0, 1.0, math.pi / 2]], 4.0)
    w, x, y, z = engine.attitude[0]
    assert 2.0 * math.atan2(z, w) == pytest.approx(math.pi / 2, abs=0.05)  # its integral is slow
    fly(engine, [[0.0, 0.5, 1.0, math.pi / 2]], 0.3)
    w, x, y, z = engine.attitude[0]
    assert 2.0 * (x * z - w * y) < -0.1  # the nose is down
    assert abs(2.0 * (y * z + w * x)) < 0.02  # and the left side is level
    assert engine.velocity[0, 1] > 5 * abs(engine.velocity[0, 0])


@pytest.mark.parametrize("kind", [CRAZYFLIE, TELLO])
def test_take_off_and_landing(kind):
    engine = RigidBody().build(stage((kind,), [[0.3, -0.2, 0.0]]))
    fly(engine, [[1.0, 1.0, 1.0, 1.0]], 0.5)
    np.testing.assert_allclose(engine.position, [[0.3, -0.2, 0.0]], atol=2e-4)  # setpoints on the ground do nothing
    engine.takeoff(np.array([0]), np.array([0.8]))
    assert engine.quadrotor.flying.tolist() == [True]
    path = fly(engine, [[np.nan] * 4], 8.0)[:, 0]
    np.testing.assert_allclose(path[-1], [0.3, -0.2, 0.8, 0.0], atol=0.03)
    np.testing.assert_allclose(path[:, :2], np.tile([0.3, -0.2], (800, 1)), atol=2e-3)
    assert path[:, 2].max() < 0.9
    engine.land(np.array([0]))
    fly(engine, [[5.0, 5.0, 5.0, 1.0]], 8.0)
    assert engine.flying.tolist() == [False]
    np.testing.assert_allclose(engine.position, [[0.3, -0.2, 0.0]], atol=3e-3)
    np.testing.assert_array_equal(engine.velocity, np.zeros((1, 3)))


def test_motors_off_is_a_fall_and_a_leaning_one_tumbles_and_stays_down():
    engine = hovering(height=1.5)
    engine.stop(np.array([0]))
    heights = fly(engine, [[0.0, 0.0, 9.0, 0.0]], 1.5)[:, 0, 2]
    lag = 0.03  # the propellers run down: that much later by mechanics
    fallen = 0.3 - lag * (1.0 - math.exp(-0.3 / lag))
    assert heights[29] == pytest.approx(1.5 - 0.5 * GRAVITY * fallen**2, abs=0.02)
    assert (heights < 0.02).argmax() * DT == pytest.approx(math.sqrt(3.0 / GRAVITY) + lag, abs=0.03)
    assert heights[-1] == pytest.approx(0.0, abs=2e-3)

    spinning = hovering(height=2.0)
    fly(spinning, [[3.0, 0.0, 2.0, 0.0]], 0.08)
    spinning.stop(np.array([0]))
    lean = []
    for _ in range(300):
        fly(spinning, [[np.nan] * 4], DT)
        _, x, y, _ = spinning.attitude[0]
        lean.append(math.degrees(math.acos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))))
    assert max(lean[:60]) > 20.0  # it goes on turning as it falls
    assert not spinning.velocity.any()


@pytest.mark.slow
def test_what_is_on_its_back_is_switched_off_and_does_not_take_off():
    engine = hovering()
    drones = engine.quadrotor
    drones._state[0, 4:8] = [0.0, 1.0, 0.0, 0.0]
    fly(engine, [[0.0, 0.0, 1.0, 0.0]], 3.0)
    assert engine.flying.tolist() == [False]
    engine.takeoff(np.array([0]), np.array([0.5]))
    fly(engine, [[np.nan] * 4], 1.0)
    assert engine.flying.tolist() == [False]
    engine.place(np.array([0]), np.zeros((1, 3)), np.zeros(1), np.array([False]))  # someone puts it on its feet
    engine.takeoff(np.array([0]), np.array([0.5]))
    fly(engine, [[np.nan] * 4], 4.0)
    assert engine.position[0, 2] == pytest.approx(0.5, abs=0.05)


@pytest.mark.slow
def test_a_tello_follows_velocities():
    engine = hovering(TELLO)
    path = fly(engine, [[0.5, 0.0, 0.0, 0.3]], 3.0)[:, 0]
    np.testing.assert_allclose(engine.velocity, [[0.5, 0.0, 0.0]], atol=0.03)  # in the room, while it turns
    assert path[-1, 3] == pytest.approx(0.9, abs=0.1)
    fly(engine, [[9.0, 0.0, 0.0, 0.0]], 5.0)
    assert engine.velocity[0, 0] == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_rows_and_copies_are_what_they_are_alone_to_the_last_bit():
    kinds = (CRAZYFLIE, KHEPERA4, TELLO, CRAZYFLIE)
    start = [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]  # in each other: they do not touch
    rng = np.random.default_rng(7)
    commands = rng.uniform([-0.5, -0.5, 0.3, -0.5], [0.5, 0.5, 0.9, 0.5], (150, 4, 4))
    wobbles = 0.01 * rng.standard_normal((150, 4, 2))

    def run(rows):
        engine = RigidBody().build(stage([kinds[r] for r in rows], [start[r] for r in rows]))
        seen = []
        for tick in range(150):
            if tick == 5:
                air = np.array([k for k, r in enumerate(rows) if kinds[r].flies and r != 3], dtype=np.intp)
                engine.takeoff(air, np.full(len(air), 0.5))
            if tick == 60 and 3 in rows:
                engine.takeoff(np.array([rows.index(3)]), np.array([0.4]))
            if tick == 120 and 0 in rows:
                engine.stop(np.array([rows.index(0)]))
            engine.command(commands[tick, rows])
            engine.advance(0.0, wobbles[tick, rows])
            seen.append(np.column_stack([engine.position, engine.velocity, engine.yaw, engine.attitude]))
        return np.array(seen)

    together = run([0, 1, 2, 3])
    for rows in ([0], [1], [2], [3], [3, 1], [2, 0]):
        np.testing.assert_array_equal(run(rows), together[:, rows])
    assert (np.abs(together[-1, :, :3] - np.array(start)).max(axis=1) > 0.05).all()


SLOW = pytest.mark.slow


@pytest.mark.parametrize("dt", [0.02, *(pytest.param(dt, marks=SLOW) for dt in (0.01, 0.004, 1.0 / 64.0, 1.0 / 30.0))])
def test_any_step_divides_into_the_rate_of_the_firmware(dt):
    path = fly(hovering(dt=dt), [[0.3, 0.0, 1.0, 0.0]], 4.0, dt)[:, 0, 0]
    rise, overshoot = rise_and_overshoot(path, 0.3, dt)
    assert rise == pytest.approx(0.487, abs=0.5 * dt + 0.01)
    assert overshoot == pytest.approx(0.112, abs=0.015)


@pytest.mark.slow
def test_what_stands_fast_is_in_the_way():
    obstacles = {
        "table": Obstacle(box=(0.4, 0.4), at=(0.0, 0.0), height=0.5),
        "post": Obstacle(radius=0.1, at=(1.0, 0.0)),
        "screen": Obstacle(wall=[(-0.5, -0.3), (-0.5, 0.3)], at=(-0.5, 0.0)),
    }
    scene = Scene.furnished((4.0, 4.0, 2.5), obstacles, {}, walled=True)
    engine = hovering(scene=scene)
    engine.stop(np.array([0]))
    fly(engine, [[np.nan] * 4], 2.0)
    np.testing.assert_allclose(engine.position, [[0.0, 0.0, 0.5]], atol=3e-3)
    for target, reach in (((1.5, 0.0), 0.9 - 0.046), ((-1.5, 0.0), -(1.0 - 0.005 - 0.046)), ((0.0, 5.0), 2.0 - 0.046)):
        flown = fly(hovering(scene=scene), [[*target, 1.0, 0.0]], 5.0)[:, 0, :2]
        axis = 0 if target[0] else 1
        furthest = np.abs(flown[:, axis]).max()
        assert furthest == pytest.approx(abs(reach), abs=0.02)  # it leans against it, a corner ahead or behind


def test_mirrored_rows_are_where_they_are_said_to_be():
    engine = RigidBody().build(stage((CRAZYFLIE, KHEPERA4), mirrored=[True, True]))
    assert np.isnan(engine.position).all()
    there = np.array([[0.1, 0.2, 0.9], [0.5, 0.5, 0.0]])
    engine.mirror(np.array([0, 1]), there, np.array([0.3, 1.0]), np.zeros((2, 3)))
    fly(engine, [[np.nan] * 4] * 2, 0.1)
    np.testing.assert_array_equal(engine.position, there)
    np.testing.assert_allclose(engine.attitude[:, 3], np.sin([0.15, 0.5]))
    assert engine.touches() == []


def twin(robots, nature=None):
    names = tuple(robots)
    experiment = Experiment(
        title="Drones", robots=robots, duration_s=1.0, disturbance=nature or {}, world=World(engine="mujoco")
    )
    return TwinBody(bodies.body_request(experiment, names, (3,)), bodies.shared_world(experiment, names))


@pytest.mark.slow
def test_hover_jitter_is_flown():
    robots = {f"F{k}": Robot(kind="crazyflie", start=[0.0, 0.0], hover=0.5) for k in range(12)}
    body = twin(robots, {"all": Disturbance(hover_jitter=Jitter(0.01, 0.5))})
    rows = np.arange(12)
    body.read(0.0)
    body.takeoff(rows, np.full(12, 0.5))
    states = [body.read(tick * DT) for tick in range(1, 3000)][500:]
    x = np.array([state.true_position[:, :2] for state in states])
    assert x.std(axis=0).mean() == pytest.approx(0.010, rel=0.08)
    share = (x[:-50] * x[50:]).mean() / (x * x).mean()
    assert 0.36 < share < 0.62  # after 0.5 s; 1/e would be without the drone's inertia
    lean = np.degrees(2.0 * np.abs(np.array([state.attitude[:, 1:3] for state in states]))).std()
    assert 0.1 < lean < 1.0  # it leans for it
    assert 0.5 < TRACKED_SHARE < 1.0


def test_ground_robots_drive_as_in_the_point_mass_engine():
    body = twin(
        {"K": Robot(kind="khepera4", start=[0.0, 0.0]), "F": Robot(kind="crazyflie", start=[0.0, 0.0], hover=0.5)}
    )
    experiment = Experiment(title="K", robots={"K": Robot(kind="khepera4", start=[0.0, 0.0])}, duration_s=1.0)
    plain = TwinBody(bodies.body_request(experiment, ("K",), (3,)))
    for tick in range(100):
        state, other = body.read(tick * DT), plain.read(tick * DT)
        body.command(np.array([[0.2, 0.5, 0.0, 0.0], [np.nan] * 4]))
        plain.command(np.array([[0.2, 0.5, 0.0, 0.0]]))
    np.testing.assert_array_equal(state.true_position[:1], other.true_position)
    assert np.isfinite(state.attitude).all()


def test_without_the_library_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(BodyError, match="mujoco-core"):
        RigidBody().build(stage())


def test_the_drones_are_what_the_engine_flies():
    engine = RigidBody().build(stage())
    assert isinstance(engine.quadrotor, Drones)


@pytest.mark.slow
@pytest.mark.nightly
def test_drones_hunt_with_the_gain_of_wheels():
    park = document.read("robotic-park").cases()["periodic"]
    links = Plan(park).links
    error = {}
    for gain in (1.0, 3.0):
        formed = {
            pair: msgspec.structs.replace(link, gain=gain) if isinstance(link, Link) else link
            for pair, link in park.formation.links.items()
        }
        formation = msgspec.structs.replace(park.formation, links=formed)
        parts = {"formation": formation, "world": World(engine="mujoco"), "duration_s": 20.0, "timeline": []}
        log = simulate(msgspec.structs.replace(park, **parts), (1,))
        place = log.true_position[(log.time > 15.0) & (log.time < 20.0)]
        apart = np.linalg.norm(place[:, links.receiver] - place[:, links.sender], axis=2)
        error[gain] = np.abs(apart - links.distance).mean()
    assert error[1.0] < 0.02
    assert error[3.0] > 0.025


def test_a_kind_without_an_airframe_is_refused_with_its_table(monkeypatch):
    drone = replace(CRAZYFLIE, name="mine")
    monkeypatch.setitem(RESPONSES, "mine", RESPONSES["crazyflie"])
    with pytest.raises(BodyError, match="no airframe of 'mine'; add it to AIRFRAMES"):
        RigidBody().build(stage((drone,)))
