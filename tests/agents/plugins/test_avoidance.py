"""Avoidances: the potential of the paper, and the barrier, which finds the nearest allowed velocity, exactly."""

from dataclasses import replace
from math import cos, dist, hypot, inf, isfinite, pi, sin, sqrt

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.optimize import linprog

from agents.body.kinds import KINDS
from agents.plugins.avoidance import Nearby, Potential, measure_gap
from agents.plugins.barrier import Barrier, closest
from agents.plugins.registry import AVOIDANCES, build
from agents.vectors import ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from bridges.tello.kind import TELLO
from bridges.turtlebot3.kind import TURTLEBOT3
from experiments.definition.plan import Plan
from tests.agents.bench import NOTHING, Bench, near, own
from tests.cases import examples, for_each
from tests.small import pair

QUICK = Potential(velocity=0.2, period_s=0.1)  # h v = 0.02 m
HERE = own(TELLO, (0.0, 0.0, 1.0))


@pytest.mark.parametrize("gap", [0.02, 0.1, 0.15, 0.29])
def test_push_is_minus_the_gradient_of_equation_2(gap):
    potential = Potential(strength=2e-4)
    assert potential.push(gap) == pytest.approx(2e-4 * (1 / gap - 1 / 0.3) / gap**2)
    assert potential.push(0.31) == 0.0


def test_goal_is_shifted_along_the_force():
    things, goal = near((0.3, 0.0), (0.0, 0.3)), (-0.02, -0.01, 1.0)
    for potential, way in ((QUICK, 0.02), (Potential(), 1.0)):  # usual: h = 1/response = 1 s, v = 1 m/s: its limit
        shifted = potential.deviate(goal, HERE, things, 0.01)
        assert shifted == pytest.approx((-0.02 - way / sqrt(2), -0.01 - way / sqrt(2), 1.0), abs=1e-12)
    for gap, share in ((0.25, 1.0), (0.1, 1.0), (0.3 - 1e-9, 0.0), (0.28, 0.28471)):  # it grows within a layer
        # (1/0.28 - 1/0.3)/0.28² over (1/0.25 - 1/0.3)/0.25²
        shifted = QUICK.deviate((0.0, 0.0, 1.0), HERE, near((TELLO.radius + gap, 0.0)), 0.01)
        assert shifted == pytest.approx((-0.02 * share, 0.0, 1.0), abs=2e-7)


def test_goal_behind_a_thing_pulls_aside():
    for goal, aside in (
        ((0.5, 0.0), -0.05),  # straight ahead: to the right, by a tenth of the pull
        ((0.5, 0.02), -0.05),  # nearly so
        ((0.5, 0.03), 0.05),  # to the left is nearer
        ((0.5, -0.2), -0.05),
        ((-0.5, 0.1), 0.0),  # away from the thing
    ):
        x, y, _ = QUICK.deviate((*goal, 1.0), HERE, near((0.2, 0.0)), 0.01)
        assert (x, y) == pytest.approx((goal[0] - 0.02, goal[1] + aside), abs=1e-12)


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3, CRAZYFLIE, TELLO])
def test_push_is_strongest_near_and_none_far(kind):
    here, goal = own(kind, (0.0, 0.0)), (0.05, 0.0, 0.0)

    def deviate(goal, *distances):
        return Potential().deviate(goal, here, near(*((kind.radius + each, 0.0) for each in distances)), 0.01)

    assert deviate((50.0, 0.0, 0.0), 0.2)[0] == pytest.approx(0.0, abs=1e-12)  # no goal pulls harder
    assert deviate(goal, 0.2)[0] < -0.1
    assert deviate(goal, 0.31) is deviate(goal) is goal
    assert all(map(isfinite, deviate(ZERO, -kind.radius)))  # in the same place


@for_each("kind, gap, acts", [("potential", 1.0, False), ("potential", 0.01, True), (None, 0.01, False)])
def test_avoidance_acts_near_others_alone(kind, gap, acts):
    """A Khepera with its neighbour beside it, where both want to be."""
    far = 0.14 + gap
    assignment = Plan(pair(avoidance={"kind": "barrier", "hears": "all"})).assignment("A")
    links = tuple(msgspec.structs.replace(link, distance=far) for link in assignment.neighbours)
    avoidance = kind and build(AVOIDANCES, {"kind": kind, "hears": "all"})
    bench = Bench(replace(assignment, avoidance=avoidance, neighbours=links, start=None, starts=()), ZERO)
    robot = bench.running(lambda bench: bench.hear(0, (far, 0.0, 0.0))).robot
    assert robot.avoided == acts
    assert robot.setpoint[0] < 0.0 if acts else robot.setpoint == (0.0, 0.0, 0.0, 0.0)
    assert robot.goal == pytest.approx(ZERO)  # that of the decision itself is not shifted


