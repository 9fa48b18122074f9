"""Every registered planner: it starts where the robot is, never jumps, never asks for more than its speed."""

from base64 import b64encode
from math import cos, dist, hypot, inf, isnan, nan, pi, sin, sqrt

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.plugins import registry
from agents.plugins.planners import Circle, Hold, Itinerary, Leg, Line, Waypoints
from tests.cases import examples

POINTS = [[0.5, 0.5], [0.5, -0.5, 0.9], [-0.5, -0.5]]
PLANS = [
    {"kind": "hold"},
    {"kind": "hold", "yaw": 1.2},
    {"kind": "line", "move_by": [0.75, 0.0], "speed": 0.15},
    {"kind": "line", "move_by": [-0.3, 0.4, 0.5], "speed": 0.2, "yaw": -1.0},
    {"kind": "waypoints", "points": POINTS, "speed": 0.3},
    {"kind": "waypoints", "points": POINTS, "speed": 0.3, "loop": True},
    {"kind": "waypoints", "points": [[0.2, 0.1]], "speed": 0.1, "loop": True},
    {"kind": "circle", "radius": 0.6, "period_s": 12.0},
    {"kind": "circle", "radius": -0.4, "period_s": 9.0, "turns": 1.25},
    {
        "kind": "recorded",
        "file": "a.csv",
        "relative": True,
        "content": b64encode(b"t,x,y\n1,0,0\n3,0.5,0.1\n3.5,0.5,-0.1\n").decode(),
    },
]
FEW, NUMBER = examples(25), st.floats(-1, 1)
ANCHOR, HEADING = st.tuples(NUMBER, NUMBER, NUMBER), st.floats(-pi, pi)
ORIGIN = (0.0, 0.0, 0.0)


def built(plan):
    return registry.build(registry.PLANNERS, plan)


def places(planner, times, anchor=ORIGIN, heading=0.0):
    return [planner.target(t, anchor, heading)[:3] for t in times]


@pytest.mark.parametrize("plan", PLANS, ids=str)
@FEW
@given(anchor=ANCHOR, heading=HEADING, begin=st.floats(0, 60))
def test_starts_where_the_robot_is_within_its_speed(plan, anchor, heading, begin):
    planner, dt = built(plan), 0.01
    start, *path = places(planner, [0.0, *(begin + dt * k for k in range(60))], anchor, heading)
    assert start == pytest.approx(anchor, abs=1e-12)
    assert max(map(dist, path, path[1:])) <= planner.speed() * dt + 1e-9
    if plan["kind"] in ("line", "circle"):  # the bound is as small as can be
        first, second = places(planner, (0.0, 1e-4), (0.3, -0.2, 0.1), 0.7)
        assert dist(first, second) / 1e-4 == pytest.approx(planner.speed(), rel=1e-6)


LINE, SQUARE = Line(move_by=[0.3, -0.4, 0.1], speed_=0.1, yaw=0.5), [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]
LENGTH_S = sqrt(0.26) / 0.1  # duration of the line
LAP_S = dict.fromkeys((2.0, 10.0, 26.0), (1.0, 0.0, 0.3))  # one lap is 4 m: eight seconds
WAYPOINTS = Waypoints(points=[[1.0, 0.0], [1.0, 2.0], [0.0, 2.0, 1.0]], speed_=0.5)


@pytest.mark.parametrize(
    ("planner", "anchor", "path"),
    [
        (LINE, (1.0, 2.0, 3.0), {0.0: (1.0, 2.0, 3.0), 0.5 * LENGTH_S: (1.15, 1.8, 3.05), LENGTH_S: (1.3, 1.6, 3.1)}),
        (LINE, (1.0, 2.0, 3.0), {1e6: (1.3, 1.6, 3.1)}),
        (WAYPOINTS, ORIGIN, {2.0: (1.0, 0.0, 0.0), 6.0: (1.0, 2.0, 0.0)}),
        (WAYPOINTS, ORIGIN, dict.fromkeys((6.0 + sqrt(8.0), 99.0), (0.0, 2.0, 1.0))),
        (Waypoints(points=SQUARE, speed_=0.5, loop=True), (2.0, 0.0, 0.3),
         {**LAP_S, 9.99: (0.995, 0.0, 0.3), 10.01: (1.0, 0.005, 0.3)}),
        (Circle(radius=0.5, period_s=4.0, turns=0.5), ORIGIN, dict.fromkeys((2.0, 50.0), (0.0, 1.0, 0.0))),
    ],
)  # fmt: skip
def test_known_places_of_a_plan(planner, anchor, path):
    for elapsed, place in path.items():
        assert planner.target(elapsed, anchor, 0.0)[:3] == pytest.approx(place, abs=1e-12)


