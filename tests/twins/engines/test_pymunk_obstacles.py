"""Robots in the planar engine among obstacles, walls, things that stand below them, and robots that are mirrored."""

import math

import numpy as np
import pytest

from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.tello import TELLO
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.plugins.planners import Line
from agents.vectors import UNKNOWN
from tests.twins.planar_drive import DT, Drive, command, furnished, still


def test_walled_arena_has_walls():
    obstacles = {"far": {"radius": 0.1, "at": (-1.5, -1.5)}}
    open_room = Drive([KHEPERA4], [[1, 0]], scene=furnished(obstacles))
    open_room.go(6.0, [[0.27, 0, 0, 0]])
    assert open_room.position[0, 0] > 2.2
    assert not open_room.touches
    for yaw in (0.0, 0.4):
        drive = Drive([KHEPERA4], [[1, 0]], [yaw], scene=furnished(obstacles, walled=True))
        drive.go(15.0, [[0.27, 0, 0, 0]])
        assert np.array(drive.path)[:, 0, :2].max() < 2.0 - KHEPERA4.radius + 1e-3
        assert drive.pairs[0] == (0, -2)
    path = np.array(drive.path)[:, 0]
    slides = path[-1, 1] - path[round(drive.touches[0].time / DT), 1]
    assert slides > 0.2  # a slanting one is dragged along, across its wheels


def test_wobbling_drone_stops_at_a_wall():
    scene = furnished({}, size=(2.0, 2.0, 3.0), walled=True)
    drive = Drive([CRAZYFLIE], [[0, 0, 1]], scene=scene)
    rng = np.random.default_rng(2)
    jitter, xs = np.zeros((1, 2)), []
    for k in range(1000):
        jitter = 0.98 * jitter + 0.002 * rng.standard_normal((1, 2))
        command(drive.engine, [[2.0, 0, 1, 0]])
        drive.engine.advance(k * DT, [tuple(jitter[0].tolist())])
        xs.append(drive.position[0, 0])
    assert max(xs) < 1.0 - CRAZYFLIE.radius + 1e-3
    assert xs[-1] > 1.0 - CRAZYFLIE.radius - 0.02


def test_moving_obstacle_pushes_a_robot():
    plan = Line(move_by=(1.0, 0.0), speed_=0.2)
    scene = furnished({"car": {"box": (0.2, 0.6), "at": (-0.5, 0.0)}}, {"car": plan})
    drive = Drive([KHEPERA4], [[0, 0]], [math.pi / 2], scene=scene)
    drive.go(10.0, still(1))
    np.testing.assert_allclose(drive.obstacles[0], scene.at(10.0)[0], atol=1e-9)
    assert drive.obstacles[0, 0] == pytest.approx(0.5)
    front = 0.5 + 0.1 + KHEPERA4.radius
    assert front - 1e-3 < drive.position[0, 0] < front + 0.02
    assert drive.pairs == [(0, -1)]
    assert drive.touches[0].time == pytest.approx((0.4 - KHEPERA4.radius) / 0.2, abs=0.1)


def test_light_box_is_pushed_heavy_box_stays():
    scene = furnished({"box": {"box": (0.3, 0.3), "at": (0.4, 0.0), "mass": 0.5, "friction": 0.4}})
    drive = Drive([TURTLEBOT3], [[0, 0]], scene=scene)
    drive.go(5.0, [[0.2, 0, 0, 0]])
    pushed = drive.obstacles[0]
    assert pushed[0] == pytest.approx(drive.position[0, 0] + TURTLEBOT3.radius + 0.15, abs=2e-3)
    assert pushed[0] > 1.1
    drive.go(1.0, still(1))
    rest = drive.obstacles[0]
    assert rest[0] - pushed[0] < 0.2**2 / (2 * 2.0) + 3e-3  # the robot's own way to a halt
    drive.go(2.0, [[-0.2, 0, 0, 0]])
    np.testing.assert_array_equal(drive.obstacles[0], rest)
    heavy = furnished({"box": {"box": (0.3, 0.3), "at": (0.4, 0.0), "mass": 5.0, "friction": 0.4}})
    drive = Drive([TURTLEBOT3], [[0, 0]], scene=heavy)
    drive.go(5.0, [[0.2, 0, 0, 0]])
    assert drive.obstacles[0, 0] == pytest.approx(0.4, abs=1e-3)
    assert drive.velocity[0, 0] == pytest.approx(0.0, abs=1e-3)


