"""Distances between surfaces, and what touched, against geometry by hand."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from agents.network.messages import Contact
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.turtlebot3.kind import TURTLEBOT3
from experiments.definition.experiment import Arena
from experiments.metrics.clearance import Clearance, collisions
from experiments.metrics.results import Approach, Collision
from tests.experiments.traces import STEP, at_origin, trace
from twins.scene import Obstacle

R = KHEPERA4.radius
WALLED = Arena(size=(10.0, 10.0, 3.0))
ROOM = Arena(size=WALLED.size, walls=False)
T = np.arange(0.0, 4.0 + STEP / 2, STEP)


def passing(way, kinds=("khepera4", "khepera4"), arena=ROOM):
    """One robot at the origin, and one whose place (T, 3) is given."""
    what = at_origin({"A": kinds[0], "B": kinds[1]}, {"A - B": 1.0}, arena=arena)
    place = np.zeros((len(way), 2, 3))
    place[:, 1] = way
    return trace(what, place)


def along_x(x, height=0.0):
    return np.column_stack([x, 0.0 * x, 0.0 * x + height])


def alone(way, arena, kind="khepera4"):
    return trace(at_origin({"A": kind}, {}, arena=arena), np.asarray(way, dtype=float).reshape(-1, 1, 3))


def test_closest_approach_of_surfaces_has_time_and_names():
    found = Clearance.of_trace(passing(along_x(0.3 + 0.2 * np.cos(T))))
    how = pytest.approx(0.1 - 2.0 * R, abs=1e-5), pytest.approx(math.pi, abs=STEP)
    assert found.robots == (Approach(("A", "B"), *how), Approach(("B", "A"), *how))
    assert found.arena == (None, None)


def test_each_contact_is_one_collision_with_greatest_depth():
    found = Clearance.of_trace(passing(along_x(0.14 + 0.05 * np.cos(2.0 * np.pi * T))))
    depth = pytest.approx(0.05, abs=1e-5)
    assert found.overlaps == tuple(Collision(pytest.approx(k + 0.26), "A", "B", None, depth) for k in range(4))
    apart = Clearance.of_trace(passing(along_x(np.full_like(T, 2.0 * R))))
    assert apart.overlaps == ()  # they stand side by side


def test_drone_over_ground_robot_is_its_height_away():
    kinds, gap = ("turtlebot3", "crazyflie"), 0.5 - TURTLEBOT3.height
    away = pytest.approx(math.hypot(0.5 - CRAZYFLIE.radius - TURTLEBOT3.radius, gap))
    above, beside, into = (
        Clearance.of_trace(passing(along_x(np.full(50, x), z), kinds))
        for x, z in ((0.02, 0.5), (0.5, 0.5), (0.02, TURTLEBOT3.height - 0.5 * CRAZYFLIE.height))
    )
    assert (above.robots[0].gap, above.overlaps, beside.robots[0].gap) == (pytest.approx(gap), (), away)
    assert into.overlaps == (Collision(0.0, "A", "B", None, pytest.approx(0.5 * CRAZYFLIE.height)),)


def obstacles(**named):
    return msgspec.structs.replace(ROOM, obstacles=named)


POST, BOX = Obstacle(radius=0.2, at=(1.0, 0.0)), Obstacle(box=(0.4, 0.2), at=(1.0, 0.0), yaw=math.pi / 2)
FENCE = Obstacle(wall=[(0.0, -1.0), (0.0, 0.0), (1.0, 0.0)], at=(1.0, 0.0))


@pytest.mark.parametrize(
    ("thing", "place", "gap"),
    [
        (POST, (1.0, -0.5), 0.3 - R),
        (BOX, (1.0, 0.5), 0.3 - R),
        (BOX, (1.4, 0.6), math.hypot(0.3, 0.4) - R),
        (BOX, (1.05, 0.05), -0.05 - R),
        (FENCE, (1.4, 0.3), 0.3 - R),
        (FENCE, (2.3, 0.4), 0.5 - R),
        (FENCE, (1.02, -0.5), 0.02 - R),
        (msgspec.structs.replace(POST, height=0.5, bottom=0.3), (1.0, 0.0), 0.3 - KHEPERA4.height),
    ],
)
def test_distance_to_what_stands_in_the_arena(thing, place, gap):
    found = Clearance.of_trace(alone([(*place, 0.0)] * 3, obstacles(thing=thing)))
    assert found.arena == (Approach(("A", "thing"), pytest.approx(gap), 0.0),)
    assert [each.overlap for each in found.overlaps] == [pytest.approx(-gap)] * (gap < 0.0)


def test_what_moves_is_where_it_is_then():
    plan = {"kind": "line", "move_by": [-2.0, 0.0], "speed": 0.5}
    arena = obstacles(cart=msgspec.structs.replace(POST, plan=plan), stone=Obstacle(radius=0.1, at=(0.0, 2.0)))
    found = Clearance.of_trace(alone(np.zeros((len(T), 3)), arena))
    at = pytest.approx(1.46, abs=1.01 * STEP)
    assert found.overlaps == (Collision(at, "A", "cart", None, pytest.approx(0.2 + R)),)
    assert found.arena[0] == Approach(("A", "cart"), pytest.approx(-0.2 - R), pytest.approx(2.0))


@pytest.mark.parametrize(("x", "y", "gap"), [(1.5, 0.3, 1.0), (-2.4, 0.0, 0.1), (0.0, -1.1, 0.4), (0.2, 1.6, -0.1)])
def test_distance_to_the_walls(x, y, gap):
    found = Clearance.of_trace(alone([(x, y, 0.0)] * 2, Arena(size=(5.0, 3.0, 2.0), walls=True)))
    assert (found.arena, len(found.overlaps)) == ((Approach(("A", "wall"), pytest.approx(gap - R), 0.0),), gap < R)


def test_what_is_unknown_touches_nothing():
    way = along_x(np.full_like(T, 0.1))
    way[50:100] = np.nan
    found = Clearance.of_trace(passing(way, arena=WALLED))
    assert [each.time_s for each in found.overlaps] == [0.0, pytest.approx(2.0)]
    nobody = Clearance.of_trace(passing(np.full_like(way, np.nan), arena=WALLED))
    assert (nobody.robots, nobody.arena[1], nobody.overlaps) == ((None, None), None, ())


def with_contacts(known, *contacts, clock="virtual", **bodies):
    robots = known.plan.experiment.robots.items()
    made = {name: msgspec.structs.replace(robot, body=bodies.get(name, "twin")) for name, robot in robots}
    return dataclasses.replace(known, plan=known.plan.changed(robots=made), contacts=contacts, clock=clock)


def test_what_an_engine_saw_stands_for_what_overlaps():
    known = passing(along_x(np.full_like(T, 0.1)))
    seen = with_contacts(known, Contact(1.5, "B", "wall", 0.2, 0.001), Contact(0.5, "A", "B", 0.1, 0.0005))
    in_world = with_contacts(known, clock="real", A="world")
    by_position = with_contacts(known, clock="real")  # without a world nothing sees contacts
    found = [collisions(each, Clearance.of_trace(each)) for each in (seen, with_contacts(known), in_world)]
    assert found == [(Collision(0.5, "A", "B", 0.1, 0.0005), Collision(1.5, "B", "wall", 0.2, 0.001)), (), ()]
    for each in (known, by_position):
        assert [blow.time_s for blow in collisions(each, Clearance.of_trace(each))] == [0.0]


def test_pushed_obstacle_is_no_longer_where_it_stood():
    box = obstacles(box=Obstacle(radius=0.2, at=(0.1, 0.0), mass=0.5))
    known = alone(np.zeros((5, 3)), box)
    assert len(Clearance.of_trace(known).overlaps) == 1  # nothing can push it without an engine that sees contacts
    assert Clearance.of_trace(with_contacts(known)).arena == (None,)
