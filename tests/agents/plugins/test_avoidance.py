"""The potential of the paper, and what every avoidance is held to by safety and by the decision."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agents.agent import Agent
from agents.body.interface import BodyState
from agents.body.kinds import CRAZYFLIE, KHEPERA4, TELLO, TURTLEBOT3
from agents.body.limits import Limits
from agents.decision.lifecycle import RUNNING
from agents.plugins.avoidance import Avoidance, Potential
from agents.plugins.registry import AVOIDANCES, PluginError, build
from agents.safety.setpoint_filter import SetpointFilter
from experiments.definition.experiment import Experiment, Robot
from experiments.definition.plan import Plan
from tests.agents.things import NOTHING, near, own, poses

LIMITS = Limits(np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.5]), speed=0.5)


# ---------------------------------------------------------------- the potential


def test_the_force_is_that_of_equation_3_between_surfaces():
    potential = Potential(strength=2e-4)
    here = own((KHEPERA4,), [0.1, 0.2])
    gap = 0.15
    thing = near([0], [0.1, 0.2 + KHEPERA4.radius + 0.04 + gap], radius=0.04)
    expected = 2e-4 * (1 / gap - 1 / 0.3) / gap**2
    np.testing.assert_allclose(potential.force(here, thing), [[0.0, -expected]], rtol=1e-12)


def test_the_force_is_minus_the_gradient_of_equation_2():
    potential = Potential()
    thing = near([0], [0.0, 0.0], radius=0.05)
    place, step = np.array([0.17, 0.11]), 1e-6

    def energy(at):
        gap = np.hypot(*at) - 0.05 - KHEPERA4.radius
        return 0.5 * potential.strength * (1 / gap - 1 / potential.reach) ** 2

    gradient = [(energy(place + step * e) - energy(place - step * e)) / (2 * step) for e in np.eye(2)]
    np.testing.assert_allclose(potential.force(own((KHEPERA4,), place), thing)[0], -np.array(gradient), rtol=1e-6)


def test_the_goal_is_shifted_by_h_v_along_the_sum_of_all_forces():
    here = own((TELLO,), [0.0, 0.0, 1.0])
    things = near([0, 0], [[0.3, 0.0], [0.0, 0.3]])
    goal = np.array([[-0.02, -0.01, 1.0]])
    shifted = Potential(velocity=0.2, period_s=0.1).deviate(goal, here, things, 0.01)
    np.testing.assert_allclose(shifted, [[-0.02 - 0.02 / np.sqrt(2), -0.01 - 0.02 / np.sqrt(2), 1.0]], atol=1e-12)
    usual = Potential().deviate(goal, here, things, 0.01)  # h = 1/response = 1 s, v = 1 m/s: its limit
    np.testing.assert_allclose(usual, [[-0.02 - 1 / np.sqrt(2), -0.01 - 1 / np.sqrt(2), 1.0]], atol=1e-12)


@pytest.mark.parametrize(("gap", "share"), [(0.25, 1.0), (0.1, 1.0), (0.3 - 1e-9, 0.0), (0.28, 0.28471)])
def test_the_push_grows_from_nothing_within_a_layer(gap, share):
    # (1/0.28 - 1/0.3)/0.28² over (1/0.25 - 1/0.3)/0.25²
    here = own((TELLO,), [0.0, 0.0, 1.0])
    thing = near([0], [TELLO.radius + gap, 0.0])
    shifted = Potential(velocity=0.2, period_s=0.1).deviate(np.array([[0.0, 0.0, 1.0]]), here, thing, 0.01)
    np.testing.assert_allclose(shifted, [[-0.02 * share, 0.0, 1.0]], atol=2e-7)


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
def test_a_goal_behind_a_thing_pulls_aside(goal, aside):
    here = own((TELLO,), [0.0, 0.0, 1.0])
    thing = near([0], [0.2, 0.0])
    (x, y, _), *_ = Potential(velocity=0.2, period_s=0.1).deviate(np.array([[*goal, 1.0]]), here, thing, 0.01)
    np.testing.assert_allclose((x, y), (goal[0] - 0.02, goal[1] + aside), atol=1e-12)


@pytest.mark.parametrize("kind", [KHEPERA4, TURTLEBOT3, CRAZYFLIE, TELLO])
def test_no_goal_behind_a_thing_pulls_harder_than_the_thing_pushes(kind):
    here = own((kind,), [0.0, 0.0])
    thing = near([0], [kind.radius + 0.2, 0.0])
    shifted = Potential().deviate(np.array([[50.0, 0.0, 0.0]]), here, thing, 0.01)
    assert shifted[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert Potential().deviate(np.array([[0.05, 0.0, 0.0]]), here, thing, 0.01)[0, 0] < -0.1


def test_what_is_out_of_reach_changes_nothing_and_what_is_in_it_only_its_row():
    here = own((KHEPERA4, KHEPERA4), [[0.0, 0.0], [1.0, 0.0]])
    goal = np.array([[0.3, 0.1, 0.0], [1.1, np.pi, 0.0]])
    far = near([0], [KHEPERA4.radius + 0.31, 0.0])
    assert Potential().deviate(goal, here, far, 0.01) is goal
    assert Potential().deviate(goal, here, NOTHING, 0.01) is goal
    shifted = Potential().deviate(goal, here, near([0], [0.2, 0.0]), 0.01)
    np.testing.assert_array_equal(shifted[1], goal[1])
    assert (shifted[0] != goal[0]).any()


def test_it_gives_numbers_even_for_things_in_the_same_place():
    here = own((KHEPERA4,), [0.5, 0.5])
    shifted = Potential().deviate(np.zeros((1, 3)), here, near([0], [0.5, 0.5]), 0.01)
    assert np.isfinite(shifted).all()


# ---------------------------------------------------------------- what safety makes of any avoidance


class Wild(Avoidance, frozen=True):
    """Sends the setpoints that it is given."""

    answer: tuple[tuple[float, ...], ...]

    def restrain(self, setpoint, own, near):
        return np.array(self.answer)


def judged(kinds, setpoint, answer, position, age=0.0):
    here = own(kinds, position)
    asked = np.array(setpoint, dtype=float)
    return SetpointFilter(kinds, LIMITS).check(
        asked, here.position, here.yaw, np.full(len(kinds), age), avoidance=(Wild(answer=answer), here, NOTHING)
    )


def test_an_avoidance_obeys_the_limits_of_speed_and_arena():
    kinds = (CRAZYFLIE, TELLO, KHEPERA4)
    answer = ((9.0, 0.0, 1.0, 0.0), (9.0, -9.0, 0.0, 9.0), (9.0, -99.0, 0.0, 0.0))
    verdict = judged(kinds, [[0, 0, 1, 0], [0] * 4, [0] * 4], answer, [[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    np.testing.assert_allclose(verdict.setpoint[0], [0.25, 0.0, 1.0, 0.0])  # 0.5 m/s at a response of 2/s
    np.testing.assert_allclose(verdict.setpoint[1], [0.5, -0.5, 0.0, TELLO.turn_rate])
    np.testing.assert_allclose(verdict.setpoint[2], [KHEPERA4.speed, -KHEPERA4.turn_rate, 0.0, 0.0])
    assert verdict.avoided.all()
    assert verdict.changed.all()
    outside = judged((CRAZYFLIE, TELLO), [[1.9, 0, 1, 0], [0] * 4], answer[:2], [[1.9, 0, 1], [1.96, 0, 1]])
    np.testing.assert_allclose(outside.setpoint[:, 0], [1.93, -0.01])  # 1 cm beyond the margin, at a response of 1/s


def test_what_is_no_number_is_not_taken_and_who_is_blind_is_not_moved():
    setpoint = [[0.1, 0.2, 0.0, 0.0], [0.1, 0.2, 0.0, 0.0]]
    answer = ((np.nan, 0.0, 0.0, 0.0), (0.05, 0.2, 0.0, 0.0))
    verdict = judged((KHEPERA4, KHEPERA4), setpoint, answer, [[0, 0], [1, 0]])
    np.testing.assert_array_equal(verdict.setpoint, [setpoint[0], answer[1]])
    assert verdict.avoided.tolist() == [False, True]
    blind = judged((KHEPERA4, KHEPERA4), setpoint, answer, [[0, 0], [1, 0]], age=0.6)
    np.testing.assert_array_equal(blind.setpoint, np.zeros((2, 4)))


def test_setpoints_that_are_left_alone_are_the_same_bits():
    rng = np.random.default_rng(3)
    kinds = (CRAZYFLIE, TELLO, KHEPERA4) * 20
    here = own(kinds, rng.uniform(-2.1, 2.1, (60, 3)), yaw=rng.uniform(-3, 3, 60))
    setpoint = rng.uniform(-3, 3, (60, 4))
    plain = SetpointFilter(kinds, LIMITS).check(setpoint, here.position, here.yaw, np.zeros(60))
    answer = plain.setpoint.copy()
    answer[7, 0] += 0.01
    wild = Wild(answer=tuple(map(tuple, answer.tolist())))
    verdict = SetpointFilter(kinds, LIMITS).check(
        setpoint, here.position, here.yaw, np.zeros(60), avoidance=(wild, here, NOTHING)
    )
    same = np.arange(60) != 7
    np.testing.assert_array_equal(verdict.setpoint[same], plain.setpoint[same])
    assert not verdict.avoided[same].any()


class Broken(Avoidance, frozen=True):
    """Somebody's first."""

    way: str

    def deviate(self, goal, own, near, period):
        if self.way == "deviate fails":
            raise KeyError("goal")
        assert self.way != "deviate asserts"
        return goal[:1] if self.way == "deviate shape" else goal

    def restrain(self, setpoint, own, near):
        if self.way == "restrain fails":
            return setpoint / [1, 2, 3]
        if self.way == "restrain nothing":
            return None
        if self.way == "restrain lists":
            return [row[:2] for row in setpoint.tolist()[:1]] + setpoint.tolist()[1:]
        if self.way == "restrain words":
            return [["here"] * 4] * len(setpoint)
        return setpoint[:, :2] if self.way == "restrain shape" else setpoint