def test_pushed_box_slides_against_friction():
    # set off at 0.5 m/s by what hits it; then v² / (2 μ g)
    scene = furnished({"disc": {"radius": 0.1, "at": (0.5, 0.0), "mass": 0.2, "friction": 0.3}})
    drive = Drive([TELLO], [[0, 0, 0.5]], scene=scene, restitution=1.0)
    while not drive.touches:
        drive.go(DT, [[1.0, 0, 0, 0]])
    start, begin = drive.obstacles[0, 0], drive.path[-2][0, 0]
    drive.go(DT, [[-1.0, 0, 0, 0]])
    speed = (drive.obstacles[0, 0] - start) / DT + 0.5 * 0.3 * 9.81 * DT
    drive.go(2.0, [[-1.0, 0, 0, 0]])
    assert begin < 0.3
    assert drive.obstacles[0, 0] - start == pytest.approx(speed**2 / (2 * 0.3 * 9.81), rel=0.15)


def test_askew_box_comes_to_lie_flush():
    box = {"box": (0.2, 0.2), "at": (0.5, 0.0), "yaw": 0.2, "mass": 0.3, "friction": 0.3}
    wall = {"box": (0.2, 2.0), "at": (1.1, 0.0)}
    drive = Drive([TURTLEBOT3], [[0, 0]], scene=furnished({"box": box, "wall": wall}))
    drive.go(10.0, [[0.2, 0, 0, 0]])
    x, _, yaw = drive.obstacles[0]
    assert yaw == pytest.approx(0.0, abs=0.01)
    assert x == pytest.approx(1.0 - 0.1, abs=2e-3)
    assert drive.position[0, 0] == pytest.approx(0.8 - TURTLEBOT3.radius, abs=3e-3)


# layers


def test_drone_passes_over_ground_robot():
    for height, meets in ((0.5, False), (0.22, False), (0.15, True)):
        drive = Drive([CRAZYFLIE, TURTLEBOT3], [[-1, 0, height], [0, 0]])
        drive.go(4.0, [[1, 0, height, 0], [0, 0, 0, 0]])
        assert bool(drive.touches) == meets
        if meets:
            assert drive.overlap(0, 1) < 1e-3
        else:
            assert drive.position[0, 0] == pytest.approx(1.0, abs=0.01)


def test_obstacle_is_met_at_its_height():
    beam = {"box": (0.2, 2.0), "at": (0.5, 0.0), "bottom": 0.4, "height": 0.2}
    for height, meets in ((0.3, False), (0.5, True), (0.7, False)):
        scene = furnished({"beam": beam})
        drive = Drive([CRAZYFLIE, KHEPERA4], [[0, 0, height], [0, 0.5]], scene=scene)
        drive.go(6.0, [[1.2, 0, height, 0], [0.25, 0, 0, 0]])
        assert drive.position[1, 0] > 1.0
        assert {touch.second for touch in drive.touches} == ({-1} if meets else set())
        assert (drive.position[0, 0] > 1.0) != meets


@pytest.mark.parametrize("base", [KHEPERA4, TURTLEBOT3])
def test_landing_on_a_robot_slides_off(base):
    drive = Drive([CRAZYFLIE, base], [[0.02, 0.01, 0.6], [0, 0]])
    drive.go(1.0, [[0.02, 0.01, 0.6, 0], [0, 0, 0, 0]])
    assert not drive.touches
    drive.engine.land([0])
    drive.go(6.0, np.full((2, 4), np.nan))
    assert drive.pairs[0] == (0, 1)
    assert not drive.engine.motions[0].flying
    assert drive.position[0, 2] == 0.0
    assert math.dist(*drive.position[:, :2]) > base.radius + CRAZYFLIE.radius - 1e-3
    path = np.array(drive.path)
    speed = np.linalg.norm(np.diff(path[:, 0, :2], axis=0), axis=1) / DT
    assert speed.max() < 1.0
    assert np.linalg.norm(path[-1, 1, :2]) < 0.02  # the heavy one hardly moves


