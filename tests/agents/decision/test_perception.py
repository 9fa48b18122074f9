"""Things around a robot: received robots where they are now, rays where they ended, nothing twice."""

from math import asin, cos, inf, nan, pi, radians, sin, sqrt
from types import SimpleNamespace

import pytest

from agents.body.interface import BodyState, RangeScan
from agents.body.limits import Limits
from agents.decision.neighbours import Incoming, Neighbours
from agents.decision.perception import AHEAD_S, CLIMB_S, SCAN_S, SIGHT_M, Perception
from agents.decision.situation import Situation
from agents.plugins.avoidance import Avoidance
from agents.vectors import ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3

LIMITS = Limits(low=(-5.0, -5.0, 0.0), high=(5.0, 5.0, 2.5), speed=0.5)


class Sight:
    """Perception of a robot of a kind that receives another one."""

    def __init__(self, kind=KHEPERA4, other=TURTLEBOT3, clearance=0.1):
        avoidance, links = Avoidance(clearance=clearance), [Incoming(1, "B", other, 1.0)]
        assignment = SimpleNamespace(kind=kind, limits=LIMITS, avoidance=avoidance, neighbours=links)
        self.perception, self.neighbours = Perception(assignment), Neighbours(links, 1.0)

    def hear(self, position, velocity=ZERO, stamp=0.0):
        self.neighbours.mark_alive(0)
        self.neighbours.all[0].stamp = -inf
        self.neighbours.receive(0, position, velocity, stamp, stamp)
        return self

    def sense(self, t, position=ZERO, *, yaw=0.0, velocity=ZERO, time=None, scan=None):
        now = Situation()
        now.state = BodyState(t if time is None else time, position, velocity, yaw, scan=scan)
        now.begin(t)
        self.perception.notice(scan)
        self.perception.sense(t, now, self.neighbours)
        return self.perception.near.things[: self.perception.near.count]


def places_of(things):
    return [pytest.approx((thing.x, thing.y), abs=1e-12) for thing in things]


def reaches_of(things):
    return [pytest.approx((thing.low, thing.high)) for thing in things]


def rays(bearing, distance, *, elevation=0.0, time=0.0):
    flat = elevation if isinstance(elevation, list) else [elevation] * len(bearing)
    return RangeScan(time, tuple(bearing), tuple(flat), tuple(distance))


@pytest.mark.parametrize(
    ("kind", "speed", "takes", "lag"),
    [(KHEPERA4, KHEPERA4.speed, (0, 1), 0.1), (TELLO, 0.5, (0, 0), 1 / 3), (CRAZYFLIE, 0.5, (1, 0), 0.4)],
)
def test_robot_knows_kind_pose_and_lower_limit(kind, speed, takes, lag):
    sight = Sight(kind)
    assert sight.sense(0.0, (1.0, 0.0, 1.0), yaw=2.0, velocity=(0.0, 0.2, 0.0)) == []
    own = sight.perception.own
    assert (own.speed, (own.by_position, own.by_twist), own.lag) == (speed, takes, lag)
    assert (own.position, own.yaw, own.velocity) == ((1.0, 0.0, 1.0), 2.0, (0.0, 0.2, 0.0))
    for absurd in (nan, inf, -inf, 51.0, -1e8, 1e38):
        sight.sense(0.0, velocity=(0.1, absurd, 0.2))
        assert own.velocity == (0.1, 0.0, 0.2)


@pytest.mark.parametrize(("t", "age"), [(1.0, 0.0), (1.04, 0.04), (1.3, AHEAD_S), (0.9, 0.0)])
def test_received_robot_moves_on_for_a_moment(t, age):
    sight = Sight().hear((0.6, 0.2, 0.0), (0.2, -0.1, 0.0), stamp=1.0)
    (thing,) = sight.sense(t)
    assert (thing.x, thing.y) == pytest.approx((0.6 + 0.2 * age, 0.2 - 0.1 * age), abs=1e-12)
    assert (thing.velocity_x, thing.velocity_y, thing.is_robot, thing.lag) == (0.2, -0.1, True, TURTLEBOT3.lag)
    assert (thing.radius, thing.low, thing.high) == (TURTLEBOT3.radius, 0.0, TURTLEBOT3.height)
    (thing,) = sight.sense(1.6)
    assert (thing.velocity_x, thing.velocity_y) == (0.0, 0.0)  # a silent robot's is forgotten


