"""Laws that remember and say something, at work for one robot."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import dist, hypot, inf, isnan, nan
from typing import ClassVar

import msgspec
import pytest

from agents.decision.lifecycle import LANDING, RUNNING
from agents.decision.position_control import LEASH, VelocityFollower
from agents.decision.stepping import Speech, Stepping
from agents.network import messages, validation
from agents.network.messages import Malformed, Variable
from agents.plugins.law import Control, Law, RobotFacts, Said
from agents.plugins.planners import Leg, Line
from agents.plugins.registry import PluginError
from agents.vectors import UNKNOWN, ZERO
from bridges.crazyflie.kind import CRAZYFLIE
from bridges.khepera4.kind import KHEPERA4
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.small import triangle

REMEMBERED = {"count": (1.0,), "secret": (0.0, 0.0)}


class Counting(Law, frozen=True):
    """Counts its steps, in the memory that it gets, and drives along x."""

    SAYS: ClassVar[Mapping[str, Said]] = {"count": Said(metre=100.0)}

    def begin(self, robot):
        return {"count": (0.0,), "secret": (nan, nan)}

    def step(self, view, memory):
        memory.update(count=(memory["count"][0] + 1.0,), secret=(1.0, 2.0))
        return Control(
            memory=memory,
            velocity=(0.05, 0.0, nan),
            measures={"heard": float(len(view.known("count")))},
        )


class Bare(Counting, frozen=True):
    def error(self, apart, link):
        return nan


class Silent(Counting, frozen=True):
    def error(self, apart, link): ...


class Odd(Counting, frozen=True):
    decides: Callable[[object], object]

    def step(self, view, memory):
        return self.decides(view)


class Beginning(Counting, frozen=True):
    count: Callable[[RobotFacts], object]

    def begin(self, robot):
        return {"count": self.count(robot)}


def saying(says):
    return msgspec.defstruct("Saying", [], bases=(Counting,), namespace={"SAYS": says}, frozen=True)()


def given(law, **parts):
    return replace(Plan(triangle()).assignment("A"), law=law, start=None, starts=(), **parts)


def hear(bench, *words):
    """Poses of both neighbours, with variables of the first one, and of the second."""
    for link, said in enumerate(words or ({}, {})):
        bench.neighbours.receive(link, (0.5, 0.5 * link, 0.0), ZERO, bench.t, bench.t, yaw=0.3, said=said)


def running(law, **parts):
    return Bench(given(law, **parts), ZERO).running(hear)


def test_memory_is_kept_where_a_robot_was_due():
    bench = Bench(given(Counting()), ZERO).step(0.2, hear)
    stepping = bench.robot.stepping
    assert stepping.memory["count"] == (0.0,)  # the rehearsal is not kept
    bench.running(hear)
    for _ in range(99):
        before = len(bench.said)
        bench.step(0.01, hear)
        if len(bench.said) > before:  # it says what its last step decided
            assert bench.robot.words == (("count", stepping.memory["count"]),)
    assert (stepping.memory, stepping.measures) == ({"count": (10.0,), "secret": (1.0, 2.0)}, {"heard": 0.0})
    assert bench.robot.setpoint[0] == pytest.approx(0.05, rel=0.2)
    assert bench.robot.error == pytest.approx(hypot(0.5, 0.5) - 0.5)  # sum over the two links of the file
    assert isnan(running(Bare()).robot.error)
    odd = {"count": (3.0, 4.0), "other": (1.0,)}  # of another size
    bench.step(0.3, lambda bench: hear(bench, odd, {"count": (3.0,)}))
    assert stepping.measures == {"heard": 1.0}
    bench.neighbours.discard_pose(1)
    bench.step(0.3, lambda bench: hear(bench, {}))
    assert stepping.measures == {"heard": 0.0}


def test_what_cannot_be_used_names_the_law():
    for decides in (
        None,
        Control(),
        Control(memory={**REMEMBERED, "count": (1.0, 2.0)}),
        Control(memory={**REMEMBERED, "count": ("a",)}),
        Control(memory=REMEMBERED, velocity=(1.0, 2.0)),
        Control(memory=REMEMBERED, velocity=(0.0, 0.0, nan), goal=(0.0, 0.0, nan)),
        Control(memory=REMEMBERED, measures={"x": "much"}),
    ):
        stepping = Stepping(given(Odd(lambda _, decides=decides: decides)))
        with pytest.raises(PluginError, match="`step` of the law Odd must give"):
            stepping.step(stepping.view())


def test_missing_error_is_found_before_take_off():
    with pytest.raises(PluginError, match="`error` of the law Silent must give a number, not nothing"):
        Bench(given(Silent()), ZERO).step(0.2, hear)


def test_a_law_that_cannot_begin_is_named():
    for law, message in (
        (Beginning(lambda robot: 1.0 / robot.number), "the law Beginning failed: ZeroDivisionError"),
        (Beginning(lambda _: 0.0), "`begin` of the law Beginning must give a tuple of numbers for each variable"),
        (Beginning(lambda _: (0.0,) * 65), "the law Beginning says 65 numbers; a pose carries 64"),
        (saying(("count",)), "SAYS of the law Saying must name a Said for each variable"),
        (saying({"count": Said(metre=0.0)}), r"the law Saying: the metre of count is 0\.0, not a positive number"),
    ):
        with pytest.raises(PluginError, match=message):
            Stepping(given(law))


def test_velocity_that_is_not_finite_holds_and_lands():
    def late(view):
        return Control(memory=REMEMBERED, velocity=(nan if view.time > 1.0 else 0.0, 0.0, nan))

    bench = running(Odd(late)).step(0.9, hear)
    assert bench.life.phase == RUNNING
    bench.step(0.5, hear)
    assert bench.robot.setpoint == (0.0, 0.0, 0.0, 0.0)
    assert any("the law Odd decides what is not finite" in each.text for each in bench.robot.hazards.incidents)
    assert bench.step(30.0, hear).life.phase >= LANDING


def test_words_on_unknown_reads_change_nothing():
    def aim(view):
        return Control(memory=REMEMBERED, velocity=(*view.target_velocity[:2], view.neighbours[0].link.bearing[0]))

    speeds = []
    for asks in (False, True):
        bench = running(Odd(aim), legs=(Leg(0.0, Line(move_by=[1.0, 0.0], speed_=0.1)),)).step(0.9, hear)
        goals = bench.robot.goals
        words = goals.unknown_reads(99.0, (5.0, 5.0, 0.0)) if asks else ""
        assert words.startswith(": Odd reads link.bearing") == asks
        assert "view.target" not in words
        bench.step(0.2, hear)
        speeds.append(goals.stepping.velocity[:2])
    assert speeds[0] == speeds[1] == pytest.approx((0.1, 0.0), abs=1e-6)


def test_deviation_counts_in_metres():
    speech = Speech(Counting(), {"count": (0.0,)})
    speech.record()
    assert speech.deviation(0.1) == 0.1  # before the first step there is nothing to say
    assert speech.words == ()
    for count, deviation, words in (
        (0.0, inf, (("count", (0.0,)),)),
        (50.0, 0.5, (("count", (50.0,)),)),
        (nan, 0.0, ()),
        (1.0 / 3.0, inf, (("count", (0.3333333,)),)),
    ):
        speech.update({"count": (count,)})
        assert speech.deviation(0.0) == deviation
        assert speech.deviation(0.7) == max(deviation, 0.7)
        speech.record()
        assert speech.words == words
        assert speech.deviation(0.0) == 0.0


def test_poses_without_words_are_as_they_were():
    pose = messages.pose("A", 1, 2.0, (1.0, 2.0, 3.0), ZERO, yaw=0.5)
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
    pose = messages.Pose("A", 1, 2.0, ZERO, shared=shared)
    with pytest.raises(Malformed):
        validation.check_pose(pose, now=2.0, valid_box=(1.0, 1.0, 1.0))


def test_reference_moves_with_the_velocity_and_stays_near():
    follower, here, ahead = VelocityFollower(CRAZYFLIE, 0.8), (0.0, 0.0, 0.8), 1.0 / CRAZYFLIE.response
    for _ in range(100):
        goal = follower.goal((0.1, 0.0, nan), (0.0, 0.0, 0.7), 0.02)  # a robot that is held back
    assert follower.reference == pytest.approx((LEASH, 0.0, 0.8))
    assert goal == pytest.approx((LEASH + 0.1 * ahead, 0.0, 0.8))
    fast = VelocityFollower(CRAZYFLIE, 0.8).goal((30.0, 40.0, nan), here, 0.02)
    assert fast == pytest.approx((0.6 * CRAZYFLIE.speed * ahead, 0.8 * CRAZYFLIE.speed * ahead, 0.8))
    resting = VelocityFollower(CRAZYFLIE, 0.8)
    places = [resting.goal((0.0, 0.0, nan), (0.01 * (k % 3 - 1), 0.0, 0.8), 0.02) for k in range(50)]
    assert dist(places[0], places[-1]) == 0.0
    assert VelocityFollower(KHEPERA4, 0.0).goal((0.0, 0.0, 0.3), (0.2, 0.1, 0.0), 0.02) == (0.2, 0.1, 0.0)
