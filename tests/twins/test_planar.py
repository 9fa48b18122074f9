"""The pymunk engine: the point-mass engine where nothing touches, rigid bodies where something does."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import plugins
from agents.body import BodyError
from agents.kinds import CRAZYFLIE, KHEPERA4, TELLO, TURTLEBOT3
from agents.planning import Line
from experiments import virtual
from experiments.run import chosen, load
from twins.engine import Stage
from twins.place import MASSES
from twins.planar import Planar
from twins.pointmass import PointMass
from twins.scene import Obstacle, Scene

DT = 0.01


def stage(kinds, start, yaw=None, *, copy=None, mirrored=None, scene=None, dt=DT):
    """Rows at x, y (and z), in endless room unless a scene is given."""
    n = len(kinds)
    start = np.array(start, dtype=float)
    start = np.column_stack([start, np.zeros((n, 3 - start.shape[1]))])
    return Stage(
        tuple(kinds),
        start,
        np.zeros(n) if yaw is None else np.array(yaw, dtype=float),
        dt,
        np.zeros(n, dtype=np.intp) if copy is None else np.array(copy),
        np.zeros(n, dtype=bool) if mirrored is None else np.array(mirrored),
        Scene.empty() if scene is None else scene,
    )


def furnished(obstacles, plans=None, size=(4.0, 4.0, 3.0), walled=False):
    made = {name: Obstacle(**parts) for name, parts in obstacles.items()}
    return Scene.furnished(size, made, plans or {}, walled=walled)


class Drive:
    """An engine, told the same setpoints for a while, and what was seen of it."""

    def __init__(self, place, **choice):
        self.engine = Planar(**choice).build(place)
        self.kinds, self.rows = place.kinds, len(place.kinds)
        self.t = 0.0
        self.path, self.touches = [], []

    def go(self, seconds, setpoint=None):
        for _ in range(round(seconds / DT)):
            if setpoint is not None:
                self.engine.command(np.array(setpoint, dtype=float))
            self.t += DT
            self.engine.advance(self.t, np.zeros((self.rows, 2)))
            self.path.append(self.engine.position.copy())
            self.touches += self.engine.touches()
        return self

    def aloft(self, position):
        """Everything that flies is put into the air."""
        flies = np.flatnonzero([kind.flies for kind in self.kinds])
        self.engine.place(flies, np.array(position, dtype=float), np.zeros(len(flies)), np.ones(len(flies), dtype=bool))
        return self

    def overlap(self, a, b):
        """The deepest of two rows in each other on the way [m]."""
        path = np.array(self.path)
        apart = np.linalg.norm(path[:, a, :2] - path[:, b, :2], axis=1)
        return (self.kinds[a].radius + self.kinds[b].radius - apart).max()


def still(rows):
    return np.zeros((rows, 4))


# without contact


def test_without_contact_it_is_the_point_mass_engine():
    kinds = (CRAZYFLIE, TELLO, KHEPERA4, TURTLEBOT3, CRAZYFLIE)
    flies = np.array([kind.flies for kind in kinds])
    place = stage(kinds, [[0, 0], [9, 0], [18, 0], [0, 9], [9, 9]], np.linspace(-2, 2, 5))
    engines = PointMass().build(place), Planar().build(place)
    rng = np.random.default_rng(5)
    jitter, command = np.zeros((5, 2)), np.full((5, 4), np.nan)
    aloft = np.flatnonzero(flies)
    for k in range(1500):
        if k == 5:
            [engine.takeoff(aloft, np.array([0.5, 0.8, 1.0])) for engine in engines]
        if k >= 300 and k % 10 == 0:
            command = np.zeros((5, 4))
            command[:, :2] = place.start[:, :2] + 0.15 * np.sin([k / 200.0, k / 300.0])
            command[:, 2:] = [0.9, math.sin(k / 100.0)]
            command[1] = [0.2 * math.sin(k / 150.0), 0.1, 0.05, 0.3]
            command[2:4] = [[0.25, rng.normal(), 0, 0], [0.2, rng.normal(), 0, 0]]
            [engine.command(command) for engine in engines]
        jitter = 0.98 * jitter + 0.002 * rng.standard_normal((5, 2))
        share = np.minimum(engines[0].position[:, 2] / 0.2, 1.0) * flies
        for engine in engines:
            engine.advance(k * DT, share[:, None] * jitter)
        one, other = engines
        np.testing.assert_allclose(other.position, one.position, atol=1e-10)
        np.testing.assert_allclose(other.velocity, one.velocity, atol=1e-10)
        np.testing.assert_allclose(other.yaw, one.yaw, atol=1e-10)
        np.testing.assert_array_equal(other.flying, one.flying)
    assert np.linalg.norm(other.position[:, :2] - place.start[:, :2], axis=1).min() > 0.05
    for k in range(600):
        if k == 0:
            [engine.land(np.arange(5)) for engine in engines]
        for engine in engines:
            engine.advance(0.0, np.zeros((5, 2)))
        np.testing.assert_allclose(other.position, one.position, atol=1e-4)
    np.testing.assert_array_equal(other.flying, one.flying)
    assert not other.flying.any()
    np.testing.assert_allclose(other.velocity, 0.0, atol=1e-9)


@pytest.mark.slow
def test_an_experiment_runs_the_same_on_it_as_on_point_masses():
    logs = []
    for engine in ("point-mass", "pymunk"):
        read = load("robotic-park", f"world.engine={engine}", "duration_s=25")
        logs.append(virtual.simulate(chosen(read, ["event"])["event"], [7]))
    one, other = logs
    np.testing.assert_allclose(other.true_position, one.true_position, atol=1e-9)
    np.testing.assert_allclose(other.error, one.error, atol=1e-9)
    assert len(other.sent[0]) == len(one.sent[0])
    assert not other.touches


def test_a_quadrotor_accelerates_no_more_than_its_tilt_allows():
    drive = Drive(stage([CRAZYFLIE], [[0, 0]])).aloft([[0, 0, 1]])
    drive.go(2.0, [[9, 9, 1, 0]])
    speeds = []
    for _ in range(50):
        drive.go(DT, [[-9, -9, 1, 0]])
        speeds.append(drive.engine.velocity[0, :2].copy())
    change = np.linalg.norm(np.diff(speeds, axis=0), axis=1) / DT
    assert change.max() == pytest.approx(9.81 * math.tan(math.radians(20.0)), rel=1e-9)


def test_wheels_slip_when_told_to_accelerate_beyond_their_grip():
    drive = Drive(stage([KHEPERA4], [[0, 0]]), traction=0.1)
    drive.go(0.1, [[0.27, 0, 0, 0]])
    assert drive.engine.velocity[0, 0] == pytest.approx(0.1 * 9.81 * 0.1, rel=0.02)


def test_a_step_is_never_longer_than_asked():
    for dt, parts in ((0.02, 4), (0.01, 2), (0.004, 1)):
        assert Planar().build(stage([KHEPERA4], [[0, 0]], dt=dt))._steps == parts


def test_a_stopped_quadrotor_falls_and_stands_where_friction_holds_it():
    drive = Drive(stage([CRAZYFLIE], [[0, 0]])).aloft([[0, 0, 1]])
    drive.go(1.0, [[9, 0, 1, 0]])
    drive.engine.stop(np.array([0]))
    drive.go(0.3)
    speed = drive.engine.velocity[0, 0]
    assert speed > 0.8
    drive.go(2.0)
    assert drive.engine.position[0, 2] == 0.0
    assert drive.engine.velocity[0, 0] == pytest.approx(0.0, abs=1e-9)


# robots against robots


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3])
@pytest.mark.parametrize("aside", [0.0, 0.5, 1.2])
def test_two_driven_at_each_other_touch_once_and_do_not_overlap(kind, aside):
    offset = aside * kind.radius
    drive = Drive(stage([kind, kind], [[-0.5, 0], [0.5, offset]], [0.0, math.pi]))
    drive.go(4.0, [[kind.speed, 0, 0, 0]] * 2)
    assert drive.overlap(0, 1) < 1e-3
    first = drive.touches[0]
    assert (first.first, first.second) == (0, 1)
    assert first.overlap < 1e-3
    gap = 1.0 * math.cos(math.asin(offset / 1.0)) if offset else 1.0
    assert first.time == pytest.approx((gap - 2 * kind.radius) / (2 * kind.speed), abs=0.2)
    if aside == 0.0:
        assert len(drive.touches) == 1
        mass = MASSES[kind.name]
        # reduced mass × closing speed × (1 + restitution), and what the wheels push in that step
        blow = 0.5 * mass * 2.0 * kind.speed * 1.1
        assert blow * 0.999 < first.impulse < 1.001 * (blow + 0.7 * mass * 9.81 * 0.005)
        np.testing.assert_allclose(drive.engine.velocity[:, 0], 0.0, atol=1e-3)
        apart = drive.engine.position[1, 0] - drive.engine.position[0, 0]
        assert apart == pytest.approx(2 * kind.radius, abs=2e-4)


@settings(max_examples=15, deadline=None)
@given(
    heading=st.floats(-math.pi, math.pi),
    aside=st.floats(-0.05, 0.05),
    pair=st.sampled_from([(KHEPERA4, TURTLEBOT3), (KHEPERA4, KHEPERA4), (CRAZYFLIE, TELLO), (CRAZYFLIE, CRAZYFLIE)]),
)
def test_no_encounter_overlaps(heading, aside, pair):
    toward = np.array([math.cos(heading), math.sin(heading)])
    across = np.array([-toward[1], toward[0]])
    there = 0.6 * toward + aside * across
    drive = Drive(stage(pair, [-there, there], [heading, heading + math.pi]))
    if pair[0].flies:
        drive.aloft([[*-there, 1.0], [*there, 1.0]])
    setpoint = still(2)
    for row, (kind, sign) in enumerate(zip(pair, (1.0, -1.0), strict=True)):
        if kind.takes == "position":
            continue
        if kind.takes == "velocity":
            setpoint[row, :2] = sign * toward
        else:
            setpoint[row, 0] = kind.speed
    for _ in range(300):
        for row, sign in ((0, 1.0), (1, -1.0)):
            if pair[row].takes == "position":  # 0.5 m ahead it wants its full speed
                setpoint[row] = [*(drive.engine.position[row, :2] + sign * 0.5 * toward), 1.0, 0.0]
        drive.go(DT, setpoint)
    assert drive.touches
    assert drive.overlap(0, 1) < 1e-3


def test_what_keeps_pushing_touches_once_and_what_comes_back_touches_again():
    drive = Drive(stage([TURTLEBOT3, KHEPERA4], [[0, 0], [0.4, 0]], [0.0, math.pi / 2]))
    drive.go(6.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert len(drive.touches) == 1
    drive.go(1.0, [[-0.2, 0, 0, 0], [0, 0, 0, 0]])
    drive.go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert len(drive.touches) == 2
    assert drive.touches[1].time > 7.0


def test_the_heavier_pushes_the_lighter_and_not_the_other_way_round():
    across = math.pi / 2  # sideways the pushed one's wheels cannot roll: it is dragged
    pushes = Drive(stage([TURTLEBOT3, KHEPERA4], [[0, 0], [0.4, 0]], [0.0, across]))
    pushes.go(5.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert pushes.engine.position[1, 0] > 1.0
    assert pushes.engine.velocity[1, 0] == pytest.approx(0.2, abs=2e-3)
    stuck = Drive(stage([KHEPERA4, TURTLEBOT3], [[0, 0], [0.4, 0]], [0.0, across]))
    stuck.go(5.0, [[0.25, 0, 0, 0], [0, 0, 0, 0]])
    assert stuck.engine.position[1, 0] == pytest.approx(0.4, abs=2e-3)  # the blow itself moves it a little
    assert stuck.engine.velocity[0, 0] == pytest.approx(0.0, abs=1e-3)


def test_a_blow_in_the_air_conserves_momentum_and_gives_no_energy():
    drive = Drive(stage([CRAZYFLIE, TELLO], [[0, 0], [2, 0]]), restitution=0.5)
    drive.aloft([[0, 0, 1.0], [1.2, 0, 1.0]])
    mass = np.array([MASSES["crazyflie"], MASSES["tello"]])
    setpoint = [[5, 0, 1, 0], [-0.5, 0, 0, 0]]
    while not drive.touches:
        before = drive.engine.velocity[:, 0].copy()
        drive.go(DT, setpoint)
    after = drive.engine.velocity[:, 0]
    steered = 3.6 * DT * mass.sum()
    assert mass @ after == pytest.approx(mass @ before, abs=steered)
    assert mass @ after**2 < mass @ before**2
    assert after[1] - after[0] == pytest.approx(0.5 * (before[0] - before[1]), abs=0.08)
    reduced = mass.prod() / mass.sum()
    assert drive.touches[0].impulse == pytest.approx(1.5 * reduced * (before[0] - before[1]), rel=0.1)


def test_a_jam_does_not_overlap():
    kinds = [TURTLEBOT3, KHEPERA4, KHEPERA4, KHEPERA4] * 4
    grid = 0.25 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2) - 0.375
    drive = Drive(stage(kinds, grid))
    for _ in range(60):
        x, y = drive.engine.position[:, 0], drive.engine.position[:, 1]
        turn = 2.0 * np.sin(np.arctan2(-y, -x) - drive.engine.yaw)
        drive.go(0.1, np.column_stack([np.full(16, 0.2), turn, np.zeros((16, 2))]))
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
def test_an_obstacle_stops_a_robot_at_its_edge(obstacle, kind):
    drive = Drive(stage([kind], [[0, 0]], scene=furnished({"it": obstacle})))
    drive.go(5.0, [[kind.speed, 0, 0, 0]])
    x = np.array(drive.path)[:, 0, 0]
    assert x.max() < 0.5 - kind.radius + 1e-3
    assert x[-1] == pytest.approx(0.5 - kind.radius, abs=2e-4)
    assert drive.engine.velocity[0, 0] == pytest.approx(0.0, abs=1e-3)
    assert [(touch.first, touch.second) for touch in drive.touches] == [(0, -1)]


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
        assert [touch.second for touch in drive.touches] == [-1] * meets
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


# copies


def crowd(seed, copies=1):
    rng = np.random.default_rng(seed)
    kinds = [KHEPERA4, TURTLEBOT3, CRAZYFLIE, KHEPERA4, KHEPERA4]
    grid = np.array([[-0.5, -0.5], [0.5, -0.5], [0.0, 0.0], [-0.5, 0.5], [0.5, 0.5]])
    return kinds * copies, np.tile(grid, (copies, 1)), rng


def busy(engine, rows, seeds, ticks=400):
    """Everyone to the middle by noisy commands of each copy's own."""
    streams = [np.random.default_rng(seed) for seed in seeds]
    engine.takeoff(np.arange(2, rows, 5), np.full(len(seeds), 0.05))
    found = []
    for k in range(ticks):
        if k % 10 == 0:
            noise = np.concatenate([stream.normal(size=5) for stream in streams])
            x, y = engine.position[:, 0], engine.position[:, 1]
            command = np.zeros((rows, 4))
            command[:, 0], command[:, 1] = 0.2, 2.0 * np.sin(np.arctan2(-y, -x) - engine.yaw) + noise
            command[2::5] = [0.0, 0.0, 0.05, 0.0]
            engine.command(command)
        engine.advance(k * DT, np.zeros((rows, 2)))
        found += engine.touches()
    return found


