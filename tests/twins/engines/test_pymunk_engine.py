"""Planar engine: the point-mass engine where nothing touches; robots among robots, obstacles, walls and mirrors."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from agents.body.interface import BodyError
from agents.kinds.omni import OMNI
from agents.plugins import registry
from agents.plugins.planners import Line
from agents.vectors import UNKNOWN
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from tests.twins.planar_drive import DT, Drive, columns, command, furnished, stage
from twins.engines.point_mass import PointMass
from twins.engines.pymunk_engine import Planar


@pytest.mark.slow
def test_no_contact_is_point_mass_engine():
    place = stage((CRAZYFLIE, TELLO, KHEPERA4, TURTLEBOT3), [[0, 0], [9, 0], [18, 0], [0, 9]], np.linspace(-2, 2, 4))
    one, other = engines = PointMass().build(place), Planar().build(place)
    for k in range(1500):
        turn = math.sin(k / 100.0)
        near = [0.15 * math.sin(k / 200.0), 0.15 * math.sin(k / 300.0), 0.9, turn]
        setpoints = [near, [0.2 * turn, 0.1, 0.05, 0.3], [0.25, turn, 0, 0], [0.2, -turn, 0, 0]]
        for engine in engines:
            if k == 5:
                engine.takeoff([0, 1], [0.5, 0.8])
            if k >= 300:
                command(engine, setpoints)
            height = engine.motions[0].position[2]
            engine.advance(k * DT, [(0.02 * min(height / 0.2, 1.0) * math.sin(k / 9.0), 0.0)] + [(0.0, 0.0)] * 3)
        for name in ("position", "velocity", "yaw", "flying"):
            np.testing.assert_allclose(columns(other, name), columns(one, name), atol=1e-10)
    for engine in engines:
        engine.land(range(4))
        for _ in range(600):
            engine.advance(0.0, [(0.0, 0.0)] * 4)
    np.testing.assert_allclose(columns(other, "position"), columns(one, "position"), atol=1e-4)
    assert not any(columns(engine, "flying").any() for engine in engines)


def test_tilt_and_grip_limit_acceleration():
    drive = Drive([CRAZYFLIE], [[0, 0, 1]]).go(2.0, [[9, 9, 1, 0]]).go(0.2, [[-9, -9, 1, 0]])
    before = drive.velocity[0, :2]
    change = np.linalg.norm(drive.go(DT, [[-9, -9, 1, 0]]).velocity[0, :2] - before) / DT
    assert change == pytest.approx(9.81 * math.tan(math.radians(20.0)), rel=1e-9)
    drive = Drive([KHEPERA4], [[0, 0]], traction=0.1).go(0.1, [[0.27, 0, 0, 0]])
    assert drive.velocity[0, 0] == pytest.approx(0.1 * 9.81 * 0.1, rel=0.02)


@pytest.mark.parametrize(("kind", "aside"), [(KHEPERA4, 0.0), (TURTLEBOT3, 0.0), (KHEPERA4, 1.2)])
def test_two_robots_collide_without_overlap(kind, aside):
    offset = aside * kind.radius
    drive = Drive([kind, kind], [[-0.5, 0], [0.5, offset]], [0.0, math.pi])
    drive.go(4.0, [[kind.speed, 0, 0, 0]] * 2)
    assert drive.overlap(0, 1) < 1e-3
    first = drive.touches[0]
    assert drive.pairs[0] == (0, 1)
    assert first.overlap < 1e-3
    assert first.time == pytest.approx((math.cos(math.asin(offset)) - 2 * kind.radius) / (2 * kind.speed), abs=0.2)
    if aside == 0.0:
        assert len(drive.touches) == 1
        # reduced mass × closing speed × (1 + restitution), and what the wheels push in that step
        blow = 0.5 * kind.mass * 2.0 * kind.speed * 1.1
        assert blow * 0.999 < first.impulse < 1.001 * (blow + 0.7 * kind.mass * 9.81 * 0.005)
        np.testing.assert_allclose(drive.velocity[:, 0], 0.0, atol=1e-3)


def test_heavier_robot_pushes_the_lighter():
    across = math.pi / 2  # sideways the pushed one's wheels cannot roll: it is dragged
    pushes = Drive([TURTLEBOT3, KHEPERA4], [[0, 0], [0.4, 0]], [0.0, across])
    pushes.go(5.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert (pushes.position[1, 0] > 1.0, pushes.velocity[1, 0]) == (True, pytest.approx(0.2, abs=2e-3))
    stuck = Drive([KHEPERA4, TURTLEBOT3], [[0, 0], [0.4, 0]], [0.0, across])
    stuck.go(5.0, [[0.25, 0, 0, 0], [0, 0, 0, 0]])
    # the blow itself moves it a little
    assert [stuck.position[1, 0], stuck.velocity[0, 0]] == pytest.approx([0.4, 0.0], abs=2e-3)


def test_blow_in_the_air_conserves_momentum():
    drive = Drive([CRAZYFLIE, TELLO], [[0, 0, 1.0], [1.2, 0, 1.0]], restitution=0.5)
    mass = np.array([CRAZYFLIE.mass, TELLO.mass])
    while not drive.touches:
        before = drive.velocity[:, 0]
        drive.go(DT, [[5, 0, 1, 0], [-0.5, 0, 0, 0]])
    after = drive.velocity[:, 0]
    assert mass @ after == pytest.approx(mass @ before, abs=3.6 * DT * mass.sum())  # both are steered meanwhile
    assert after[1] - after[0] == pytest.approx(0.5 * (before[0] - before[1]), abs=0.08)
    blow = 1.5 * mass.prod() / mass.sum() * (before[0] - before[1])
    assert drive.touches[0].impulse == pytest.approx(blow, rel=0.1)
    assert drive.overlap(0, 1) < 1e-3


@pytest.mark.parametrize(
    "obstacle",
    [
        {"box": (1.0, 0.2), "at": (0.6, 0.0), "yaw": 0.5 * math.pi},
        {"radius": 0.1, "at": (0.6, 0.0)},
        {"wall": [(0.0, -1.0), (0.0, 0.02), (0.0, 1.0)], "at": (0.5, 0.0)},
    ],
)
@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3])
def test_obstacle_stops_robot_at_its_edge(obstacle, kind):
    drive = Drive([kind], [[0, 0]], scene=furnished({"it": obstacle})).go(5.0, [[kind.speed, 0, 0, 0]])
    assert np.array(drive.path)[:, 0, 0].max() < 0.5 - kind.radius + 1e-3
    assert (drive.x, drive.pairs) == (pytest.approx(0.5 - kind.radius, abs=2e-4), [(0, -1)])


def test_placed_robot_is_at_rest():
    drive = Drive([KHEPERA4, TURTLEBOT3], [[0, 0], [0.4, 0]], [0, math.pi]).go(2.0, [[0.2, 0, 0, 0]] * 2)
    assert len(drive.touches) == 1
    drive.put(0, (3.0, 2.0, 0.0), 1.0).go(1.0, [[np.nan] * 4, [0.0] * 4])
    seen = [*drive.position[0], drive.engine.motions[0].yaw]
    np.testing.assert_allclose(seen, [3.0, 2.0, 0.0, 1.0], atol=1e-12)
    drive.put(0, (0.0, 0.0, 0.0)).go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert len(drive.touches) == 2


def test_parameters_and_motions_are_checked():
    for kind, why in (
        (replace(KHEPERA4, name="hovercraft", motion=None), "no twin of 'hovercraft'"),
        (OMNI, "'omni' does not move in this engine, which carries Wheels, Flight"),
    ):
        with pytest.raises(BodyError, match=why):
            Planar().build(stage([kind], [[0, 0]]))
    assert registry.build(registry.ENGINES, "pymunk") == Planar()
    steps = [Planar().build(stage([KHEPERA4], [[0, 0]], dt=dt)).steps for dt in (0.02, 0.01, 0.004)]
    assert steps == [4, 2, 1]  # each of 5 ms at most
    for name, value in (("restitution", 2.0), ("step_s", 0.0)):
        with pytest.raises(msgspec.ValidationError, match=name):
            registry.build(registry.ENGINES, {"kind": "pymunk", name: value})


def test_walled_arena_has_walls():
    obstacles = {"far": {"radius": 0.1, "at": (-1.5, -1.5)}}
    open_room = Drive([KHEPERA4], [[1, 0]], scene=furnished(obstacles)).go(6.0, [[0.27, 0, 0, 0]])
    assert (open_room.x > 2.2, open_room.touches) == (True, [])
    drive = Drive([KHEPERA4], [[1, 0]], [0.4], scene=furnished(obstacles, walled=True))
    path = np.array(drive.go(15.0, [[0.27, 0, 0, 0]]).path)[:, 0]
    assert path[:, :2].max() < 2.0 - KHEPERA4.radius + 1e-3
    assert drive.pairs[0] == (0, -2)
    slides = path[-1, 1] - path[round(drive.touches[0].time / DT), 1]
    assert slides > 0.2  # a slanting one is dragged along, across its wheels


def test_moving_obstacle_pushes_a_robot():
    plan = Line(move_by=(1.0, 0.0), speed_=0.2)
    scene = furnished({"car": {"box": (0.2, 0.6), "at": (-0.5, 0.0)}}, {"car": plan})
    drive = Drive([KHEPERA4], [[0, 0]], [math.pi / 2], scene=scene)
    drive.go(10.0, [[0, 0, 0, 0]])
    np.testing.assert_allclose(drive.obstacles[0], scene.at(10.0)[0], atol=1e-9)
    assert drive.obstacles[0, 0] == pytest.approx(0.5)
    front = 0.5 + 0.1 + KHEPERA4.radius
    assert front - 1e-3 < drive.x < front + 0.02
    assert drive.pairs == [(0, -1)]
    assert drive.touches[0].time == pytest.approx((0.4 - KHEPERA4.radius) / 0.2, abs=0.1)


@pytest.mark.parametrize("mass", [0.5, 5.0])
def test_light_box_is_pushed_heavy_box_stays(mass):
    scene = furnished({"box": {"box": (0.3, 0.3), "at": (0.4, 0.0), "mass": mass, "friction": 0.4}})
    drive = Drive([TURTLEBOT3], [[0, 0]], scene=scene).go(5.0, [[0.2, 0, 0, 0]])
    pushed = drive.obstacles[0, 0]
    if mass == 5.0:
        assert pushed == pytest.approx(0.4, abs=1e-3)
        return
    assert 1.1 < pushed == pytest.approx(drive.x + TURTLEBOT3.radius + 0.15, abs=2e-3)
    drive.go(3.0, [[0, 0, 0, 0]])
    assert drive.obstacles[0, 0] - pushed < 0.2**2 / (2 * 2.0) + 3e-3  # the robot's own way to a halt


def test_pushed_disc_slides_against_friction():
    scene = furnished({"disc": {"radius": 0.1, "at": (0.5, 0.0), "mass": 0.2, "friction": 0.3}})
    drive = Drive([TELLO], [[0, 0, 0.5]], scene=scene, restitution=1.0)
    while not drive.touches:
        drive.go(DT, [[1.0, 0, 0, 0]])
    start = drive.obstacles[0, 0]
    drive.go(DT, [[-1.0, 0, 0, 0]])
    speed = (drive.obstacles[0, 0] - start) / DT + 0.5 * 0.3 * 9.81 * DT
    drive.go(2.0, [[-1.0, 0, 0, 0]])
    assert drive.obstacles[0, 0] - start == pytest.approx(speed**2 / (2 * 0.3 * 9.81), rel=0.15)


def test_robots_meet_at_their_heights():
    for height, meets in ((0.22, False), (0.15, True)):
        drive = Drive([CRAZYFLIE, TURTLEBOT3], [[-1, 0, height], [0, 0]])
        drive.go(4.0, [[1, 0, height, 0], [0, 0, 0, 0]])
        assert (bool(drive.touches), drive.x != pytest.approx(1.0, abs=0.01)) == (meets, meets)
    for height, meets in ((0.05, True), (0.5, False)):
        drive = Drive([KHEPERA4, CRAZYFLIE], [[0, 0], [0.4, 0]], mirrored=[False, True])
        drive.mirror(1, (0.4, 0.0, height))
        assert bool(drive.go(4.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]]).touches) == meets


def test_obstacle_is_met_at_its_height():
    beam = {"box": (0.2, 2.0), "at": (0.5, 0.0), "bottom": 0.4, "height": 0.2}
    for height, meets in ((0.3, False), (0.5, True), (0.7, False)):
        scene = furnished({"beam": beam})
        drive = Drive([CRAZYFLIE, KHEPERA4], [[0, 0, height], [0, 0.5]], scene=scene)
        drive.go(6.0, [[1.2, 0, height, 0], [0.25, 0, 0, 0]])
        assert drive.position[1, 0] > 1.0
        assert {touch.second for touch in drive.touches} == ({-1} if meets else set())
        assert (drive.x > 1.0) != meets


@pytest.mark.parametrize("base", [KHEPERA4, TURTLEBOT3])
def test_landing_on_a_robot_slides_off(base):
    drive = Drive([CRAZYFLIE, base], [[0.02, 0.01, 0.6], [0, 0]])
    assert not drive.go(1.0, [[0.02, 0.01, 0.6, 0], [0, 0, 0, 0]]).touches
    drive.engine.land([0])
    drive.go(6.0, np.full((2, 4), np.nan))
    assert drive.pairs[0] == (0, 1)
    assert (drive.engine.motions[0].flying, drive.position[0, 2]) == (False, 0.0)
    assert math.dist(*drive.position[:, :2]) > base.radius + CRAZYFLIE.radius - 1e-3
    path = np.array(drive.path)
    assert np.abs(np.diff(path[:, 0, :2], axis=0)).max() / DT < 1.0
    assert np.linalg.norm(path[-1, 1, :2]) < 0.02  # the heavy one hardly moves


def test_mirrored_robot_is_not_pushed():
    drive = Drive([TURTLEBOT3, KHEPERA4], [[0, 0], [0.5, 0]], mirrored=[False, True])
    for _ in range(500):
        drive.mirror(1, (0.5, 0.0, 0.0), 0.3)
        drive.go(DT, [[0.2, 0, 0, 0], [0.2, 0, 0, 0]])
    mirrored = drive.engine.motions[1]
    assert (mirrored.position, mirrored.yaw) == ((0.5, 0.0, 0.0), 0.3)
    assert drive.x == pytest.approx(0.5 - TURTLEBOT3.radius - KHEPERA4.radius, abs=2e-4)
    assert drive.pairs == [(0, 1)]
    drive.mirror(1, UNKNOWN, math.nan, UNKNOWN)
    drive.go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert drive.x > 0.85


def test_mirrored_robot_pushes_with_its_speed():
    drive = Drive([KHEPERA4, TURTLEBOT3], [[0.3, 0], [0, 0]], [math.pi / 2, 0], mirrored=[False, True])
    x = 0.0
    for _ in range(300):
        x += 0.2 * DT
        drive.mirror(1, (x, 0.0, 0.0), 0.0, (0.2, 0.0, 0.0))
        drive.go(DT, [[0, 0, 0, 0]] * 2)
    assert drive.overlap(0, 1) < 1e-3
    assert drive.x == pytest.approx(x + TURTLEBOT3.radius + KHEPERA4.radius, abs=5e-3)
    assert len(drive.touches) == 1


def test_absent_mirrored_robot_disturbs_nobody():
    drive = Drive([CRAZYFLIE, CRAZYFLIE, KHEPERA4], [[0, 0], [1, 0], [2, 0]], mirrored=[False, True, False])
    alone = Drive([CRAZYFLIE, KHEPERA4], [[0, 0], [2, 0]])
    for each, flown in ((drive, [[np.nan] * 4] * 2), (alone, [[np.nan] * 4])):
        each.engine.takeoff([0], [0.5])
        each.go(3.0, [*flown, [0.1, 0.2, 0, 0]])
    np.testing.assert_array_equal(drive.position[[0, 2]], alone.position)
    assert drive.position[0, 2] > 0.3
    for _ in range(200):
        drive.engine.advance(3.0, [(0.01, 0.0), (math.nan, math.nan), (0.0, 0.0)])
    assert drive.x == pytest.approx(0.01, abs=1e-3)  # wobble, which the controller does not remove
