"""Distributed model predictive control: robots swap places without contact, and reach them or tell that they wait."""

import sys
from dataclasses import replace
from functools import partial
from math import cos, dist, nan, pi, sin
from random import Random

import numpy as np
import pytest

from agents.body.kinds import KINDS
from agents.decision.stepping import Stepping
from agents.plugins.extras.mpc import Mpc, horizon
from agents.plugins.law import NeighbourView
from agents.plugins.registry import PluginError
from agents.vectors import ZERO
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.runs import flown, fly
from tests.small import small, triangle

pytest.importorskip("daqp", reason="the law mpc is the extra [mpc]: ./zenpark install daqp")

NAMES = [f"CF{number:02}" for number in range(1, 9)]
CONTACT = 0.13  # m, between the axes of two Crazyflies
WITHOUT = tuple(f"robots.{name}.avoids=false" for name in NAMES)  # the plans alone
CASES = [0, *(pytest.param(number, marks=pytest.mark.nightly) for number in range(1, 20))]


def opposite(number):
    """Places on a circle, turned; each robot goes to the opposite one."""
    turn = Random(number).uniform(0.0, pi)
    places = [(1.4 * cos(turn + k * pi / 4), 1.4 * sin(turn + k * pi / 4)) for k in range(8)]
    return places, places[4:] + places[:4]


def random(number, half=1.5, apart=0.55):
    """Random places in a square, and an order in which no robot keeps its own [m]."""
    draw, places = Random(number), []
    while len(places) < 8:
        place = draw.uniform(-half, half), draw.uniform(-half, half)
        if all(dist(place, other) > apart for other in places):
            places.append(place)
    goals = places
    while any(goal == place for goal, place in zip(goals, places, strict=True)):
        goals = draw.sample(places, 8)
    return places, goals


crowded = partial(random, half=0.75, apart=0.4)  # in a quarter of the area


def swapped(swap, number, *changes, case="periodic"):
    """Trace of robots that change places, and their goals [m]."""
    starts, goals = swap(number)
    words = [f"robots.{name}.start=[{x:.4f}, {y:.4f}]" for name, (x, y) in zip(NAMES, starts, strict=True)]
    table = ", ".join(f"{name} = [{x:.4f}, {y:.4f}]" for name, (x, y) in zip(NAMES, goals, strict=True))
    return flown("mpc", case, *words, f"formation.law.goal={{ {table} }}", *changes).trace, goals


def nearest(trace):
    """Least distance between any two robots [m]."""
    place = trace.true_position[..., :2]
    first, second = np.triu_indices(place.shape[1], 1)
    return np.linalg.norm(place[:, first] - place[:, second], axis=2).min()


def farthest(trace, goals):
    """Distance from its goal of the robot that is farthest from it at the end [m]."""
    return np.linalg.norm(trace.true_position[-1, :, :2] - goals, axis=1).max()


def assert_swapped(trace, goals):
    assert nearest(trace) > CONTACT
    assert farthest(trace, goals) < 0.05
    return trace


@pytest.mark.slow
@pytest.mark.parametrize("number", CASES)
@pytest.mark.parametrize("swap", [pytest.param(opposite, marks=pytest.mark.nightly), random])
def test_eight_robots_swap_places_without_contact(swap, number):
    assert_swapped(*swapped(swap, number))


@pytest.mark.nightly
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("swap", "changes", "touching", "waiting"),
    [
        pytest.param(opposite, WITHOUT, 0, 0, id="opposite-without-avoidance"),
        pytest.param(random, WITHOUT, 0, 0, id="random-without-avoidance"),
        pytest.param(crowded, (), 0, 1, id="crowded"),
        pytest.param(crowded, WITHOUT, 0, 0, id="crowded-without-avoidance"),
        pytest.param(opposite, (*WITHOUT, "formation.law.right=0.0"), 4, 0, id="not-to-the-right"),
    ],
)
def test_contacts_and_deadlocks_are_those_of_the_page(swap, changes, touching, waiting):
    """Counts of 20 cases, as docs/mpc.md has them."""
    ends = [swapped(swap, number, *changes) for number in range(20)]
    assert sum(nearest(trace) < CONTACT for trace, _ in ends) == touching
    assert sum(farthest(trace, goals) > 0.05 for trace, goals in ends) == waiting