def test_copies_have_the_results_that_they_would_have_alone():
    scene = furnished({"box": {"box": (0.2, 0.2), "at": (0.0, 0.35), "mass": 0.2}}, size=(2.0, 2.0, 2.0), walled=True)
    alone, touched = [], []
    for seed in (1, 2, 3):
        kinds, start, _ = crowd(seed)
        engine = Planar().build(stage(kinds, start, scene=scene))
        touched.append(busy(engine, 5, [seed]))
        alone.append((engine.position, engine.yaw, engine.obstacles[0]))
        assert touched[-1]
    kinds, start, _ = crowd(0, 3)
    together = Planar().build(stage(kinds, start, copy=np.repeat(np.arange(3), 5), scene=scene))
    found = busy(together, 15, [1, 2, 3])
    for k, (position, yaw, obstacles) in enumerate(alone):
        rows = slice(5 * k, 5 * k + 5)
        np.testing.assert_array_equal(together.position[rows], position)
        np.testing.assert_array_equal(together.yaw[rows], yaw)
        np.testing.assert_array_equal(together.obstacles[k], obstacles)
        mine = [t for t in found if 5 * k <= t.first < 5 * k + 5]
        expected = [replace(t, first=t.first + 5 * k, second=t.second + 5 * k * (t.second >= 0)) for t in touched[k]]
        assert mine == expected
    assert np.abs(alone[0][0] - alone[1][0]).max() > 1e-3