EVERY_KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
MANY, ROUNDING, BARRIER = examples(400), 1e-7, Barrier()  # rounding in [m/s]
# bearings that face each other or are alike, or differ enough for a test to know whether there is a common point
BEARING = st.integers(-720, 720).map(lambda number: number * pi / 720)
NUMBER, PLANE = st.floats(-1.5, 1.5), st.tuples(BEARING, st.floats(-0.5, 1.0))
PLANES, WANTED = st.lists(PLANE, min_size=1, max_size=12), st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
STILL = (0.0, 0.0, 0.0, 0.0)


def scene(things, **robot):
    """Things at x, y [m] with a velocity [m/s], which move if they are robots."""
    made = near(*((x, y) for x, y, *_ in things), **robot)
    for thing, (_, _, velocity, is_robot) in zip(made.things, things, strict=False):
        thing.is_robot = is_robot
        if is_robot:
            thing.velocity_x, thing.velocity_y = velocity
    return made


def nearest(wanted, planes, speed=inf):
    """Result of the quadratic program for half-planes, each an angle and a bound."""
    space = Nearby()
    space.reserve(len(planes))
    space.count = len(planes)
    for plane, (angle, bound) in zip(space.planes, planes, strict=False):
        plane.x, plane.y, plane.b = cos(angle), sin(angle), bound
    return closest(*wanted, speed, space)


def violation(point, planes):
    return max(cos(angle) * point[0] + sin(angle) * point[1] - bound for angle, bound in planes)


def half_planes(planes):
    angle, bound = (np.array(column) for column in zip(*planes, strict=True))
    return np.stack([np.cos(angle), np.sin(angle)], axis=1), bound


def least_speed(planes):
    """Norm of the slowest velocity that obeys half-planes, by trying all corners and feet; infinite: there is none."""
    normal, bound = half_planes(planes)
    i, j = np.triu_indices(len(planes), 1)
    sine = normal[i, 0] * normal[j, 1] - normal[i, 1] * normal[j, 0]
    known = np.abs(sine) > 1e-6
    i, j, sine = i[known], j[known], sine[known]
    corner = np.stack([bound[i] * normal[j, 1] - bound[j] * normal[i, 1],
                       bound[j] * normal[i, 0] - bound[i] * normal[j, 0]], axis=1) / sine[:, None]  # fmt: skip
    points = np.concatenate([np.zeros((1, 2)), bound[:, None] * normal, corner])
    allowed = (points @ normal.T <= bound + 1e-12 * (1.0 + np.abs(points).max(axis=1, keepdims=True))).all(axis=1)
    return np.linalg.norm(points[allowed], axis=1).min(initial=inf)


def least_violation(planes):
    """Least of the largest violation of bounds below 0, while the others are obeyed [m/s]."""
    normal, bound = half_planes(planes)
    shared = -(bound < 0.0).astype(float)
    found = linprog([0, 0, 1], np.column_stack([normal, shared]), bound, bounds=[(None, None)] * 2 + [(0, None)])
    assert found.success
    return found.fun


def holds(found, planes, speed):
    """Promises about a velocity for half-planes and a limit of speed."""
    assert hypot(*found) <= speed * (1.0 + 1e-12)
    standing = [plane for plane in planes if plane[1] >= 0.0]
    assert not standing or violation(found, standing) <= ROUNDING
    slowest = least_speed(planes)
    if slowest < inf and slowest <= speed - ROUNDING:
        assert violation(found, planes) <= ROUNDING
    elif ROUNDING + speed < slowest < inf:  # too quick to flee from: every bound below 0 is kept by the same share
        assert violation(nearest(found, planes), planes) <= ROUNDING
    elif slowest == inf and hypot(*found) < speed - ROUNDING:
        assert violation(found, planes) <= least_violation(planes) + 2.0 * ROUNDING  # two opposite bounds