@pytest.mark.parametrize(("height", "there"), [(0.28, 1), (0.30, 0), (1.0, 0)])
def test_things_above_and_below_are_ignored(height, there):
    """A drone over a robot of 0.192 m, with 0.1 m of clearance, itself 0.029 m high; and the other way round."""
    assert len(Sight(CRAZYFLIE).hear((0.1, 0.0, 0.0)).sense(0.0, (0.0, 0.0, height))) == there
    assert len(Sight(TURTLEBOT3, CRAZYFLIE).hear((0.1, 0.0, height)).sense(0.0)) == there
    assert len(Sight(CRAZYFLIE, clearance=1.0).hear((0.1, 0.0, 0.0)).sense(0.0, (0.0, 0.0, height))) == 1


def test_lost_or_restarted_robot_is_in_the_way():
    for gone in (8.5, 7.9, 7.0):
        lost = Sight().hear((0.5, 0.0, 0.0), stamp=7.0)
        lost.neighbours.mark_lost(0, gone)
        assert len(lost.sense(9.0)) == 1
    drone = Sight(CRAZYFLIE, CRAZYFLIE).hear((0.5, 0.0, 1.0), (0.3, 0.0, 0.0), stamp=7.0)
    assert drone.sense(9.0, (0.0, 0.0, 0.1)) == []
    drone.neighbours.discard_pose(0)  # its new process has claimed the name, and has sent no pose
    (thing,) = drone.sense(9.0, (0.0, 0.0, 0.1))
    assert (thing.x, thing.y, thing.velocity_x, thing.low) == (0.5, 0.0, 0.0, 0.0)  # it may have come down


def test_drone_is_in_the_way_below_too():
    for height, speed, stamp, reach in (
        (0.9, -0.05, 9.0, []),
        (0.9, -0.4, 8.0, []),  # silent since
        (0.9, -0.4, 9.0, [(0.9 - 0.4 * CLIMB_S, 0.9 + CRAZYFLIE.height)]),
        (0.05, 0.0, 9.0, [(0.05, 0.05 + CRAZYFLIE.height)]),
    ):
        sight = Sight(TURTLEBOT3, CRAZYFLIE).hear((0.1, 0.0, height), (0.0, 0.0, speed), stamp)
        assert reaches_of(sight.sense(9.0)) == reach
    climbing = Sight(CRAZYFLIE, CRAZYFLIE).hear((0.1, 0.0, 0.1), (0.0, 0.0, 0.4), 9.0)
    reach = [(0.1, 0.1 + 0.4 * CLIMB_S + CRAZYFLIE.height)]
    assert reaches_of(climbing.sense(9.0, (0.0, 0.0, 0.8))) == reach


@pytest.mark.parametrize(("height", "before", "after"), [(0.0, 0, 1), (0.9, 1, 1), (1.3, 0, 0)])
def test_lost_drone_may_have_come_down(height, before, after):
    """A drone that hovered at 1 m and fell silent may be anywhere from there to the floor."""
    sight = Sight(TURTLEBOT3 if height == 0.0 else CRAZYFLIE, CRAZYFLIE).hear((0.1, 0.0, 1.0), stamp=7.0)
    sight.neighbours.mark_lost(0, 8.5)  # a second of silence is borne
    assert len(sight.sense(9.0, (0.0, 0.0, height))) == before
    sight.neighbours.mark_lost(0, 7.9)
    assert reaches_of(sight.sense(9.0, (0.0, 0.0, height))) == [(0.0, 1.0 + CRAZYFLIE.height)] * after