def test_it_is_reproducible_to_the_bit():
    ends = []
    for _ in range(2):
        kinds, start, _ = crowd(4)
        engine = Planar().build(stage(kinds, start))
        found = busy(engine, 5, [4])
        ends.append((engine.position.tobytes(), engine.yaw.tobytes(), found))
    assert ends[0] == ends[1]


# orders and parameters


def test_a_row_can_be_put_elsewhere_at_rest():
    drive = Drive(stage([KHEPERA4, TURTLEBOT3], [[0, 0], [0.4, 0]], [0, math.pi]))
    drive.go(2.0, [[0.2, 0, 0, 0]] * 2)
    assert len(drive.touches) == 1
    drive.engine.place(np.array([0]), np.array([[3.0, 2.0, 0.0]]), np.array([1.0]), np.array([False]))
    np.testing.assert_array_equal(drive.engine.position[0], [3.0, 2.0, 0.0])
    drive.go(1.0, np.full((2, 4), np.nan))
    np.testing.assert_allclose(drive.engine.position[0], [3.0, 2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(drive.engine.velocity[0], 0.0, atol=1e-12)
    assert drive.engine.yaw[0] == pytest.approx(1.0, abs=1e-12)
    drive.engine.place(np.array([0]), np.array([[0.0, 0.0, 0.0]]), np.array([0.0]), np.array([False]))
    drive.go(3.0, [[0.2, 0, 0, 0], [0, 0, 0, 0]])
    assert len(drive.touches) == 2


def test_a_kind_without_a_twin_is_an_error():
    with pytest.raises(BodyError, match="no twin of a hovercraft"):
        Planar().build(stage([replace(KHEPERA4, name="hovercraft")], [[0, 0]]))


def test_it_is_found_by_name_and_its_parameters_are_checked():
    assert plugins.build(plugins.ENGINES, "pymunk") == Planar()
    with pytest.raises(msgspec.ValidationError, match=r"restitution"):
        plugins.build(plugins.ENGINES, {"kind": "pymunk", "restitution": 2.0})
    with pytest.raises(msgspec.ValidationError, match=r"step_s"):
        plugins.build(plugins.ENGINES, {"kind": "pymunk", "step_s": 0.0})
