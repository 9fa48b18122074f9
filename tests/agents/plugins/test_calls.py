"""Errors of a tick name the plug-in to blame."""

from math import nan
from pathlib import Path
from typing import ClassVar

import msgspec
import pytest

from agents.formation.link import BY_NOTHING, Link
from agents.plugins.calls import explain, failure, unknown_reads, wrong
from agents.plugins.law import Control, Law, NeighbourView, RobotFacts, Said, View
from agents.plugins.registry import PluginError
from agents.vectors import ZERO


class Spring(msgspec.Struct, frozen=True):
    """A law that goes wrong in a way."""

    way: str = ""

    def pull(self, apart, link):
        if self.way == "fails":
            return self.divide(apart)
        return None if self.way == "nothing" else (1.0, 2.0)

    def divide(self, apart):
        return half(apart) / 0.0


class Push(msgspec.Struct, frozen=True):
    """An avoidance that does nothing wrong."""

    def restrain(self, setpoint, own, near):
        return setpoint


def half(number):
    return 0.5 * number


def explained(call):
    """Text of the error of a tick, and its kind."""
    try:
        call()
    except (ArithmeticError, TypeError, LookupError, PluginError) as error:
        return explain(error, [("avoidance", PUSH), ("law", LAW["fails"]), ("law", LAW["nothing"])])
    raise AssertionError


PUSH, LAW = Push(), {way: Spring(way) for way in ("fails", "nothing", "short")}


def tick(law):
    x, y, z = law.pull(1.0, None)
    return x, y, z


def test_failure_names_plug_in_and_line():
    error = explained(lambda: tick(LAW["fails"]))
    lines = Path(__file__).read_text("utf-8").splitlines()
    line = 1 + next(k for k, text in enumerate(lines) if "return half(apart)" in text)
    assert isinstance(error, PluginError)
    assert str(error) == f"the law Spring failed: ZeroDivisionError: float division by zero ({__file__}:{line})"


def test_result_of_no_use_names_the_method():
    error = explained(lambda: tick(LAW["nothing"]))
    assert isinstance(error, PluginError)
    assert "`pull` of the law Spring gives what cannot be used" in str(error)
    assert "is a `return` missing?" in str(error)


def test_other_errors_stay_what_they_are():
    assert isinstance(explained(lambda: half("x")), TypeError)
    assert isinstance(explained(lambda: {}["x"]), KeyError)
    told = failure("law", LAW["fails"], ValueError("no"))

    def again():
        raise told

    assert explained(again) is told


@pytest.mark.parametrize(("result", "text"), [(None, "nothing: is a `return` missing?"), ((1.0, 2.0), "(1.0, 2.0)")])
def test_wrong_result_is_shown(result, text):
    error = wrong("law", LAW["short"], "pull", result, "three numbers")
    assert str(error) == f"`pull` of the law Spring must give three numbers, not {text} ({__file__})"


class Reader(Law):
    """A law that reads one thing of what it sees."""

    SAYS: ClassVar = {"x": Said()}
    reads: str

    def step(self, view, memory):
        found = {
            "distance": lambda: [each.link.distance for each in view.neighbours],
            "bearing": lambda: [each.link.bearing for each in view.known()],
            "said": lambda: [each.said["x"] for each in view.neighbours],
            "target": lambda: view.target,
            "position": lambda: [each.position for each in view.neighbours],
        }[self.reads]()
        return Control(velocity=(nan * len(found), 0.0, nan))


@pytest.mark.parametrize(
    ("reads", "words"),
    [
        ("distance", 'link.distance, unknown with NEEDS = "nothing": give the law NEEDS = "distance"'),
        ("bearing", 'link.bearing, unknown with NEEDS = "nothing": give the law NEEDS = "bearing"'),
        ("said", "said['x'] of neighbours that have not said it yet: ask view.known for them"),
        ("target", "view.target of a robot without a plan: ask math.isfinite before"),
        ("position", ""),
    ],
)
def test_unknown_reads_name_field_and_remedy(reads, words):
    link = Link(nan, wants=BY_NOTHING)
    view = View(
        RobotFacts("A", 0, 2, False, 1.0, 0.1), {"x": (0.0,)},
        [NeighbourView(1, "B", ZERO, ZERO, 0.0, 0.0, {"x": (nan,)}, link)],
    )  # fmt: skip
    law = Reader(reads)
    assert unknown_reads(law, lambda watched: law.step(watched(view), {})) == (words and f": Reader reads {words}")
