"""Robots in the planar engine among obstacles, walls, things that stand below them, and robots that are mirrored."""

import math

import numpy as np
import pytest

from agents.body.kinds import CRAZYFLIE, KHEPERA4, TELLO, TURTLEBOT3
from agents.plugins.planners import Line
from tests.twins.planar_drive import DT, Drive, furnished, stage, still


def test_the_arena_has_walls_if_it_is_walled():
    obstacles = {"far": {"radius": 0.1, "at": (-1.5, -1.5)}}
    open_room = Drive(stage([KHEPERA4], [[1, 0]], scene=furnished(obstacles)))
    open_room.go(6.0, [[0.27, 0, 0, 0]])
    assert open_room.engine.position[0, 0] > 2.2
    assert not open_room.touches
    for yaw in (0.0, 0.4):
        drive = Drive(stage([KHEPERA4], [[1, 0]], [yaw], scene=furnished(obstacles, walled=True)))
        drive.go(15.0, [[0.27, 0, 0, 0]])
        assert np.array(drive.path)[:, 0, :2].max() < 2.0 - KHEPERA4.radius + 1e-3
        assert (drive.touches[0].first, drive.touches[0].second) == (0, -2)
    path = np.array(drive.path)[:, 0]
    slides = path[-1, 1] - path[round(drive.touches[0].time / DT), 1]
    assert slides > 0.2  # a slanting one is dragged along, across its wheels


def test_a_flying_robot_stops_at_a_wall_with_its_wobble():
    scene = furnished({}, size=(2.0, 2.0, 3.0), walled=True)
    drive = Drive(stage([CRAZYFLIE], [[0, 0]], scene=scene)).aloft([[0, 0, 1]])
    rng = np.random.default_rng(2)
    jitter, xs = np.zeros((1, 2)), []
    for k in range(1000):
        jitter = 0.98 * jitter + 0.002 * rng.standard_normal((1, 2))
        drive.engine.command(np.array([[2.0, 0, 1, 0]]))
        drive.engine.advance(k * DT, jitter)
        xs.append(drive.engine.position[0, 0])
    assert max(xs) < 1.0 - CRAZYFLIE.radius + 1e-3
    assert xs[-1] > 1.0 - CRAZYFLIE.radius - 0.02


def test_a_moving_obstacle_pushes_a_robot():
    plan = Line(move_by=(1.0, 0.0), speed_=0.2)
    scene = furnished({"car": {"box": (0.2, 0.6), "at": (-0.5, 0.0)}}, {"car": plan})
    drive = Drive(stage([KHEPERA4], [[0, 0]], [math.pi / 2], scene=scene))
    drive.go(10.0, still(1))
    np.testing.assert_allclose(drive.engine.obstacles[0, 0], scene.at(10.0)[0], atol=1e-9)
    assert drive.engine.obstacles[0, 0, 0] == pytest.approx(0.5)
    front = 0.5 + 0.1 + KHEPERA4.radius
    assert front - 1e-3 < drive.engine.position[0, 0] < front + 0.02
    assert [(touch.first, touch.second) for touch in drive.touches] == [(0, -1)]
    assert drive.touches[0].time == pytest.approx((0.4 - KHEPERA4.radius) / 0.2, abs=0.1)


def test_a_box_can_be_pushed_and_comes_to_rest_and_a_heavy_one_stays():
    scene = furnished({"box": {"box": (0.3, 0.3), "at": (0.4, 0.0), "mass": 0.5, "friction": 0.4}})
    drive = Drive(stage([TURTLEBOT3], [[0, 0]], scene=scene))
    drive.go(5.0, [[0.2, 0, 0, 0]])
    pushed = drive.engine.obstacles[0, 0].copy()
    assert pushed[0] == pytest.approx(drive.engine.position[0, 0] + TURTLEBOT3.radius + 0.15, abs=2e-3)
    assert pushed[0] > 1.1
    drive.go(1.0, still(1))
    rest = drive.engine.obstacles[0, 0].copy()
    assert rest[0] - pushed[0] < 0.2**2 / (2 * 2.0) + 3e-3  # the robot's own way to a halt
    drive.go(2.0, [[-0.2, 0, 0, 0]])
    np.testing.assert_array_equal(drive.engine.obstacles[0, 0], rest)
    heavy = furnished({"box": {"box": (0.3, 0.3), "at": (0.4, 0.0), "mass": 5.0, "friction": 0.4}})
    drive = Drive(stage([TURTLEBOT3], [[0, 0]], scene=heavy))
    drive.go(5.0, [[0.2, 0, 0, 0]])
    assert drive.engine.obstacles[0, 0, 0] == pytest.approx(0.4, abs=1e-3)
    assert drive.engine.velocity[0, 0] == pytest.approx(0.0, abs=1e-3)


