"""Every registered planner: it starts where the robot is, never jumps, never asks for more than its speed."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.plugins import registry
from agents.plugins.planners import Circle, Hold, Itinerary, Leg, Lemniscate, Line, Waypoints

PLANS = [
    {"kind": "hold"},
    {"kind": "hold", "yaw": 1.2},
    {"kind": "line", "move_by": [0.75, 0.0], "speed": 0.15},
    {"kind": "line", "move_by": [-0.3, 0.4, 0.5], "speed": 0.2, "yaw": -1.0},
    {"kind": "waypoints", "points": [[0.5, 0.5], [0.5, -0.5, 0.9], [-0.5, -0.5]], "speed": 0.3},
    {"kind": "waypoints", "points": [[0.5, 0.5], [0.5, -0.5, 0.9], [-0.5, -0.5]], "speed": 0.3, "loop": True},
    {"kind": "waypoints", "points": [[0.2, 0.1]], "speed": 0.1, "loop": True},
    {"kind": "circle", "radius": 0.6, "period_s": 12.0},
    {"kind": "circle", "radius": -0.4, "period_s": 9.0, "turns": 1.25},
    {"kind": "lemniscate", "size": 0.5, "period_s": 15.0},
]
FEW = settings(max_examples=15)
SEEDS = st.integers(0, 2**32 - 1)


def built(plan):
    return registry.build(registry.PLANNERS, plan)


def anchors(seed, rows=3):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (rows, 3)), rng.uniform(-math.pi, math.pi, rows)


def path(planner, times, anchor, heading):
    """(T, R, 3) and (T, R)."""
    found = [planner.target(np.full(len(anchor), t), anchor, heading) for t in times]
    return np.array([position for position, _ in found]), np.array([yaw for _, yaw in found])


def test_every_registered_planner_is_tried_here():
    assert {plan["kind"] for plan in PLANS} == set(registry.names(registry.PLANNERS))


@pytest.mark.parametrize("plan", PLANS, ids=str)
@FEW
@given(seed=SEEDS)
def test_it_starts_where_the_robot_is(plan, seed):
    anchor, heading = anchors(seed)
    kept = anchor.copy(), heading.copy()
    position, _ = built(plan).target(np.zeros(3), anchor, heading)
    np.testing.assert_allclose(position, anchor, atol=1e-12)
    np.testing.assert_array_equal(anchor, kept[0])
    np.testing.assert_array_equal(heading, kept[1])


@pytest.mark.parametrize("plan", PLANS, ids=str)
@FEW
@given(seed=SEEDS, begin=st.floats(0, 60))
def test_it_never_asks_for_more_than_its_speed(plan, seed, begin):
    planner, dt = built(plan), 0.01
    position, _ = path(planner, begin + dt * np.arange(60), *anchors(seed))
    step = np.linalg.norm(np.diff(position, axis=0), axis=2)
    assert (step <= planner.speed() * dt + 1e-9).all()


@pytest.mark.parametrize("plan", [plan for plan in PLANS if plan["kind"] in ("line", "circle", "lemniscate")], ids=str)
def test_its_speed_is_no_larger_than_it_must_be(plan):
    planner, dt = built(plan), 1e-4
    position, _ = path(planner, dt * np.arange(3), *anchors(1))
    speed = np.linalg.norm(np.diff(position, axis=0), axis=2) / dt
    np.testing.assert_allclose(speed, planner.speed(), rtol=1e-6)


@pytest.mark.parametrize("plan", PLANS, ids=str)
@FEW
@given(seed=SEEDS)
def test_rows_are_led_as_if_each_were_alone(plan, seed):
    planner, (anchor, heading) = built(plan), anchors(seed)
    elapsed = np.random.default_rng(seed).uniform(0, 40, 3)
    position, yaw = planner.target(elapsed, anchor, heading)
    for row in range(3):
        one = slice(row, row + 1)
        mine, toward = planner.target(elapsed[one], anchor[one], heading[one])
        np.testing.assert_array_equal(mine[0], position[row])
        np.testing.assert_array_equal(toward[0], yaw[row])


def test_a_line_ends_exactly_and_stays():
    line = Line(move_by=[0.3, -0.4, 0.1], speed_=0.1, yaw=0.5)
    length = math.sqrt(0.26)
    anchor = np.array([[1.0, 2.0, 3.0]] * 4)
    times = np.array([0.0, 0.5 * length / 0.1, length / 0.1, 1e6])
    position, yaw = line.target(times, anchor, np.zeros(4))
    np.testing.assert_allclose(position - anchor, np.outer([0, 0.5, 1, 1], [0.3, -0.4, 0.1]), atol=1e-12)
    np.testing.assert_array_equal(yaw, [np.nan, np.nan, 0.5, 0.5])


def test_a_line_of_no_length_stays():
    position, yaw = Line(move_by=[0.0, 0.0], speed_=1.0, yaw=2.0).target(np.zeros(1), np.ones((1, 3)), np.zeros(1))
    np.testing.assert_array_equal(position, np.ones((1, 3)))
    np.testing.assert_array_equal(yaw, [2.0])


def test_hold_stands_where_it_is_told():
    anchor = np.array([[1.0, 2.0, 0.7]])
    position, yaw = Hold(at=[0.0, 0.5], yaw=0.3).target(np.zeros(1), anchor, np.zeros(1))
    np.testing.assert_array_equal(position, [[0.0, 0.5, 0.7]])
    np.testing.assert_array_equal(yaw, [0.3])
    assert Hold(at=[0.0, 0.5]).speed() == 0.0


def test_waypoints_pass_through_their_points_at_constant_speed():
    plan = Waypoints(points=[[1.0, 0.0], [1.0, 2.0], [0.0, 2.0, 1.0]], speed_=0.5)
    anchor = np.array([[0.0, 0.0, 0.0]])
    times = np.array([2.0, 6.0, 6.0 + math.sqrt(2) / 0.5, 99.0])
    position, _ = path(plan, times, anchor, np.zeros(1))
    np.testing.assert_allclose(position[:, 0], [[1, 0, 0], [1, 2, 0], [0, 2, 1], [0, 2, 1]], atol=1e-12)


def test_waypoints_loop_without_the_way_to_the_first():
    plan = Waypoints(points=[[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]], speed_=0.5, loop=True)
    anchor = np.array([[2.0, 0.0, 0.3]])
    position, _ = path(plan, 2.0 + 8.0 * np.arange(4), anchor, np.zeros(1))  # one lap is 4 m: eight seconds
    np.testing.assert_allclose(position, np.tile([1.0, 0.0, 0.3], (4, 1, 1)), atol=1e-12)
    before, after = path(plan, np.array([9.99, 10.01]), anchor, np.zeros(1))[0]
    np.testing.assert_allclose(before[0], [0.995, 0.0, 0.3], atol=1e-12)
    np.testing.assert_allclose(after[0], [1.0, 0.005, 0.3], atol=1e-12)


@pytest.mark.parametrize(("radius", "side"), [(0.6, 1.0), (-0.4, -1.0)])
def test_a_circle_has_its_radius_and_leaves_along_the_heading(radius, side):
    plan = Circle(radius=radius, period_s=10.0)
    anchor, heading = anchors(5)
    position, _ = path(plan, np.linspace(0, 10, 41), anchor, heading)
    centre = anchor[:, :2] + radius * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(position[..., :2] - centre, axis=2), abs(radius), atol=1e-12)
    np.testing.assert_allclose(position[-1], anchor, atol=1e-12)
    np.testing.assert_allclose(position[..., 2], np.tile(anchor[:, 2], (41, 1)))
    first = position[1, :, :2] - anchor[:, :2]
    ahead = first[:, 0] * np.cos(heading) + first[:, 1] * np.sin(heading)
    left = first[:, 1] * np.cos(heading) - first[:, 0] * np.sin(heading)
    assert (ahead > 0).all()
    assert (np.sign(left) == side).all()


def test_a_circle_ends_after_its_turns():
    plan = Circle(radius=0.5, period_s=4.0, turns=0.5)
    position, _ = path(plan, np.array([2.0, 50.0]), np.zeros((1, 3)), np.zeros(1))
    np.testing.assert_allclose(position[:, 0], [[0.0, 1.0, 0.0]] * 2, atol=1e-12)


@pytest.mark.parametrize("radius", [0.0, math.nan, math.inf])
def test_a_circle_needs_a_radius(radius):
    with pytest.raises(ValueError, match="`radius` must be a number other than 0"):
        Circle(radius=radius, period_s=1.0)


def test_a_lemniscate_crosses_its_centre_twice_and_is_as_long_as_asked():
    plan = Lemniscate(size=0.5, period_s=8.0)
    anchor, heading = np.array([[0.2, 0.1, 0.8]]), np.array([0.7])
    position, _ = path(plan, np.array([0.0, 4.0, 8.0]), anchor, heading)
    np.testing.assert_allclose(position, np.tile(anchor, (3, 1, 1)), atol=1e-12)
    dense, _ = path(plan, np.linspace(0, 8, 801), anchor, heading)
    assert np.linalg.norm(dense - anchor, axis=2).max() == pytest.approx(0.5, abs=1e-9)
    first = dense[1, 0] - anchor[0]
    assert math.atan2(first[1], first[0]) == pytest.approx(0.7, abs=1e-2)


@pytest.mark.parametrize("plan", [{"kind": "line", "move_by": [1.0], "speed": 1.0}, {"kind": "circle", "radius": 1.0}])
def test_parameters_are_checked(plan):
    with pytest.raises(msgspec.ValidationError):
        built(plan)


# ---------------------------------------------------------------- itineraries


def journey(itinerary, times, position, yaw):
    found = [itinerary.target(np.full(len(position), t), position, yaw) for t in times]
    return np.array([place for place, _ in found]), np.array([toward for _, toward in found])


@FEW
@given(st.lists(st.sampled_from(range(len(PLANS))), min_size=1, max_size=4), SEEDS)
def test_legs_follow_one_another_without_a_jump(chosen, seed):
    legs = [Leg(1.0 + 2.3 * k, built(PLANS[plan])) for k, plan in enumerate(chosen)]
    start, yaw = anchors(seed, 2)
    itinerary = Itinerary(np.arange(2), legs, holds_before=True)
    times = np.arange(0.0, 13.0, 0.02)
    fastest = max(leg.planner.speed() for leg in legs)
    place, _ = journey(itinerary, times, start, yaw)
    np.testing.assert_allclose(place[0], start)
    assert np.linalg.norm(np.diff(place, axis=0), axis=2).max() <= fastest * 0.02 + 1e-9
    late, _ = journey(Itinerary(np.arange(2), legs, holds_before=True), times[-1:], start, yaw)
    np.testing.assert_allclose(late[0], place[-1], atol=1e-12)  # who joins late does not begin from the beginning


def test_before_the_first_leg_rows_hold_or_have_no_target():
    start, yaw = np.array([[0.1, 0.2, 0.3]]), np.array([0.4])
    legs = [Leg(5.0, Line(move_by=[1.0, 0.0], speed_=0.5))]
    holds, _ = journey(Itinerary(np.arange(1), legs, holds_before=True), [0.0, 4.9, 6.0], start, yaw)
    np.testing.assert_allclose(holds[:, 0], [start[0], start[0], start[0] + [0.5, 0, 0]])
    free, _ = journey(Itinerary(np.arange(1), legs, holds_before=False), [0.0, 4.9], start, yaw)
    assert np.isnan(free).all()
    waiting, _ = journey(Itinerary(np.arange(1), legs, holds_before=True), [-np.inf], start, yaw)
    assert np.isnan(waiting).all()


def test_a_leg_begins_where_the_one_before_ends_whatever_the_robot_did():
    legs = [Leg(0.0, Line(move_by=[1.0, 0.0], speed_=0.5, yaw=1.5)), Leg(4.0, Circle(radius=0.5, period_s=4.0))]
    itinerary = Itinerary(np.arange(1), legs, holds_before=True)
    first, yaw = itinerary.target(np.array([0.0]), np.zeros((1, 3)), np.zeros(1))
    np.testing.assert_array_equal(first, np.zeros((1, 3)))
    lost = np.array([[9.0, 9.0, 9.0]])
    assert itinerary.target(np.array([3.0]), lost, np.ones(1))[1] == [1.5]
    place, yaw = itinerary.target(np.array([6.0]), lost, np.array([0.2]))
    # half a turn to the left of the heading that the line asked for, from its end
    np.testing.assert_allclose(place[0], [1.0 - 1.0 * math.sin(1.5), math.cos(1.5), 0.0], atol=1e-12)
    assert np.isnan(yaw).all()


def test_rows_may_be_at_different_times():
    legs = [Leg(1.0, Line(move_by=[1.0, 0.0], speed_=1.0)), Leg(3.0, Line(move_by=[0.0, 1.0], speed_=1.0))]
    itinerary = Itinerary(np.arange(3), legs, holds_before=True)
    place, _ = itinerary.target(np.array([0.5, 1.5, 3.5]), np.zeros((3, 3)), np.zeros(3))
    np.testing.assert_allclose(place, [[0, 0, 0], [0.5, 0, 0], [1.0, 0.5, 0.0]])
