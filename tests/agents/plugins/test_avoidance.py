"""The potential of the paper, and an avoidance in the decision of a robot."""

from dataclasses import replace
from math import isfinite, sqrt

import msgspec
import pytest

from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.tello import TELLO
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.plugins.avoidance import Potential
from agents.plugins.registry import AVOIDANCES, build
from agents.vectors import ZERO
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.agents.things import NOTHING, near, own
from tests.small import pair

QUICK = Potential(velocity=0.2, period_s=0.1)  # h v = 0.02 m


@pytest.mark.parametrize("gap", [0.02, 0.1, 0.15, 0.29])
def test_push_is_minus_the_gradient_of_equation_2(gap):
    potential, step = Potential(strength=2e-4), 1e-7

    def energy(d):
        return 0.5 * potential.strength * (1 / d - 1 / potential.reach) ** 2

    assert potential.push(gap) == pytest.approx(-(energy(gap + step) - energy(gap - step)) / (2 * step), rel=1e-5)
    assert potential.push(gap) == pytest.approx(2e-4 * (1 / gap - 1 / 0.3) / gap**2)
    assert potential.push(0.31) == 0.0


def test_goal_is_shifted_along_the_force():
    here, things, goal = own(TELLO, (0.0, 0.0, 1.0)), near((0.3, 0.0), (0.0, 0.3)), (-0.02, -0.01, 1.0)
    shifted = QUICK.deviate(goal, here, things, 0.01)
    assert shifted == pytest.approx((-0.02 - 0.02 / sqrt(2), -0.01 - 0.02 / sqrt(2), 1.0), abs=1e-12)
    usual = Potential().deviate(goal, here, things, 0.01)  # h = 1/response = 1 s, v = 1 m/s: its limit
    assert usual == pytest.approx((-0.02 - 1 / sqrt(2), -0.01 - 1 / sqrt(2), 1.0), abs=1e-12)


@pytest.mark.parametrize(("gap", "share"), [(0.25, 1.0), (0.1, 1.0), (0.3 - 1e-9, 0.0), (0.28, 0.28471)])
def test_push_grows_within_a_layer(gap, share):
    # (1/0.28 - 1/0.3)/0.28² over (1/0.25 - 1/0.3)/0.25²
    shifted = QUICK.deviate((0.0, 0.0, 1.0), own(TELLO, (0.0, 0.0, 1.0)), near((TELLO.radius + gap, 0.0)), 0.01)
    assert shifted == pytest.approx((-0.02 * share, 0.0, 1.0), abs=2e-7)


@pytest.mark.parametrize(
    ("goal", "aside"),
    [
        ((0.5, 0.0), -0.05),  # straight ahead: to the right, by a tenth of the pull
        ((0.5, 0.02), -0.05),  # nearly so
        ((0.5, 0.03), 0.05),  # to the left is nearer
        ((0.5, -0.2), -0.05),
        ((-0.5, 0.1), 0.0),  # away from the thing
    ],
)
def test_goal_behind_a_thing_pulls_aside(goal, aside):
    x, y, _ = QUICK.deviate((*goal, 1.0), own(TELLO, (0.0, 0.0, 1.0)), near((0.2, 0.0)), 0.01)
    assert (x, y) == pytest.approx((goal[0] - 0.02, goal[1] + aside), abs=1e-12)


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3, CRAZYFLIE, TELLO])
def test_no_goal_pulls_harder_than_the_push(kind):
    here, thing = own(kind, (0.0, 0.0)), near((kind.radius + 0.2, 0.0))
    assert Potential().deviate((50.0, 0.0, 0.0), here, thing, 0.01)[0] == pytest.approx(0.0, abs=1e-12)
    assert Potential().deviate((0.05, 0.0, 0.0), here, thing, 0.01)[0] < -0.1


def test_far_things_change_nothing():
    here, goal = own(KHEPERA4, (0.0, 0.0)), (0.3, 0.1, 0.0)
    assert Potential().deviate(goal, here, near((KHEPERA4.radius + 0.31, 0.0)), 0.01) is goal
    assert Potential().deviate(goal, here, NOTHING, 0.01) is goal


def test_thing_in_the_same_place_gives_numbers():
    assert all(map(isfinite, Potential().deviate(ZERO, own(KHEPERA4, (0.5, 0.5)), near((0.5, 0.5)), 0.01)))


@pytest.mark.parametrize(
    ("kind", "gap", "acts"), [("potential", 1.0, False), ("potential", 0.01, True), (None, 0.01, False)]
)
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
