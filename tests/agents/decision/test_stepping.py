"""Laws that remember and say something, at work for one robot."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from math import dist, inf, isnan, nan
from pathlib import Path
from typing import ClassVar

import pytest

from agents.decision.lifecycle import LANDING, RUNNING
from agents.decision.position_control import LEASH, VelocityFollower
from agents.decision.stepping import Speech, Stepping
from agents.kinds.crazyflie import CRAZYFLIE
from agents.kinds.khepera4 import KHEPERA4
from agents.network import messages, validation
from agents.network.messages import Malformed, Variable
from agents.plugins.law import Control, Law, Said
from agents.plugins.planners import Leg, Line
from agents.plugins.registry import PluginError
from agents.vectors import UNKNOWN
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.agents.few import triangle

DT = 0.02


class Counting(Law, frozen=True):
    """Counts its steps, and drives along x."""

    SAYS: ClassVar[Mapping[str, Said]] = {"count": Said(metre=100.0)}

    def begin(self, robot):
        return {"count": (0.0,), "secret": (nan, nan)}

    def step(self, view, memory):
        return Control(
            memory={"count": (memory["count"][0] + 1.0,), "secret": (1.0, 2.0)},
            velocity=(0.05, 0.0, nan),
            measures={"heard": float(len(view.known("count")))},
        )


class Odd(Counting, frozen=True):
    """Decides what it is given."""

    decides: object = None

    def step(self, view, memory):
        return self.decides


class Failing(Counting, frozen=True):
    def begin(self, robot):
        return {"count": (1.0 / robot.number,)}


class Wide(Counting, frozen=True):
    def begin(self, robot):
        return {"count": (0.0,) * 65}


class Bare(Counting, frozen=True):
    def begin(self, robot):
        return {"count": 0.0}


class Naming(Counting, frozen=True):
    SAYS = ("count",)


class Weightless(Counting, frozen=True):
    SAYS: ClassVar[Mapping[str, Said]] = {"count": Said(metre=0.0)}


def given(law):
    return replace(Plan(triangle()).assignment("A"), law=law, start=None, starts=())


def hear(bench):
    for link in range(2):
        bench.hear(link, (0.5, 0.5 * link, 0.0))


def test_memory_is_kept_where_a_robot_was_due():
    bench = Bench(given(Counting()), (0.0, 0.0, 0.0))
    bench.step(0.2, hear)
    stepping = bench.robot.stepping
    assert stepping.memory["count"] == (0.0,)  # the rehearsal is not kept
    bench.running(hear).step(0.99, hear)
    assert stepping.memory == {"count": (10.0,), "secret": (1.0, 2.0)}
    assert stepping.measures == {"heard": 0.0}
    assert bench.robot.setpoint[0] == pytest.approx(0.05, rel=0.2)
    assert isnan(bench.robot.error)


def test_neighbours_are_heard_and_forgotten():
    bench = Bench(given(Counting()), (0.0, 0.0, 0.0))
    bench.running(hear)

    def say(bench):
        for link in range(2):
            words = {"count": (3.0,)} if link else {"count": (3.0, 4.0), "other": (1.0,)}  # of another size
            bench.neighbours.receive(link, (0.5, 0.5, 0.0), (0.0, 0.0, 0.0), bench.t, bench.t, yaw=0.3, said=words)

    bench.step(0.3, say)
    assert bench.robot.stepping.measures == {"heard": 1.0}
    bench.neighbours.discard_pose(1)
    bench.step(0.3, lambda bench: bench.hear(0, (0.5, 0.5, 0.0)))
    assert bench.robot.stepping.measures == {"heard": 0.0}


def test_a_robot_says_what_its_last_step_decided():
    bench = Bench(given(Counting()), (0.0, 0.0, 0.0))
    bench.running(hear)
    for _ in range(40):
        before = len(bench.said)
        bench.step(0.01, hear)
        if len(bench.said) > before:
            assert bench.robot.words == (("count", bench.robot.stepping.memory["count"]),)


@pytest.mark.parametrize(
    "decides",
    [
        None,
        Control(),
        Control(memory={"count": (1.0, 2.0), "secret": (0.0, 0.0)}),
        Control(memory={"count": ("a",), "secret": (0.0, 0.0)}),
        Control(memory={"count": (1.0,), "secret": (0.0, 0.0)}, velocity=(1.0, 2.0)),
        Control(memory={"count": (1.0,), "secret": (0.0, 0.0)}, velocity=(0.0, 0.0, nan), goal=(0.0, 0.0, nan)),
        Control(memory={"count": (1.0,), "secret": (0.0, 0.0)}, measures={"x": "much"}),
    ],
)
def test_what_cannot_be_used_names_the_law(decides):
    stepping = Stepping(given(Odd(decides=decides)))
    with pytest.raises(PluginError, match="`step` of the law Odd must give"):
        stepping.step(stepping.view())


def test_a_law_that_cannot_begin_is_named():
    with pytest.raises(PluginError, match="the law Failing failed: ZeroDivisionError"):
        Stepping(given(Failing()))
    with pytest.raises(PluginError, match=r"`begin` of the law Bare must give a tuple of numbers for each variable"):
        Stepping(given(Bare()))
    with pytest.raises(PluginError, match="SAYS of the law Naming must name a Said for each variable"):
        Stepping(given(Naming()))
    with pytest.raises(
        PluginError, match=r"SAYS of the law Weightless: the metre of count is 0\.0, not a positive number"
    ):
        Stepping(given(Weightless()))
    with pytest.raises(PluginError, match="the law Wide says 65 numbers; a pose carries 64"):
        Stepping(given(Wide()))


def test_velocity_that_is_not_finite_holds_and_lands():
    class Lost(Counting, frozen=True):
        def step(self, view, memory):
            way = (nan if view.time > 1.0 else 0.0, 0.0, nan)
            return Control(memory={"count": (0.0,), "secret": (nan, nan)}, velocity=way)

    bench = Bench(given(Lost()), (0.0, 0.0, 0.0))
    bench.running(hear).step(0.9, hear)
    assert bench.life.phase == RUNNING
    bench.step(0.5, hear)
    assert bench.robot.setpoint == (0.0, 0.0, 0.0, 0.0)
    assert any("the law Lost decides what is not finite" in each.text for each in bench.robot.hazards.incidents)
    bench.step(30.0, hear)
    assert bench.life.phase >= LANDING


def test_words_on_unknown_reads_change_nothing():
    class Aiming(Counting, frozen=True):
        def step(self, view, memory):
            return Control(memory=memory, velocity=(*view.target_velocity[:2], view.neighbours[0].link.bearing[0]))

    line = Leg(0.0, Line(move_by=[1.0, 0.0], speed_=0.1))
    speeds = []
    for asks in (False, True):
        bench = Bench(replace(given(Aiming()), legs=(line,)), (0.0, 0.0, 0.0))
        bench.running(hear).step(0.9, hear)
        goals = bench.robot.goals
        words = goals.unknown_reads(99.0, (5.0, 5.0, 0.0)) if asks else ""
        assert words.startswith(": Aiming reads link.bearing") == asks
        assert "view.target" not in words
        bench.step(0.2, hear)
        speeds.append(goals.stepping.control.velocity[:2])
    assert speeds[0] == speeds[1] == pytest.approx((0.1, 0.0), abs=1e-6)


def test_deviation_counts_in_metres():
    speech = Speech(Counting(), {"count": (0.0,)})
    speech.record()
    assert speech.deviation(0.1) == 0.1  # before the first step there is nothing to say
    assert speech.words == ()
    speech.update({"count": (0.0,)})
    assert speech.deviation(0.1) == inf
    speech.record()
    assert speech.words == (("count", (0.0,)),)
    speech.update({"count": (50.0,)})
    assert speech.deviation(0.1) == 0.5
    assert speech.deviation(0.7) == 0.7
    speech.record()
    assert speech.deviation(0.0) == 0.0
    speech.update({"count": (nan,)})
    assert speech.deviation(0.0) == 0.0
    speech.record()
    assert speech.words == ()
    speech.update({"count": (1.0 / 3.0,)})
    assert speech.deviation(0.0) == inf
    speech.record()
    assert speech.words == (("count", (0.3333333,)),)


def test_poses_without_words_are_as_they_were():
    pose = messages.pose("A", 1, 2.0, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0), yaw=0.5)
    text = b'{"robot":"A","seq":1,"stamp":2.0,"position":[1.0,2.0,3.0],"velocity":[0.0,0.0,0.0],"yaw":0.5}'
    assert messages.encode(pose, "json") == text
    spoken = messages.pose("A", 1, 2.0, (1.0, 2.0, 3.0), UNKNOWN, yaw=nan, words=(("x", (1.0, 2.0)), ("y", (nan,))))
    assert messages.encode(spoken, "json").endswith(b'"shared":[{"name":"x","value":[1.0,2.0]}]}')
    for mime in ("json", "msgpack"):
        payload = messages.encode(spoken, mime)
        assert messages.decode(payload, messages.MIME[mime], messages.Pose) == spoken


@pytest.mark.parametrize(
    "shared", [[Variable("x", [0.0] * 65)], [Variable("x", [nan])], [Variable("x", [inf])], [Variable("x", [1.0])] * 2]
)
def test_impossible_words_are_refused(shared):
    pose = messages.Pose("A", 1, 2.0, (0.0, 0.0, 0.0), shared=shared)
    with pytest.raises(Malformed):
        validation.check_pose(pose, now=2.0, valid_box=(1.0, 1.0, 1.0))


def test_reference_moves_with_the_velocity_and_stays_near():
    follower = VelocityFollower(CRAZYFLIE, 0.8)
    for _ in range(100):
        goal = follower.goal((0.1, 0.0, nan), (0.0, 0.0, 0.7), DT)  # a robot that is held back
    assert follower.reference == pytest.approx((LEASH, 0.0, 0.8))
    assert goal == pytest.approx((LEASH + 0.1 / CRAZYFLIE.response, 0.0, 0.8))
    x, y, z = VelocityFollower(CRAZYFLIE, 0.8).goal((30.0, 40.0, nan), (0.0, 0.0, 0.8), DT)
    assert (x, y, z) == pytest.approx(
        (0.6 * CRAZYFLIE.speed / CRAZYFLIE.response, 0.8 * CRAZYFLIE.speed / CRAZYFLIE.response, 0.8)
    )
    resting = VelocityFollower(CRAZYFLIE, 0.8)
    places = [resting.goal((0.0, 0.0, nan), (0.01 * (k % 3 - 1), 0.0, 0.8), DT) for k in range(50)]
    assert dist(places[0], places[-1]) == 0.0
    assert VelocityFollower(KHEPERA4, 0.0).goal((0.0, 0.0, 0.3), (0.2, 0.1, 0.0), DT) == (0.2, 0.1, 0.0)


def test_the_law_of_the_docs_steps():
    text = (Path(__file__).parents[3] / "docs" / "plugins.md").read_text("utf-8")
    (source,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "class Mean" in block]
    space = {"__name__": __name__}
    exec(source, space)
    bench = Bench(given(space["Mean"]({"A": 3.0})), (0.0, 0.0, 0.0))

    def say(bench):
        for link in range(2):
            words = {"x": (1.0,), "q": (0.0,)}
            bench.neighbours.receive(
                link, (0.5, 0.5 * link, 0.0), (0.0, 0.0, 0.0), bench.t, bench.t, yaw=nan, said=words
            )

    bench.running(say).step(3.0, say)
    assert 1.0 < bench.robot.stepping.memory["x"][0] < 3.0
    assert bench.robot.stepping.measures["disagreement"] > 0.0