@MANY
@given(PLANES, WANTED, st.one_of(st.floats(0.05, 2.0), st.just(inf)))
@example([(0.0, 0.0), (0.125, 0.0), (2.75, 0.1)], (0.0, 0.0), TELLO.speed)
def test_half_planes_are_obeyed_if_possible(planes, wanted, speed):
    holds(nearest(wanted, planes, speed), planes, speed)


@MANY
@given(PLANES, WANTED)
def test_no_allowed_velocity_is_nearer(planes, wanted):
    normal, bound = half_planes(planes)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.5, 1.5, 101)] * 2), axis=-1).reshape(-1, 2)
    grid = grid[(np.linalg.norm(grid, axis=1) <= 1.5) & (grid @ normal.T <= bound).all(axis=1)]
    least = np.linalg.norm(grid - wanted, axis=1).min(initial=inf)
    assert dist(nearest(wanted, planes, 1.5), wanted) <= least + ROUNDING


def test_nearest_velocities_that_are_known():
    for wanted, speed, planes, found in (
        ((0.1, 1 / 3), inf, [(0.0, 0.3), (2.0, 0.4)], (0.1, 1 / 3)),
        ((1.0, 1.0), inf, [(0.0, 0.1), (0.5 * pi, 0.2)], (0.1, 0.2)),  # a corner
        ((1.0, 1.0), 0.5, [(0.0, 0.3)], (0.3, 0.4)),  # on the border at full speed
        ((0.0, 0.0), inf, [(0.0, -0.1), (pi, -0.3)], (0.1, 0.0)),  # the least violation of both
        ((0.0, 1.0), inf, [(0.0, -0.4), (pi, 0.3), (pi, 0.2)], (-0.2, 1.0)),  # a bound above 0 does not give way
        ((1.0, 1.0), inf, [(k * pi / 1.5, -0.2) for k in range(3)], (0.0, 0.0)),
    ):
        assert nearest(wanted, planes, speed) == pytest.approx(found, abs=1e-6)
    free = nearest((1.0, 1.0), [(0.7, -2.0)])  # too fast to flee from: the direction is kept at full speed
    share = 0.5 / hypot(*free)
    assert nearest((1.0, 1.0), [(0.7, -2.0)], 0.5) == pytest.approx((share * free[0], share * free[1]), abs=1e-7)


def test_bound_is_half_the_gap_or_less():
    here, place = own(TELLO, (0.0, 0.0, 1.0), velocity=(0.3, 0.0, 0.0)), TELLO.radius + CRAZYFLIE.radius + 0.05 + 0.4
    left = 0.4 - 0.3 * TELLO.lag
    closer = left - 0.2 * CRAZYFLIE.lag

    def bound(**given):
        (thing,) = near((place, 0.0), radius=CRAZYFLIE.radius, **given).things
        measure_gap(here, thing)
        assert (thing.away_x, thing.away_y) == (-1.0, 0.0)
        return BARRIER.bound(thing, 1.0)

    robot = {"is_robot": True, "lag": CRAZYFLIE.lag}
    assert bound() == pytest.approx(0.5 * 3.0 * left)
    assert bound(velocity=(0.2, 0.0), **robot) == pytest.approx(1.5 * left)
    assert bound(velocity=(-0.2, 0.7), **robot) == pytest.approx(min(1.5 * closer, 3.0 * closer - 0.2))


@pytest.mark.parametrize("kind", [TELLO, CRAZYFLIE])
def test_velocities_and_positions_are_restrained_alike(kind):
    here, (x, y) = own(kind, (0.2, -0.1, 1.0)), (0.4, 0.3)
    thing = near((0.2 + kind.radius + 0.05 + 0.1, -0.1))
    setpoint = (x, y, 0.1, 0.2) if kind is TELLO else (0.2 + x / kind.response, -0.1 + y / kind.response, 1.1, 0.2)
    a, b, *rest = Barrier(right=0.0).restrain(setpoint, here, thing)
    u = (a, b) if kind is TELLO else (kind.response * (a - 0.2), kind.response * (b + 0.1))
    assert u == pytest.approx((0.15, 0.3), abs=1e-9)
    assert tuple(rest) == setpoint[2:]


@for_each("yaw", [-3.1 + 0.31 * k for k in range(21)])
def test_wheels_are_slowed_along_their_heading(yaw):
    reach, here = KHEPERA4.radius + 0.05, own(KHEPERA4, (0.0, 0.0), yaw=yaw)
    v, *rest = BARRIER.restrain((0.25, 3.0, 0.0, 0.0), here, near((reach + 0.06, 0.0)))
    assert v == pytest.approx(0.25 if 0.25 * cos(yaw) <= 0.09 else 0.09 / cos(yaw))
    assert rest == [3.0, 0.0, 0.0]  # it may always turn
    assert BARRIER.restrain((0.25, 3.0, 0.0, 0.0), here, near((reach, 0.0)))[0] * cos(yaw) <= 1e-9