def test_a_pushed_box_slides_as_far_as_friction_lets_it():
    # set off at 0.5 m/s by what hits it; then v² / (2 μ g)
    scene = furnished({"disc": {"radius": 0.1, "at": (0.5, 0.0), "mass": 0.2, "friction": 0.3}})
    drive = Drive(stage([TELLO], [[0, 0]], scene=scene), restitution=1.0)
    drive.aloft([[0, 0, 0.5]])
    while not drive.touches:
        drive.go(DT, [[1.0, 0, 0, 0]])
    start, begin = drive.engine.obstacles[0, 0, 0], drive.path[-2][0, 0]
    drive.go(DT, [[-1.0, 0, 0, 0]])
    speed = (drive.engine.obstacles[0, 0, 0] - start) / DT + 0.5 * 0.3 * 9.81 * DT
    drive.go(2.0, [[-1.0, 0, 0, 0]])
    assert begin < 0.3
    assert drive.engine.obstacles[0, 0, 0] - start == pytest.approx(speed**2 / (2 * 0.3 * 9.81), rel=0.15)


def test_a_box_pushed_askew_comes_to_lie_flush_against_a_wall():
    box = {"box": (0.2, 0.2), "at": (0.5, 0.0), "yaw": 0.2, "mass": 0.3, "friction": 0.3}
    wall = {"box": (0.2, 2.0), "at": (1.1, 0.0)}
    drive = Drive(stage([TURTLEBOT3], [[0, 0]], scene=furnished({"box": box, "wall": wall})))
    drive.go(10.0, [[0.2, 0, 0, 0]])
    x, _, yaw = drive.engine.obstacles[0, 0]
    assert yaw == pytest.approx(0.0, abs=0.01)
    assert x == pytest.approx(1.0 - 0.1, abs=2e-3)
    assert drive.engine.position[0, 0] == pytest.approx(0.8 - TURTLEBOT3.radius, abs=3e-3)


# layers


def test_a_flying_robot_passes_over_a_ground_robot_and_not_through_it():
    for height, meets in ((0.5, False), (0.22, False), (0.15, True)):
        drive = Drive(stage([CRAZYFLIE, TURTLEBOT3], [[-1, 0], [0, 0]])).aloft([[-1, 0, height]])
        drive.go(4.0, [[1, 0, height, 0], [0, 0, 0, 0]])
        assert bool(drive.touches) == meets
        if meets:
            assert drive.overlap(0, 1) < 1e-3
        else:
            assert drive.engine.position[0, 0] == pytest.approx(1.0, abs=0.01)


def test_an_obstacle_is_as_high_as_it_is():
    beam = {"box": (0.2, 2.0), "at": (0.5, 0.0), "bottom": 0.4, "height": 0.2}
    for height, meets in ((0.3, False), (0.5, True), (0.7, False)):
        scene = furnished({"beam": beam})
        drive = Drive(stage([CRAZYFLIE, KHEPERA4], [[0, 0], [0, 0.5]], scene=scene)).aloft([[0, 0, height]])
        drive.go(6.0, [[1.2, 0, height, 0], [0.25, 0, 0, 0]])
        assert drive.engine.position[1, 0] > 1.0
        assert {touch.second for touch in drive.touches} == ({-1} if meets else set())
        assert (drive.engine.position[0, 0] > 1.0) != meets


@pytest.mark.parametrize("base", [KHEPERA4, TURTLEBOT3])
def test_what_lands_on_a_robot_slides_off_it(base):
    drive = Drive(stage([CRAZYFLIE, base], [[0.02, 0.01], [0, 0]])).aloft([[0.02, 0.01, 0.6]])
    drive.go(1.0, [[0.02, 0.01, 0.6, 0], [0, 0, 0, 0]])
    assert not drive.touches
    drive.engine.land(np.array([0]))
    drive.go(6.0, np.full((2, 4), np.nan))
    assert (drive.touches[0].first, drive.touches[0].second) == (0, 1)
    assert not drive.engine.flying[0]
    assert drive.engine.position[0, 2] == 0.0
    apart = np.linalg.norm(drive.engine.position[0, :2] - drive.engine.position[1, :2])
    assert apart > base.radius + CRAZYFLIE.radius - 1e-3
    path = np.array(drive.path)
    speed = np.linalg.norm(np.diff(path[:, 0, :2], axis=0), axis=1) / DT
    assert speed.max() < 1.0
    assert np.linalg.norm(path[-1, 1, :2]) < 0.02  # the heavy one hardly moves