def test_landed_quadrotor_is_pushed():
    drive = Drive([KHEPERA4, CRAZYFLIE], [[0, 0], [0.4, 0]])
    drive.go(4.0, [[0.2, 0, 0, 0], [np.nan] * 4])
    assert drive.position[1, 0] > 0.8
    assert drive.overlap(0, 1) < 1e-3


# rows that are elsewhere


def test_mirrored_robot_is_not_pushed():
    drive = Drive([TURTLEBOT3, KHEPERA4], [[0, 0], [0.5, 0]], mirrored=[False, True])
    assert np.isnan(drive.position[1]).all()
    for _ in range(500):
        drive.mirror(1, (0.5, 0.0, 0.0), 0.3)
        drive.go(DT, [[0.2, 0, 0, 0], [0.2, 0, 0, 0]])
    mirrored = drive.engine.motions[1]
    assert (mirrored.position, mirrored.yaw) == ((0.5, 0.0, 0.0), 0.3)
    assert drive.position[0, 0] == pytest.approx(0.5 - TURTLEBOT3.radius - KHEPERA4.radius, abs=2e-4)
    assert drive.pairs == [(0, 1)]
    drive.mirror(1, UNKNOWN, math.nan, UNKNOWN)
    drive.go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert drive.position[0, 0] > 0.85


def test_mirrored_robot_pushes_with_its_speed():
    drive = Drive([KHEPERA4, TURTLEBOT3], [[0.3, 0], [0, 0]], [math.pi / 2, 0], mirrored=[False, True])
    x = 0.0
    for _ in range(300):
        x += 0.2 * DT
        drive.mirror(1, (x, 0.0, 0.0), 0.0, (0.2, 0.0, 0.0))
        drive.go(DT, still(2))
    assert drive.overlap(0, 1) < 1e-3
    assert drive.position[0, 0] == pytest.approx(x + TURTLEBOT3.radius + KHEPERA4.radius, abs=5e-3)
    assert len(drive.touches) == 1


def test_mirrored_quadrotor_is_met_at_its_height():
    for height, meets in ((0.05, True), (0.5, False)):
        drive = Drive([KHEPERA4, CRAZYFLIE], [[0, 0], [0.4, 0]], mirrored=[False, True])
        drive.mirror(1, (0.4, 0.0, height))
        drive.go(4.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
        assert bool(drive.touches) == meets


def test_absent_mirrored_robot_disturbs_nobody():
    drive = Drive([CRAZYFLIE, CRAZYFLIE, KHEPERA4], [[0, 0], [1, 0], [2, 0]], mirrored=[False, True, False])
    alone = Drive([CRAZYFLIE, KHEPERA4], [[0, 0], [2, 0]])
    for each in (drive, alone):
        each.engine.takeoff([0], [0.5])
    absent = (math.nan, math.nan)
    for k in range(300):
        wobble = (0.01 * math.sin(k / 9.0), 0.0)
        command(drive.engine, [[np.nan] * 4, [np.nan] * 4, [0.1, 0.2, 0, 0]])
        command(alone.engine, [[np.nan] * 4, [0.1, 0.2, 0, 0]])
        drive.engine.advance(k * DT, [wobble, absent, (0.0, 0.0)])
        alone.engine.advance(k * DT, [wobble, (0.0, 0.0)])
    np.testing.assert_array_equal(drive.position[[0, 2]], alone.position)
    assert drive.position[0, 2] > 0.3
    drive.mirror(1, (1.0, 0.0, 0.5))
    drive.go(DT)
    assert drive.engine.motions[1].position == (1.0, 0.0, 0.5)
