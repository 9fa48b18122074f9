"""What rows know of the things around them: heard robots where they are now, rays where they ended, nothing twice."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from agents.body.interface import BodyState, Rays
from agents.body.kinds import CRAZYFLIE, KHEPERA4, TELLO, TURTLEBOT3
from agents.body.limits import Limits
from agents.decision.neighbours import NeighbourPoses
from agents.decision.perception import AHEAD_S, DESCENT_S, REACH, SCAN_S, Perception
from experiments.definition.graph import links
from agents.plugins.avoidance import Avoidance

LIMITS = Limits(np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 2.5]), speed=0.5)


def state(position, yaw=0.0, velocity=0.0, time=0.0, rays=None):
    place = np.array(position, dtype=float).reshape(-1, 3)
    rows = len(place)
    column = np.broadcast_to(np.asarray(yaw, dtype=float), rows).copy()
    moves = np.broadcast_to(np.asarray(velocity, dtype=float), place.shape).copy()
    up = np.ones(rows, dtype=bool)
    return BodyState(np.full(rows, time), place, moves, column, place, column, np.ones(rows), up, rays=rays)


def heard(position, velocity=0.0, stamp=0.0):
    place = np.array(position, dtype=float).reshape(-1, 3)
    told = NeighbourPoses(len(place))
    told.position[:], told.velocity[:] = place, velocity
    told.stamp[:] = told.arrival[:] = stamp
    told.lost_since[:] = np.inf  # they live
    return told


def rays(row, bearing, distance, *, elevation=0.0, time=0.0):
    many = len(row)
    full = [np.broadcast_to(np.asarray(value, dtype=float), many).copy() for value in (time, bearing, elevation)]
    return Rays(np.array(row, dtype=np.intp), *full, np.array(distance, dtype=float))


def perception(kinds, robot_kinds, net, clearance=0.1, avoids=None):
    avoidance = Avoidance(clearance=clearance)
    return Perception(
        SimpleNamespace(
            kinds=kinds, robot_kinds=robot_kinds, links=net, limits=LIMITS, avoids=avoids, avoidance=avoidance
        )
    )


def pair(kind=KHEPERA4, other=TURTLEBOT3, clearance=0.1, **parts):
    """One row, that hears another robot."""
    return perception((kind,), (kind, other), links([(0, 1)], [1.0], [1.0]), clearance, **parts)


def alone(kind=KHEPERA4):
    return perception((kind,), (kind,), links([], [], []))


def placed(sight, t, now, told=None):
    """Places of the things that one row sees."""
    return sight.sense(t, now, NeighbourPoses(0) if told is None else told)[1].position


# ---------------------------------------------------------------- oneself


@pytest.mark.parametrize("absurd", [np.nan, np.inf, -np.inf, 51.0, -1e8, 1e38])
def test_a_velocity_that_no_robot_has_is_not_known(absurd):
    own, _ = alone().sense(0.0, state([[0, 0, 0]], velocity=[[0.1, absurd, 0.2]]), NeighbourPoses(0))
    np.testing.assert_array_equal(own.velocity, [[0.1, 0.0, 0.2]])


def test_a_row_knows_its_kind_its_pose_and_the_lower_of_two_limits():
    sight = perception((KHEPERA4, TELLO, CRAZYFLIE), (KHEPERA4,), links([], [], []))
    now = state([[0, 0, 0], [1, 0, 1], [2, 0, 1]], yaw=[1, 2, 3], velocity=[[0.1, 0, 0], [np.nan] * 3, [0, 0.2, 0]])
    own, near = sight.sense(0.0, now, NeighbourPoses(0))
    assert own.speed.tolist() == [KHEPERA4.speed, 0.5, 0.5]
    assert own.takes == ("twist", "velocity", "position")
    assert own.by_twist.tolist() == [True, False, False]
    assert own.by_position.tolist() == [False, False, True]
    assert own.lag.tolist() == [0.1, 1 / 3, 0.4]
    np.testing.assert_array_equal(own.velocity, [[0.1, 0, 0], [0, 0, 0], [0, 0.2, 0]])
    np.testing.assert_array_equal(own.yaw, [1, 2, 3])
    assert len(near) == 0


# ---------------------------------------------------------------- who is heard


def test_a_heard_robot_is_where_its_velocity_has_carried_it_but_not_for_long():
    sight, now = pair(), state([0, 0, 0])
    told = heard([0.6, 0.2, 0.0], [0.2, -0.1, 0.0], stamp=1.0)
    for t, age in ((1.0, 0.0), (1.04, 0.04), (1.3, AHEAD_S), (0.9, 0.0)):
        now.time[:] = t
        _, near = sight.sense(t, now, told)
        np.testing.assert_allclose(near.position, [[0.6 + 0.2 * age, 0.2 - 0.1 * age]], atol=1e-12)
        np.testing.assert_array_equal(near.velocity, [[0.2, -0.1]])
    now.time[:] = 1.6
    assert not sight.sense(1.6, now, told)[1].velocity.any()  # silent for long: nobody knows whether it still moves
    assert (near.row.tolist(), near.is_robot.tolist()) == ([0], [True])
    assert (near.radius[0], near.low[0], near.high[0]) == (TURTLEBOT3.radius, 0.0, TURTLEBOT3.height)
    assert near.lag.tolist() == [TURTLEBOT3.lag]


def test_a_drone_reaches_up_from_its_position():
    _, near = pair(TELLO, CRAZYFLIE).sense(0.0, state([0, 0, 1.0]), heard([0.5, 0, 1.05]))
    np.testing.assert_allclose([near.low[0], near.high[0]], [1.05, 1.05 + 0.029])


@pytest.mark.parametrize(("height", "there"), [(0.28, True), (0.30, False), (1.0, False)])
def test_only_things_beside_a_robot_disturb_it(height, there):
    """A drone over a robot of 0.192 m, with 0.1 m of clearance, itself 0.029 m high; and the other way round."""
    assert len(placed(pair(CRAZYFLIE, TURTLEBOT3), 0.0, state([0, 0, height]), heard([0.1, 0, 0]))) == there
    assert len(placed(pair(TURTLEBOT3, CRAZYFLIE), 0.0, state([0, 0, 0]), heard([0.1, 0, height]))) == there
    wide = pair(CRAZYFLIE, TURTLEBOT3, clearance=1.0)
    assert len(placed(wide, 0.0, state([0, 0, height]), heard([0.1, 0, 0]))) == 1


def test_who_is_far_or_was_never_heard_is_not_near():
    sight, now = pair(), state([0, 0, 0], time=9.0)
    assert len(placed(sight, 9.0, now, heard([REACH - 0.01, 0, 0], stamp=9.0))) == 1
    assert len(placed(sight, 9.0, now, heard([REACH + 0.01, 0, 0], stamp=9.0))) == 0
    assert len(placed(sight, 9.0, now, NeighbourPoses(1))) == 0


def test_who_is_gone_is_in_the_way_where_it_was_heard_last():
    sight, now = pair(), state([0, 0, 0], time=9.0)
    told = heard([0.5, 0, 0], stamp=7.0)
    for gone in (8.5, 7.9, 7.0):
        told.lost_since[:] = gone
        assert len(placed(sight, 9.0, now, told)) == 1


def test_restarted_robot_is_in_the_way_where_it_was():
    drone, now = pair(CRAZYFLIE, CRAZYFLIE), state([0, 0, 0.1], time=9.0)
    told = heard([0.5, 0, 1.0], [0.3, 0.0, 0.0], stamp=7.0)
    assert len(placed(drone, 9.0, now, told)) == 0
    told.discard(np.array([0]))  # its new process has claimed the name, and has sent no pose
    _, near = drone.sense(9.0, now, told)
    np.testing.assert_array_equal(near.position, [[0.5, 0.0]])
    assert near.low[0] == 0.0, "it may have come down"
    assert not near.velocity.any()


def test_who_sinks_is_in_the_way_wherever_it_soon_is():
    sight, now = pair(TURTLEBOT3, CRAZYFLIE), state([0, 0, 0], time=9.0)
    hovers, sinks, old = (heard([0.1, 0, 0.9], (0, 0, v), stamp) for v, stamp in ((-0.05, 9), (-0.4, 9), (-0.4, 8)))
    assert len(placed(sight, 9.0, now, hovers)) == len(placed(sight, 9.0, now, old)) == 0
    _, near = sight.sense(9.0, now, sinks)
    np.testing.assert_allclose(near.low, [0.9 - 0.4 * DESCENT_S])
    np.testing.assert_allclose(near.high, [0.9 + CRAZYFLIE.height])


@pytest.mark.parametrize(("height", "before", "after"), [(0.0, 0, 1), (0.9, 1, 1), (1.3, 0, 0)])
def test_a_drone_that_is_gone_may_have_come_down(height, before, after):
    """It hovered at 1 m and fell silent: from then on it may be anywhere from there to the floor."""
    sight, told = pair(TURTLEBOT3 if height == 0.0 else CRAZYFLIE, CRAZYFLIE), heard([0.1, 0, 1.0], stamp=7.0)
    now = state([0, 0, height], time=9.0)
    told.lost_since[:] = 8.5  # a second of silence is borne
    assert len(placed(sight, 9.0, now, told)) == before
    told.lost_since[:] = 7.9
    _, near = sight.sense(9.0, now, told)
    assert len(near) == after
    assert near.low.tolist() == [0.0] * after
    np.testing.assert_allclose(near.high, [1.0 + CRAZYFLIE.height] * after)


def test_who_does_not_know_where_it_is_or_does_not_avoid_knows_of_nothing():
    told = heard([0.5, 0, 0])
    assert len(placed(pair(), 0.0, state([0, 0, 0]), told)) == 1
    assert len(placed(pair(), 0.0, state([np.nan, 0, 0]), told)) == 0
    assert len(placed(pair(), 0.0, state([0, 0, 0], yaw=np.nan), told)) == 0
    assert len(placed(pair(), 0.6, state([0, 0, 0]), told)) == 0
    assert len(placed(pair(avoids=np.array([False])), 0.0, state([0, 0, 0]), told)) == 0


# ---------------------------------------------------------------- what is seen


def test_a_ray_ends_where_it_points_from_the_pose_of_the_robot():
    now = state([1.0, 2.0, 0.0], yaw=0.5, rays=rays([0, 0, 0], [0.0, math.pi / 2, 1.0], [0.4, 0.9, np.nan]))
    _, near = alone().sense(0.0, now, NeighbourPoses(0))
    c, s = math.cos(0.5), math.sin(0.5)
    np.testing.assert_allclose(near.position, [[1 + 0.4 * c, 2 + 0.4 * s], [1 - 0.9 * s, 2 + 0.9 * c]])
    assert not near.radius.any()
    assert not near.is_robot.any()
    assert not near.velocity.any()
    assert len(placed(alone(), 0.0, state([0, 0, 0], rays=rays([0], [0.0], [REACH + 0.1])))) == 0


@pytest.mark.parametrize(
    "wrong",
    [
        *({"bearing": np.nan}, {"elevation": np.nan}, {"bearing": np.inf}),
        *({"distance": value} for value in (0.0, -0.1, -np.inf, 0.01)),
    ],
)
def test_a_ray_without_direction_or_length_is_no_point(wrong):
    scan = {"bearing": 1.0, "elevation": 0.0, "distance": 0.4} | wrong
    seen = rays([0, 0], [scan["bearing"], 0.0], [scan["distance"], 0.9], elevation=[scan["elevation"], 0.0])
    _, near = alone().sense(0.0, state([0.0, 0.0, 0.0], rays=seen), NeighbourPoses(0))
    assert near.position.shape == (1, 2)
    assert np.isfinite(near.position).all()


def test_what_was_seen_stays_where_it_is_while_the_robot_turns_and_drives_on():
    sight, scan = alone(), rays([0, 0], [0.0, 1.0], [0.5, 0.6], time=1.0)
    before = placed(sight, 1.0, state([0, 0, 0], time=1.0, rays=scan))
    after = placed(sight, 1.15, state([0.04, 0.01, 0], yaw=0.7, time=1.15, rays=scan))
    np.testing.assert_array_equal(after, before)
    np.testing.assert_allclose(before[0], [0.5, 0.0])


def test_rays_are_renewed_each_at_its_own_time():
    sight = alone()
    placed(sight, 1.0, state([0, 0, 0], time=1.0, rays=rays([0, 0, 0], [0, 1, 2], [0.5, 0.5, 0.5], time=1.0)))
    newer = rays([0, 0, 0], [0, 1, 2], [0.5, 0.8, 0.5], time=[1.0, 1.1, 1.0])
    seen = placed(sight, 1.1, state([0.1, 0, 0], time=1.1, rays=newer))
    expected = [[0.5, 0.0], [0.1 + 0.8 * math.cos(1), 0.8 * math.sin(1)], [0.5 * math.cos(2), 0.5 * math.sin(2)]]
    np.testing.assert_allclose(seen, expected)
    lost = rays([0, 0, 0], [0, 1, 2], [0.5, np.nan, 0.5], time=[1.0, 1.2, 1.0])
    assert len(placed(sight, 1.2, state([0.1, 0, 0], time=1.2, rays=lost))) == 2
    assert len(placed(sight, 1.3, state([0.1, 0, 0], time=1.3))) == 0


def test_a_scan_that_arrives_late_is_laid_where_the_robot_was():
    now = state([1.0, 0, 0], velocity=[0.2, 0, 0], time=5.0, rays=rays([0], [0.0], [0.5], time=4.9))
    np.testing.assert_allclose(placed(alone(), 5.0, now), [[1.48, 0.0]])


def test_old_readings_are_none():
    sight, scan = alone(), rays([0], [0.0], [0.5], time=1.0)
    assert len(placed(sight, 1.0, state([0, 0, 0], time=1.0, rays=scan))) == 1
    late = 1.0 + SCAN_S + 0.01
    assert len(placed(sight, late, state([0, 0, 0], time=late, rays=scan))) == 0


def test_rays_that_look_up_and_what_is_over_or_under_the_robot_are_left_out():
    now = state([0, 0, 1.0], rays=rays([0, 0, 0], 0.0, [0.3, 0.3, 0.3], elevation=[math.pi / 2, 0.2, -0.6]))
    _, near = alone(TELLO).sense(0.0, now, NeighbourPoses(0))
    np.testing.assert_allclose(near.position, [[0.3 * math.cos(0.2), 0.0]])
    np.testing.assert_allclose(near.low, [1.0 + 0.5 * TELLO.height + 0.3 * math.sin(0.2)])
    np.testing.assert_array_equal(near.low, near.high)


def test_a_robot_that_was_heard_is_not_seen_a_second_time():
    bearing = np.radians(np.arange(-30.0, 31.0, 5.0))
    at = np.array([0.8, 0.0])
    along = at[0] * np.cos(bearing)
    inside = TURTLEBOT3.radius**2 - (at[0] * np.sin(bearing)) ** 2
    hits = inside >= 0.0
    distance = np.where(hits, along - np.sqrt(np.maximum(inside, 0.0)) + 0.01, 1.6)  # 1 cm of noise; a wall behind it
    now = state([0, 0, 0], rays=rays([0] * len(bearing), bearing, distance))
    _, near = pair().sense(0.0, now, heard([*at, 0.0]))
    assert near.is_robot.sum() == 1
    assert (~near.is_robot).sum() == (~hits).sum() == 10
    _, near = pair().sense(0.0, now, NeighbourPoses(1))
    assert len(near) == len(bearing)
    high = pair(KHEPERA4, CRAZYFLIE).sense(0.0, now, heard([*at, 1.0]))[1]  # a drone overhead is not what the ray met
    assert len(high) == len(bearing)


def test_rows_see_for_themselves_whatever_the_order_of_their_rays():
    kinds = (KHEPERA4, KHEPERA4, TURTLEBOT3)
    net = links([(0, 2), (2, 0)], [1.0] * 2, [1.0] * 2)
    place = [[0, 0, 0], [0, 2, 0], [0.6, 0, 0]]
    told = heard([place[2], place[0]])
    row, bearing, distance = [0, 0, 2, 2, 1], [0.0, 1.0, math.pi, 2.0, 0.3], [0.5, 0.7, 0.53, 0.4, 0.2]

    def seen(order):
        scan = rays(np.array(row)[order], np.array(bearing)[order], np.array(distance)[order])
        _, near = perception(kinds, kinds, net).sense(0.0, state(place, rays=scan), told)
        return sorted(zip(near.row.tolist(), near.position.round(9).tolist(), near.is_robot.tolist(), strict=True))

    first = seen([0, 1, 2, 3, 4])
    rows = sorted((r, h) for r, _, h in first)
    assert rows == [(0, False), (0, True), (1, False), (2, False), (2, True)]
    assert seen([2, 3, 4, 0, 1]) == first