def test_yaws_and_plans_that_stand():
    anchor = (1.0, 2.0, 0.7)
    assert [LINE.target(t, anchor, 0.0)[3] for t in (0.0, LENGTH_S, 1e6)] == pytest.approx([nan, 0.5, 0.5], nan_ok=True)
    assert Line(move_by=[0.0, 0.0], speed_=1.0, yaw=2.0).target(0.0, anchor, 0.0) == (*anchor, 2.0)
    assert Hold(at=[0.0, 0.5], yaw=0.3).target(0.0, anchor, 0.0) == (0.0, 0.5, 0.7, 0.3)
    assert Hold(at=[0.0, 0.5]).speed() == 0.0


@pytest.mark.parametrize(("radius", "side"), [(0.6, 1.0), (-0.4, -1.0)])
def test_circle_leaves_along_the_heading(radius, side):
    plan, anchor, heading = Circle(radius=radius, period_s=10.0), (0.3, -0.2, 0.5), 0.7
    path = places(plan, [0.25 * k for k in range(41)], anchor, heading)
    centre = anchor[0] - radius * sin(heading), anchor[1] + radius * cos(heading), anchor[2]
    assert [dist(place, centre) for place in path] == pytest.approx([abs(radius)] * 41, abs=1e-12)
    assert path[-1] == pytest.approx(anchor, abs=1e-12)
    x, y = path[1][0] - anchor[0], path[1][1] - anchor[1]
    assert x * cos(heading) + y * sin(heading) > 0.0
    assert (y * cos(heading) - x * sin(heading)) * side > 0.0


@pytest.mark.parametrize("radius", [None, 0.0, nan, inf])
def test_every_planner_is_tried_and_checks_parameters(radius):
    assert {plan["kind"] for plan in PLANS} == set(registry.names(registry.PLANNERS))
    wrong = {"kind": "line", "move_by": [1.0], "speed": 1.0}
    with pytest.raises(msgspec.ValidationError):
        built(wrong if radius is None else {"kind": "circle", "radius": radius, "period_s": 1.0})


def test_before_its_first_leg_a_robot_holds():
    start, legs = (0.1, 0.2, 0.3), [Leg(5.0, Line(move_by=[1.0, 0.0], speed_=0.5))]
    found = places(Itinerary(legs, holds_before=True), (-inf, 0.0, 4.9, 6.0), start, 0.4)
    assert isnan(found[0][0])
    assert found[1:] == [start, start, (0.6, 0.2, 0.3)]
    free = Itinerary(legs, holds_before=False)
    assert all(isnan(each) for t in (0.0, 4.9) for each in free.target(t, start, 0.4))
    late = Itinerary([Leg(1.0, Line(move_by=[1.0, 0.0], speed_=1.0))], holds_before=True)
    assert isnan(late.target(0.5, (nan, 0.0, 0.0), 0.0)[0])  # it waits for a known place
    assert hypot(*late.target(1.5, ORIGIN, 0.0)[:2]) == 0.5


def test_leg_begins_where_the_last_one_ends():
    legs = [Leg(0.0, Line(move_by=[1.0, 0.0], speed_=0.5, yaw=1.5)), Leg(4.0, Circle(radius=0.5, period_s=4.0))]
    itinerary, lost = Itinerary(legs, holds_before=True), (9.0, 9.0, 9.0)
    assert itinerary.target(0.0, ORIGIN, 0.0)[:3] == ORIGIN
    assert itinerary.target(3.0, lost, 1.0)[3] == 1.5
    *place, yaw = itinerary.target(6.0, lost, 0.2)
    # half a turn to the left of the heading that the line asked for, from its end
    assert place == pytest.approx([1.0 - 1.0 * sin(1.5), cos(1.5), 0.0], abs=1e-12)
    assert isnan(yaw)
    assert itinerary.origin == (0.0, 0.0, 0.0, 0.0)