def test_a_landed_quadrotor_is_pushed_and_not_climbed():
    drive = Drive(stage([KHEPERA4, CRAZYFLIE], [[0, 0], [0.4, 0]]))
    drive.go(4.0, [[0.2, 0, 0, 0], [np.nan] * 4])
    assert drive.engine.position[1, 0] > 0.8
    assert drive.overlap(0, 1) < 1e-3


# rows that are elsewhere


def test_a_mirrored_robot_stops_a_twin_and_is_not_pushed():
    drive = Drive(stage([TURTLEBOT3, KHEPERA4], [[0, 0], [0.5, 0]], mirrored=[False, True]))
    engine = drive.engine
    assert np.isnan(engine.position[1]).all()
    there = np.array([[0.5, 0.0, 0.0]])
    for _ in range(500):
        engine.mirror(np.array([1]), there, np.array([0.3]), np.zeros((1, 3)))
        drive.go(DT, [[0.2, 0, 0, 0], [0.2, 0, 0, 0]])
    np.testing.assert_array_equal(engine.position[1], there[0])
    assert engine.yaw[1] == 0.3
    assert engine.position[0, 0] == pytest.approx(0.5 - TURTLEBOT3.radius - KHEPERA4.radius, abs=2e-4)
    assert [(touch.first, touch.second) for touch in drive.touches] == [(0, 1)]
    engine.mirror(np.array([1]), np.full((1, 3), np.nan), np.array([np.nan]), np.full((1, 3), np.nan))
    drive.go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert engine.position[0, 0] > 0.85


def test_a_mirrored_robot_pushes_with_the_speed_that_it_has():
    drive = Drive(stage([KHEPERA4, TURTLEBOT3], [[0.3, 0], [0, 0]], [math.pi / 2, 0], mirrored=[False, True]))
    x = 0.0
    for _ in range(300):
        x += 0.2 * DT
        drive.engine.mirror(np.array([1]), np.array([[x, 0, 0]]), np.zeros(1), np.array([[0.2, 0, 0]]))
        drive.go(DT, still(2))
    assert drive.overlap(0, 1) < 1e-3
    assert drive.engine.position[0, 0] == pytest.approx(x + TURTLEBOT3.radius + KHEPERA4.radius, abs=5e-3)
    assert len(drive.touches) == 1


def test_a_mirrored_quadrotor_is_met_only_at_its_height():
    for height, meets in ((0.05, True), (0.5, False)):
        drive = Drive(stage([KHEPERA4, CRAZYFLIE], [[0, 0], [0.4, 0]], mirrored=[False, True]))
        drive.engine.mirror(np.array([1]), np.array([[0.4, 0, height]]), np.zeros(1), np.zeros((1, 3)))
        drive.go(4.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
        assert bool(drive.touches) == meets


def test_a_mirrored_quadrotor_that_is_not_there_disturbs_nobody():
    drive = Drive(stage([CRAZYFLIE, CRAZYFLIE, KHEPERA4], [[0, 0], [1, 0], [2, 0]], mirrored=[False, True, False]))
    alone = Drive(stage([CRAZYFLIE, KHEPERA4], [[0, 0], [2, 0]]))
    for each in (drive, alone):
        each.engine.takeoff(np.array([0]), np.array([0.5]))
    for k in range(300):
        wobble = np.array([[0.01 * math.sin(k / 9.0), 0.0], [np.nan, np.nan], [0.0, 0.0]])
        drive.engine.command(np.array([[np.nan] * 4, [np.nan] * 4, [0.1, 0.2, 0, 0]]))
        alone.engine.command(np.array([[np.nan] * 4, [0.1, 0.2, 0, 0]]))
        drive.engine.advance(k * DT, wobble)
        alone.engine.advance(k * DT, wobble[[0, 2]])
    np.testing.assert_array_equal(drive.engine.position[[0, 2]], alone.engine.position)
    assert drive.engine.position[0, 2] > 0.3
    drive.engine.mirror(np.array([1]), np.array([[1.0, 0.0, 0.5]]), np.zeros(1), np.zeros((1, 3)))
    drive.engine.advance(3.0, wobble)
    np.testing.assert_array_equal(drive.engine.position[1], [1.0, 0.0, 0.5])