def test_wheels_back_off_and_stand_where_torn():
    here, inside = own(KHEPERA4, (0.0, 0.0)), KHEPERA4.radius + 0.03  # 2 cm of the margin are used up
    assert -0.06 <= BARRIER.restrain(STILL, here, near((inside, 0.0)))[0] < -0.05
    assert BARRIER.restrain((0.2, 0.0, 0.0, 0.0), here, near((inside, 0.0), (-inside, 0.0)))[0] == 0.0
    fast = near((0.3, 0.0), velocity=(-2.0, 0.0), is_robot=True)
    assert BARRIER.restrain(STILL, here, fast)[0] == -KHEPERA4.speed


@EVERY_KIND
@examples(50)
@given(
    pose=st.tuples(*[st.tuples(*[NUMBER] * 3)] * 2, st.floats(-7, 7)),
    things=st.lists(st.tuples(NUMBER, NUMBER, st.tuples(NUMBER, NUMBER), st.booleans()), max_size=12),
    setpoint=st.tuples(*[NUMBER] * 4),
    parameters=st.fixed_dictionaries({"right": st.floats(0, 2), "alpha": st.floats(0.1, 10)}),
)
def test_results_are_numbers_within_the_limits(kind, pose, things, setpoint, parameters):
    place, velocity, yaw = pose
    here, barrier = own(kind, place, yaw=yaw, velocity=velocity), Barrier(**parameters)
    around = scene(things, radius=0.1) if things else NOTHING
    out = barrier.restrain(setpoint, here, around)
    goal = barrier.deviate((place[0] + 0.1, place[1], place[2]), here, around, 0.01)
    assert all(map(isfinite, (*out, *goal)))
    assert out[1 if here.by_twist else 2 :] == setpoint[1 if here.by_twist else 2 :]
    u = out[:1] if here.by_twist else out[:2]
    if here.by_position:
        u = (kind.response * (out[0] - place[0]), kind.response * (out[1] - place[1]))
    assert out == setpoint or hypot(*u) <= kind.speed * (1 + 1e-9)
    assert things or out == setpoint


@EVERY_KIND
@for_each("exponent", range(2, 39))
def test_absurd_velocities_are_answered_within_limits(kind, exponent):
    """Beyond 1e8 m/s no half-plane is met exactly, and one alone has no pair that it could give way to."""
    here = own(kind, (0.0, 0.0), velocity=(-(10.0**exponent), 0.0, 0.0))
    out = BARRIER.restrain((-1.0, 0.0, 0.0, 0.0), here, near((-0.5, 0.07), radius=0.07, is_robot=True, lag=0.1))
    assert all(map(isfinite, out))
    assert hypot(*out[:2]) * (kind.response if kind.takes == "position" else 1.0) <= kind.speed + 1e-9


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_robots_are_dodged_sideways(side):
    """Without the preference for the right two that meet head on would stand."""
    comes = near((0.6, -0.05 * side), velocity=(-0.8, 0.0), radius=0.1, is_robot=True, lag=0.1)
    assert BARRIER.deviate(ZERO, own(TURTLEBOT3, (0.0, 0.0)), comes, 0.01)[1] * side > 0.02  # too fast to flee from
    ahead, here = near((0.35, 0.0), radius=TELLO.radius, is_robot=True, lag=TELLO.lag), own(TELLO, (0.0, 0.0))
    assert BARRIER.restrain((1.0, 0.0, 0.0, 0.0), here, ahead)[1] < -0.1
    assert Barrier(right=0.0).restrain((1.0, 0.0, 0.0, 0.0), here, ahead)[1] == pytest.approx(0.0, abs=1e-12)
    wheels, goal = own(KHEPERA4, (0.0, 0.0)), (1.0, 0.0, 0.0)
    assert BARRIER.deviate(goal, wheels, near((0.3, 0.0), radius=0.07, is_robot=True), 0.01)[1] < -0.05
    assert BARRIER.deviate(goal, wheels, near((-0.3, 0.0), radius=0.07, is_robot=True), 0.01) is goal