@pytest.mark.parametrize(
    ("way", "says"),
    [
        ("deviate fails", "the avoidance Broken failed: KeyError: 'goal'"),
        ("deviate asserts", "the avoidance Broken failed: AssertionError"),
        ("deviate shape", r"`deviate` of the avoidance Broken must give a goal per row, \(2, 3\), not \(1, 3\)"),
        ("restrain fails", r"the avoidance Broken failed: ValueError.* \(.*test_avoidance\.py:\d+\)$"),
        (
            "restrain nothing",
            r"not nothing: is a `return` missing\? \(.*test_avoidance\.py\)",
        ),
        ("restrain lists", "the avoidance Broken failed: ValueError"),
        ("restrain words", "the avoidance Broken failed: ValueError"),
        ("restrain shape", r"`restrain` of the avoidance Broken must give a setpoint per row, \(2, 4\), not \(2, 2\)"),
    ],
)
def test_an_avoidance_with_a_mistake_is_named(way, says):
    agent, state = running_pair(Broken(way=way))
    with pytest.raises(PluginError, match=says):
        agent.step(0.0, state)


# ---------------------------------------------------------------- in the decision


def running_pair(avoidance, gap=1.0, **parts):
    """Two Kheperas under way, side by side, each where it wants to be."""
    robots = {"A": Robot(kind="khepera4", start=[0.0, 0.0]), "B": Robot(kind="khepera4", start=[0.14 + gap, 0.0])}
    experiment = Experiment(
        title="A pair", duration_s=60.0, robots=robots, avoidance={"kind": "barrier", "hears": "all"}, **parts
    )
    agent = Agent(replace(Plan(experiment).assignment(tuple(robots)), avoidance=avoidance))
    agent.lifecycle.phase[:] = RUNNING
    agent.lifecycle.start_at[:] = 0.0
    place = np.array([[0.0, 0.0, 0.0], [0.14 + gap, 0.0, 0.0]])
    still, nobody = np.zeros((2, 3)), np.zeros(2, dtype=bool)
    state = BodyState(np.zeros(2), place, still, np.zeros(2), place, np.zeros(2), np.ones(2), nobody)
    links = agent.assignment.links
    if len(links):
        told = place[links.sender]
        agent.neighbours.mark_alive(np.arange(len(links)))
        agent.neighbours.receive(
            poses(np.arange(len(links)), told, still[: len(told)], np.zeros(len(told)), np.zeros(len(told)))
        )
    return agent, state


