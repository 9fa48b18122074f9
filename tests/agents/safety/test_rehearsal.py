"""Plug-ins are called before take-off: one that gives something else than it must is refused by name."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from agents.decision.lifecycle import READY
from agents.plugins.laws import Distance
from agents.plugins.planners import Leg, Planner
from agents.plugins.predictors import Predictor
from agents.plugins.registry import PluginError
from agents.plugins.triggers import Trigger
from experiments.definition.plan import Plan
from tests.agents.bench import Bench
from tests.agents.few import pair


class Answer(Trigger, frozen=True):
    """Fires by an answer."""

    answer: object = None

    def fires(self, view):
        return self.answer


class Pull(Distance, frozen=True):
    answer: object = None

    def pull(self, apart, link):
        return self.answer


class Way(Planner, frozen=True):
    answer: object = None

    def target(self, elapsed, anchor, heading):
        return self.answer


class Guess(Predictor, frozen=True):
    answer: object = None

    def position(self, pose, age):
        return self.answer


def idle(**parts):
    given = replace(Plan(pair()).assignment("A"), **parts)
    bench = Bench(given, (-0.4, 0.0, 0.0))
    bench.hear(0, (0.4, 0.1, 0.0))
    return bench


@pytest.mark.parametrize("place", ["trigger", "update"])
@pytest.mark.parametrize(("answer", "told"), [(None, "nothing: is a `return` missing"), (1.0, "1.0"), ("yes", "'yes'")])
def test_trigger_must_give_a_bool(place, answer, told):
    bench = idle(**{place: Answer(answer=answer)})
    with pytest.raises(PluginError, match=rf"`fires` of the trigger Answer must give True or False, not {told}"):
        bench.step()
    assert bench.life.takeoff()


@pytest.mark.parametrize("answer", [True, False, np.True_])
def test_bools_of_numpy_are_bools(answer):
    bench = idle(trigger=Answer(answer=answer)).step()
    assert bench.life.phase == READY


@pytest.mark.parametrize("answer", [None, 0.0, (1.0, 2.0), "abc", ("a", "b", "c")])
@pytest.mark.parametrize(
    ("part", "plugin", "wanted"),
    [
        ("law", Pull, "`pull` of the law Pull must give three numbers"),
        ("predictor", Guess, "`position` of the predictor Guess must give three numbers"),
        ("legs", Way, "`target` of the planner Way must give four numbers"),
    ],
)
def test_vectors_must_be_numbers(part, plugin, wanted, answer):
    made = plugin(answer=answer)
    bench = idle(**{part: (Leg(30.0, made),) if part == "legs" else made})
    with pytest.raises(PluginError, match=wanted):
        bench.step()


class Counting(Trigger, frozen=True):
    MEMORY: ClassVar = {"asked": 0}

    def fires(self, view):
        view.memory.asked += 1
        return False


def test_rehearsal_leaves_no_trace():
    bench = idle(trigger=Counting()).step()
    assert bench.robot.transmitter.asking.view.memory.asked == 1