def test_far_robots_and_lost_positions_are_ignored():
    assert Sight().hear((SIGHT_M + 0.01, 0.0, 0.0), stamp=9.0).sense(9.0) == []
    assert Sight().sense(9.0) == []  # never received
    for how in ({"position": (nan, 0.0, 0.0)}, {"yaw": nan}, {"time": 8.4}):
        sight = Sight().hear((SIGHT_M - 0.01, 0.0, 0.0), stamp=9.0)
        assert len(sight.sense(9.0)) == 1
        assert sight.sense(9.0, **how) == []


@pytest.mark.parametrize(
    "wrong",
    [
        *({"bearing": nan}, {"elevation": nan}, {"bearing": inf}),
        *({"distance": value} for value in (nan, 0.0, -0.1, -inf, 0.01, SIGHT_M + 0.1)),
    ],
)
def test_ray_without_direction_or_length_is_ignored(wrong):
    ray = {"bearing": 1.0, "elevation": 0.0, "distance": 0.4} | wrong
    scan = rays([ray["bearing"], 0.0, pi / 2], [ray["distance"], 0.4, 0.9], elevation=[ray["elevation"], 0.0, 0.0])
    things, c, s = Sight().sense(0.0, (1.0, 2.0, 0.0), yaw=0.5, scan=scan), cos(0.5), sin(0.5)
    assert places_of(things) == [(1 + 0.4 * c, 2 + 0.4 * s), (1 - 0.9 * s, 2 + 0.9 * c)]
    assert not any(thing.radius or thing.is_robot or thing.velocity_x for thing in things)


def test_seen_things_stay_until_replaced_or_old():
    sight, scan = Sight(), rays([0.0, 1.0], [0.5, 0.6], time=1.0)
    seen = [(0.5, 0.0), (0.6 * cos(1), 0.6 * sin(1))]
    assert places_of(sight.sense(1.0, scan=scan)) == seen
    moved = (0.04, 0.01, 0.0)
    assert places_of(sight.sense(1.15, moved, yaw=0.7, scan=scan)) == seen
    assert sight.sense(1.0 + SCAN_S + 0.01, moved, scan=scan) == []
    assert len(sight.sense(1.3, moved, scan=rays([0.0, 1.0], [0.5, nan], time=1.3))) == 1
    assert sight.sense(1.4, moved) == []  # a body without readings
    late = rays([0.0], [0.5], time=4.9)  # it is laid where the robot was
    assert places_of(sight.sense(5.0, (1.0, 0.0, 0.0), velocity=(0.2, 0.0, 0.0), scan=late)) == [(1.48, 0.0)]
    up = rays([0.0] * 3, [0.3] * 3, elevation=[pi / 2, 0.2, -0.6])  # only one is at its height
    (thing,) = Sight(TELLO).sense(0.0, (0.0, 0.0, 1.0), scan=up)
    assert (thing.x, thing.y) == pytest.approx((0.3 * cos(0.2), 0.0))
    assert thing.low == thing.high == pytest.approx(1.0 + 0.5 * TELLO.height + 0.3 * sin(0.2))


def test_received_robot_is_not_seen_twice():
    far, shadow, bearing, distance = 0.8, asin(TURTLEBOT3.radius / 0.8), [], []
    for k in range(13):  # 1 cm of noise; a wall behind it
        a = radians(5.0 * k - 30.0)
        bearing.append(a)
        hit = abs(a) <= shadow
        distance.append(far * cos(a) - sqrt(TURTLEBOT3.radius**2 - (far * sin(a)) ** 2) + 0.01 if hit else 1.6)
    scan = rays(bearing, distance)
    things = Sight().hear((far, 0.0, 0.0)).sense(0.0, scan=scan)
    assert sorted(thing.is_robot for thing in things) == [False] * 10 + [True]
    assert distance.count(1.6) == 10
    assert len(Sight().sense(0.0, scan=scan)) == len(bearing)
    beside = Sight(TELLO, CRAZYFLIE).hear((far, 0.0, 1.0))
    assert len(beside.sense(0.0, (0.0, 0.0, 1.0), scan=rays([0.0], [far - CRAZYFLIE.radius]))) == 1
    # a drone overhead is not what the rays met
    assert len(Sight(KHEPERA4, CRAZYFLIE).hear((far, 0.0, 1.0)).sense(0.0, scan=scan)) == len(bearing)