def test_avoidance_is_counted_and_acts_only_where_somebody_is_near():
    for gap, acts in ((1.0, False), (0.01, True)):
        agent, state = running_pair(build(AVOIDANCES, {"kind": "potential", "hears": "all"}), gap)
        actions = agent.step(0.0, state)
        assert actions.avoided.tolist() == [acts, acts]
        pushed = actions.setpoint[:, 0]
        assert ((pushed[0] < 0.0) and (pushed[1] > 0.0)) if acts else not pushed.any()


def test_the_goal_of_the_decision_itself_is_not_shifted():
    agent, state = running_pair(build(AVOIDANCES, {"kind": "potential", "hears": "all"}), 0.01)
    agent.step(0.0, state)
    np.testing.assert_allclose(agent.goal[:, 0], [0.0, 0.15])


def test_without_avoidance_nobody_looks():
    agent, state = running_pair(None, 0.01)
    assert agent._perception is None
    assert not agent.step(0.0, state).avoided.any()


def test_the_avoidance_of_the_docs_stops_short():
    text = (Path(__file__).parents[3] / "docs" / "plugins.md").read_text(encoding="utf-8")
    (source,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "StopShort" in block]
    names: dict[str, type[Avoidance]] = {}
    exec(source, names)
    here = own((KHEPERA4, KHEPERA4), [[0.0, 0.0], [1.0, 0.0]])
    thing = near([0], [KHEPERA4.radius + 0.19, 0.0])
    goal = names["StopShort"]().deviate(np.full((2, 3), 0.5), here, thing, 0.01)
    np.testing.assert_array_equal(goal, [[0.0, 0.0, 0.5], [0.5, 0.5, 0.5]])
