"""Errors of a tick name the plug-in to blame."""

from pathlib import Path

import msgspec
import pytest

from agents.plugins.calls import explain, failure, wrong
from agents.plugins.registry import PluginError


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