@pytest.mark.slow
@pytest.mark.parametrize("case", [pytest.param("event", marks=pytest.mark.nightly), "event-loss"])
def test_swap_by_events_and_with_losses(case):
    trace = assert_swapped(*swapped(opposite, 0, case=case))
    assert len(trace.sent) < 0.7 * len(NAMES) * trace.time[-1] / 0.1  # of the periodic ones


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["crazyflie", "khepera4", "double-integrator"])
def test_one_robot_reaches_its_goal_within_its_limits(kind):
    law = {"kind": "mpc", "goal": {"A": [1.0, 0.6]}}
    robot = RobotTable(kind=kind, start=[-1.0, -0.5], hover=0.8 if kind == "crazyflie" else None)
    trace = fly(small({"A": robot}, formation=Formation(law=law), duration_s=12.0)).trace
    assert trace.true_position[-1, 0, :2] == pytest.approx([1.0, 0.6], abs=0.02)
    state = trace.memory["state"][:, 0]
    known = state[np.isfinite(state).all(axis=1)]
    assert np.abs(known[:, 2:4]).max() == pytest.approx(min(0.5, KINDS[kind].speed), abs=1e-3)
    assert np.abs(known[:, 4:]).max() < 1.0 + 1e-6


def come(bench):
    """B stands, and says that it comes; C stands elsewhere."""
    path = tuple(number for k in range(16) for number in (0.4 - 0.04 * k, 0.0))
    for link, place, words in ((0, (0.4, 0.0, 0.0), {"path": path}), (1, (0.0, -1.5, 0.0), {})):
        bench.neighbours.receive(link, place, ZERO, bench.t, bench.t, yaw=0.0, said=words)


def test_a_robot_plans_around_what_another_says():
    """A is on its way to a goal beyond B; what a lost B said is no longer avoided."""

    def plan_of(bench):
        stepping = bench.robot.stepping
        return stepping.measures["conflicts"], min(stepping.memory["path"][1::2])

    law = Mpc(goal={"A": (1.4, 0.0)}, speed=0.2)
    bench = Bench(replace(Plan(triangle()).assignment("A"), law=law, start=None, starts=()), (-0.4, 0.0, 0.0))
    conflicts, right = plan_of(bench.running(come).step(0.5, come))
    assert (conflicts, right < -0.2) == (1.0, True)  # to its right: the other does so as well
    assert plan_of(bench.step(0.8))[0] == 1.0  # what was said is old, and still counts
    bench.neighbours.mark_lost(0, bench.t)
    conflicts, right = plan_of(bench.step(1.3))
    assert (conflicts, right > -0.1) == (0.0, True)


def test_constraints_hold_where_they_can():
    """Of a plan beside one other: n·p ≥ b at its step, and limits."""
    ahead = horizon(15, 0.2, 0.1)
    still = NeighbourView(1, "B", (0.6, 0.0, 0.0), ZERO, 0.0, 0.0, {"path": (nan,) * 32}, None)
    (found,) = ahead.conflicts(ahead.positions((0.0, 0.0), (0.3, 0.0), ahead.rest), [still], 0.35, 0.0)
    assert found == (4, (-1.0, 0.0), pytest.approx(-0.25))
    a, slack = ahead.plan((0.0, 0.0), (0.3, 0.0), (2.0, 0.5), [found], (0.5, 1.0, 100.0))
    places = ahead.positions((0.0, 0.0), (0.3, 0.0), a)
    speed = 0.3 * np.array([1.0, 0.0]) + 0.2 * np.cumsum(a, axis=0)
    for value, most in ((slack, 0.0), (places[4, 0], 0.25), (np.abs(a).max(), 1.0), (np.abs(speed).max(), 0.5)):
        assert value <= most + 1e-6


def test_path_is_read_at_its_readers_time():
    path = tuple(number for k in range(16) for number in (0.1 * k, 1.0))
    later, last = (horizon(15, 0.2, 0.1).later(path, late) for late in (0.3, 1e6))
    assert later[:3, 0] == pytest.approx([0.25, 0.35, 0.45])
    assert [*later[-1], *last[0]] == pytest.approx([1.5, 1.0] * 2)  # it stays at the end


def test_a_missing_library_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "daqp", None)
    horizon.cache_clear()
    with pytest.raises(PluginError, match=r"^the law mpc needs .*: \./zenpark install daqp"):
        Stepping(replace(Plan(triangle()).assignment("A"), law=Mpc()))


@pytest.mark.parametrize(("name", "y", "severities"), [("B", 1.0, []), ("B", 0.3, ["warning"]), ("X", 1.0, ["error"])])
def test_check_warns_of_goals_that_exclude_each_other(name, y, severities):
    found = Mpc(goal={"A": (0.0, 0.0), name: (0.0, y)}).analyse(Plan(triangle()))
    assert [severity for severity, *_ in found] == severities
