"""The pymunk engine: the point-mass engine where nothing touches, rigid bodies where robots do."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from agents.body.interface import BodyError
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.omni import OMNI
from agents.kinds.tello import TELLO
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.plugins import registry
from tests.twins.planar_drive import DT, Drive, columns, command, furnished, stage
from twins.engines.point_mass import PointMass
from twins.engines.pymunk_engine import Planar

# without contact


@pytest.mark.slow
def test_no_contact_is_point_mass_engine():
    kinds = (CRAZYFLIE, TELLO, KHEPERA4, TURTLEBOT3, CRAZYFLIE)
    start = np.array([[0, 0], [9, 0], [18, 0], [0, 9], [9, 9]])
    place = stage(kinds, start, np.linspace(-2, 2, 5))
    one, other = engines = PointMass().build(place), Planar().build(place)
    rng = np.random.default_rng(5)
    jitter, aloft = np.zeros((5, 2)), [row for row, kind in enumerate(kinds) if kind.flies]
    for k in range(1500):
        if k == 5:
            for engine in engines:
                engine.takeoff(aloft, [0.5, 0.8, 1.0])
        if k >= 300 and k % 10 == 0:
            setpoints = np.zeros((5, 4))
            setpoints[:, :2] = start + 0.15 * np.sin([k / 200.0, k / 300.0])
            setpoints[:, 2:] = [0.9, math.sin(k / 100.0)]
            setpoints[1] = [0.2 * math.sin(k / 150.0), 0.1, 0.05, 0.3]
            setpoints[2:4] = [[0.25, rng.normal(), 0, 0], [0.2, rng.normal(), 0, 0]]
            for engine in engines:
                command(engine, setpoints)
        jitter = 0.98 * jitter + 0.002 * rng.standard_normal((5, 2))
        share = np.minimum(columns(one, "position")[:, 2] / 0.2, 1.0)
        for engine in engines:
            engine.advance(k * DT, [tuple(each) for each in (share[:, None] * jitter).tolist()])
        for name in ("position", "velocity", "yaw", "flying"):
            np.testing.assert_allclose(columns(other, name), columns(one, name), atol=1e-10)
    assert np.linalg.norm(columns(other, "position")[:, :2] - start, axis=1).min() > 0.05
    for engine in engines:
        engine.land(range(5))
    for _ in range(600):
        for engine in engines:
            engine.advance(0.0, [(0.0, 0.0)] * 5)
        np.testing.assert_allclose(columns(other, "position"), columns(one, "position"), atol=1e-4)
    assert not any(columns(engine, "flying").any() for engine in engines)
    np.testing.assert_allclose(columns(other, "velocity"), 0.0, atol=1e-9)


def test_tilt_limits_acceleration():
    drive = Drive([CRAZYFLIE], [[0, 0, 1]])
    drive.go(2.0, [[9, 9, 1, 0]])
    speeds = []
    for _ in range(50):
        drive.go(DT, [[-9, -9, 1, 0]])
        speeds.append(drive.velocity[0, :2])
    change = np.linalg.norm(np.diff(speeds, axis=0), axis=1) / DT
    assert change.max() == pytest.approx(9.81 * math.tan(math.radians(20.0)), rel=1e-9)


def test_wheels_slip_beyond_their_grip():
    drive = Drive([KHEPERA4], [[0, 0]], traction=0.1)
    drive.go(0.1, [[0.27, 0, 0, 0]])
    assert drive.velocity[0, 0] == pytest.approx(0.1 * 9.81 * 0.1, rel=0.02)


def test_stopped_quadrotor_falls_and_stands():
    drive = Drive([CRAZYFLIE], [[0, 0, 1]])
    drive.go(1.0, [[9, 0, 1, 0]])
    drive.engine.stop([0])
    drive.go(0.3)
    speed = drive.velocity[0, 0]
    assert speed > 0.8
    drive.go(2.0)
    assert drive.position[0, 2] == 0.0
    assert drive.velocity[0, 0] == pytest.approx(0.0, abs=1e-9)


# robots against robots


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3])
@pytest.mark.parametrize("aside", [0.0, 0.5, 1.2])
def test_two_robots_collide_without_overlap(kind, aside):
    offset = aside * kind.radius
    drive = Drive([kind, kind], [[-0.5, 0], [0.5, offset]], [0.0, math.pi])
    drive.go(4.0, [[kind.speed, 0, 0, 0]] * 2)
    assert drive.overlap(0, 1) < 1e-3
    first = drive.touches[0]
    assert drive.pairs[0] == (0, 1)
    assert first.overlap < 1e-3
    gap = 1.0 * math.cos(math.asin(offset / 1.0)) if offset else 1.0
    assert first.time == pytest.approx((gap - 2 * kind.radius) / (2 * kind.speed), abs=0.2)
    if aside == 0.0:
        assert len(drive.touches) == 1
        mass = kind.mass
        # reduced mass × closing speed × (1 + restitution), and what the wheels push in that step
        blow = 0.5 * mass * 2.0 * kind.speed * 1.1
        assert blow * 0.999 < first.impulse < 1.001 * (blow + 0.7 * mass * 9.81 * 0.005)
        np.testing.assert_allclose(drive.velocity[:, 0], 0.0, atol=1e-3)
        apart = drive.position[1, 0] - drive.position[0, 0]
        assert apart == pytest.approx(2 * kind.radius, abs=2e-4)


def test_contact_counts_once_until_they_part():
    drive = Drive([TURTLEBOT3, KHEPERA4], [[0, 0], [0.4, 0]], [0.0, math.pi / 2])
    drive.go(6.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert len(drive.touches) == 1
    drive.go(1.0, [[-0.2, 0, 0, 0], [0, 0, 0, 0]])
    drive.go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert len(drive.touches) == 2
    assert drive.touches[1].time > 7.0


def test_heavier_robot_pushes_the_lighter():
    across = math.pi / 2  # sideways the pushed one's wheels cannot roll: it is dragged
    pushes = Drive([TURTLEBOT3, KHEPERA4], [[0, 0], [0.4, 0]], [0.0, across])
    pushes.go(5.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert pushes.position[1, 0] > 1.0
    assert pushes.velocity[1, 0] == pytest.approx(0.2, abs=2e-3)
    stuck = Drive([KHEPERA4, TURTLEBOT3], [[0, 0], [0.4, 0]], [0.0, across])
    stuck.go(5.0, [[0.25, 0, 0, 0], [0, 0, 0, 0]])
    assert stuck.position[1, 0] == pytest.approx(0.4, abs=2e-3)  # the blow itself moves it a little
    assert stuck.velocity[0, 0] == pytest.approx(0.0, abs=1e-3)


def test_blow_in_the_air_conserves_momentum():
    drive = Drive([CRAZYFLIE, TELLO], [[0, 0, 1.0], [1.2, 0, 1.0]], restitution=0.5)
    mass = np.array([CRAZYFLIE.mass, TELLO.mass])
    while not drive.touches:
        before = drive.velocity[:, 0]
        drive.go(DT, [[5, 0, 1, 0], [-0.5, 0, 0, 0]])
    after = drive.velocity[:, 0]
    steered = 3.6 * DT * mass.sum()
    assert mass @ after == pytest.approx(mass @ before, abs=steered)
    assert mass @ after**2 < mass @ before**2
    assert after[1] - after[0] == pytest.approx(0.5 * (before[0] - before[1]), abs=0.08)
    reduced = mass.prod() / mass.sum()
    assert drive.touches[0].impulse == pytest.approx(1.5 * reduced * (before[0] - before[1]), rel=0.1)
    assert drive.overlap(0, 1) < 1e-3


def test_crowd_is_reproducible_and_does_not_overlap():
    ends = []
    grid = 0.25 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2) - 0.375
    for _ in range(2):
        drive = Drive([TURTLEBOT3, KHEPERA4, KHEPERA4, KHEPERA4] * 4 + [CRAZYFLIE], [*grid, (0.9, 0.9)])
        drive.engine.takeoff([16], [0.05])
        rng = np.random.default_rng(4)
        for _ in range(40):
            x, y, _ = drive.position.T
            turn = 2.0 * np.sin(np.arctan2(-y, -x) - columns(drive.engine, "yaw")) + rng.normal(size=17)
            setpoints = np.column_stack([np.full(17, 0.2), turn, np.zeros((17, 2))])
            setpoints[16] = [0.0, 0.0, 0.05, 0.0]
            drive.go(0.1, setpoints)
        ends.append((drive.position.tolist(), columns(drive.engine, "yaw").tolist(), drive.touches))
    assert ends[0] == ends[1]
    assert len(drive.touches) > 15
    assert max(drive.overlap(a, b) for a in range(16) for b in range(a)) < 1e-3


# walls and obstacles


@pytest.mark.parametrize(
    "obstacle",
    [
        {"box": (0.2, 1.0), "at": (0.6, 0.0)},
        {"box": (0.2, 1.0), "at": (0.6, 0.0), "yaw": math.pi},
        {"radius": 0.1, "at": (0.6, 0.0)},
        {"wall": [(0.0, -1.0), (0.0, 0.02), (0.0, 1.0)], "at": (0.5, 0.0)},
    ],
)
@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3])
def test_obstacle_stops_robot_at_its_edge(obstacle, kind):
    drive = Drive([kind], [[0, 0]], scene=furnished({"it": obstacle}))
    drive.go(5.0, [[kind.speed, 0, 0, 0]])
    x = np.array(drive.path)[:, 0, 0]
    assert x.max() < 0.5 - kind.radius + 1e-3
    assert x[-1] == pytest.approx(0.5 - kind.radius, abs=2e-4)
    assert drive.velocity[0, 0] == pytest.approx(0.0, abs=1e-3)
    assert drive.pairs == [(0, -1)]


# orders and parameters


def test_placed_robot_is_at_rest():
    drive = Drive([KHEPERA4, TURTLEBOT3], [[0, 0], [0.4, 0]], [0, math.pi])
    drive.go(2.0, [[0.2, 0, 0, 0]] * 2)
    assert len(drive.touches) == 1
    drive.put(0, (3.0, 2.0, 0.0), 1.0)
    np.testing.assert_array_equal(drive.position[0], [3.0, 2.0, 0.0])
    drive.go(1.0, [[np.nan] * 4, [0.0] * 4])
    np.testing.assert_allclose(drive.position[0], [3.0, 2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(drive.velocity[0], 0.0, atol=1e-12)
    assert drive.engine.motions[0].yaw == pytest.approx(1.0, abs=1e-12)
    drive.put(0, (0.0, 0.0, 0.0))
    drive.go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert len(drive.touches) == 2


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        (replace(KHEPERA4, name="hovercraft", motion=None), "no twin of 'hovercraft'"),
        (OMNI, "'omni' does not move in this engine, which carries Wheels, Flight"),
    ],
)
def test_kind_of_another_motion_is_refused(kind, why):
    with pytest.raises(BodyError, match=why):
        Planar().build(stage([kind], [[0, 0]]))


def test_engine_has_a_name_and_checked_parameters():
    assert registry.build(registry.ENGINES, "pymunk") == Planar()
    steps = [Planar().build(stage([KHEPERA4], [[0, 0]], dt=dt)).steps for dt in (0.02, 0.01, 0.004)]
    assert steps == [4, 2, 1]  # each of 5 ms at most
    for name, value in (("restitution", 2.0), ("step_s", 0.0)):
        with pytest.raises(msgspec.ValidationError, match=name):
            registry.build(registry.ENGINES, {"kind": "pymunk", name: value})
