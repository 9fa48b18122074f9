"""The potential of the paper, and avoidances in the decision of a robot."""

import math
import re
from dataclasses import replace
from math import isfinite, sqrt
from pathlib import Path

import pytest

from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.kinds.tello import TELLO
from agents.kinds.turtlebot3 import TURTLEBOT3
from agents.plugins.avoidance import Avoidance, Potential
from agents.plugins.calls import explain
from agents.plugins.registry import AVOIDANCES, FAILURES, PluginError, build
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.agents.few import pair
from tests.agents.things import NOTHING, near, own

QUICK = Potential(velocity=0.2, period_s=0.1)  # h v = 0.02 m


# ---------------------------------------------------------------- the potential


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
    shifted = Potential().deviate((0.0, 0.0, 0.0), own(KHEPERA4, (0.5, 0.5)), near((0.5, 0.5)), 0.01)
    assert all(map(isfinite, shifted))


# ---------------------------------------------------------------- in the decision


def beside(avoidance, gap=1.0):
    """A Khepera under way with its neighbour beside it, where both want to be."""
    far = 0.14 + gap
    experiment = pair(avoidance={"kind": "barrier", "hears": "all"})
    assignment = Plan(experiment).assignment("A")
    links = tuple(replace_distance(link, far) for link in assignment.neighbours)
    bench = Bench(replace(assignment, avoidance=avoidance, neighbours=links, start=None, starts=()), (0.0, 0.0, 0.0))
    return bench.running(lambda bench: bench.hear(0, (far, 0.0, 0.0)))


def replace_distance(link, distance):
    return type(link)(link.sender, link.name, link.kind, distance)


@pytest.mark.parametrize(("gap", "acts"), [(1.0, False), (0.01, True)])
def test_avoidance_acts_near_others_alone(gap, acts):
    robot = beside(build(AVOIDANCES, {"kind": "potential", "hears": "all"}), gap).robot
    assert robot.avoided == acts
    assert robot.setpoint[0] < 0.0 if acts else robot.setpoint == (0.0, 0.0, 0.0, 0.0)
    assert robot.goal == pytest.approx((0.0, 0.0, 0.0))  # that of the decision itself is not shifted


def test_without_avoidance_nothing_is_avoided():
    assert not beside(None, 0.01).robot.avoided


class Broken(Avoidance, frozen=True):
    """Somebody's first."""

    way: str

    def horizon(self, own):
        if self.way == "horizon fails":
            raise KeyError("own")
        return {"horizon nan": math.nan, "horizon nothing": None}.get(self.way, math.inf)

    def deviate(self, goal, own, near, period):
        if self.way == "deviate fails":
            raise KeyError("goal")
        assert self.way != "deviate asserts"
        return goal[:1] if self.way == "deviate shape" else goal

    def restrain(self, setpoint, own, near):
        if self.way == "restrain fails":
            return setpoint / 2
        if self.way == "restrain nothing":
            return None
        if self.way == "restrain words":
            return ("here",) * 4
        return setpoint[:2] if self.way == "restrain shape" else setpoint


@pytest.mark.parametrize(
    ("way", "says"),
    [
        ("deviate fails", r"the avoidance Broken failed: KeyError: 'goal' \(.*test_avoidance\.py:\d+\)$"),
        ("deviate asserts", "the avoidance Broken failed: AssertionError"),
        ("deviate shape", r"`deviate` of the avoidance Broken must give three numbers, not \(0.0,\)"),
        ("restrain fails", r"the avoidance Broken failed: TypeError.* \(.*test_avoidance\.py:\d+\)$"),
        ("restrain nothing", r"`restrain` of the avoidance Broken must give four numbers, not nothing: is a `return` "),
        ("restrain words", "`restrain` of the avoidance Broken must give four numbers"),
        ("restrain shape", "`restrain` of the avoidance Broken"),
        ("horizon fails", r"the avoidance Broken failed: KeyError: 'own' \(.*test_avoidance\.py:\d+\)$"),
        ("horizon nan", "`horizon` of the avoidance Broken must give a distance of 0 m or more, not nan"),
        ("horizon nothing", "`horizon` of the avoidance Broken must give a distance"),
    ],
)
def test_mistake_in_an_avoidance_is_named(way, says):
    avoidance = Broken(way=way)
    try:
        beside(avoidance)
    except FAILURES as error:
        told = explain(error, [("avoidance", avoidance)])
    assert isinstance(told, PluginError)
    assert re.search(says, str(told))


def test_avoidance_of_the_docs_stops_short():
    text = (Path(__file__).parents[3] / "docs" / "plugins.md").read_text(encoding="utf-8")
    (source,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "StopShort" in block]
    names: dict[str, type[Avoidance]] = {}
    exec(source, names)
    avoidance, goal = names["StopShort"](), (0.5, 0.5, 0.5)
    here = own(KHEPERA4, (0.0, 0.0))
    assert avoidance.deviate(goal, here, near((KHEPERA4.radius + 0.19, 0.0)), 0.01) == (0.0, 0.0, 0.5)
    assert avoidance.deviate(goal, here, near((KHEPERA4.radius + 0.21, 0.0)), 0.01) == goal
