"""Source of quiet functions as a compiler gets it: constants decided, branches left out, loops that count."""

import math
from math import inf, isnan, nan
from pathlib import Path

import pytest

from agents.plugins.laws import Distance
from experiments.virtual_time import source
from experiments.virtual_time.source import specialised


class Thing:
    def __init__(self, part, steps=()):
        self.part, self.steps, self.lean = part, steps, False

    def without_part(self):
        return 1 if self.part is None else self.part.value

    def counted(self):
        total = 0
        for step in self.steps:
            total += step
        return total

    def branches(self, x):
        if self.lean and x > 0:
            return 1
        if not self.lean or x > 0:
            x += 10
        if self.part is not None:
            x += self.part
        return x

    def squared(self, x):
        y: float = x
        y **= 2
        return y**3

    def asks(self, what):
        return isinstance(what, float)

    def rounds(self, x):
        return round(x, 2)

    def far(self, x):
        return math.hypot(x, x)

    def words(self):
        return f"{self.part}"


def built(function, fixed):
    code, names = specialised(function, fixed)
    space = dict(function.__globals__)
    exec(code, space)
    return space[function.__name__], names


@pytest.mark.parametrize(
    ("method", "fixed", "attributes", "arguments", "value"),
    [
        (Thing.without_part, {"part": None}, (), (None,), 1),
        (Thing.without_part, {}, ("part", "value"), None, None),
        (Thing.branches, {"lean": False, "part": None}, (), (None, 1), Thing(None).branches(1)),
        (Thing.branches, {"lean": True}, None, (Thing(5), -1), 4),
        (Thing.branches, {"lean": True}, None, (None, 1), 1),
        (Thing.counted, {"steps": []}, None, (None,), 0),
        (Thing.counted, {}, None, (Thing(None, [1, 2, 4]),), 7),
    ],
)
def test_constants_are_decided_and_branches_left_out(method, fixed, attributes, arguments, value):
    function, names = built(method, fixed)
    assert attributes in (None, function.__code__.co_names)
    assert arguments is None or function(*arguments) == value
    assert names >= ({"range", "len"} if value == 7 else set())


def test_powers_of_others_are_calls():
    code, names = specialised(Thing.squared, {})
    space = {source.POWER: lambda x, y: ("power", x, y)}
    exec(code, space)
    assert space["squared"](None, 3) == ("power", ("power", 3, 2), 3)
    assert source.POWER in names


FAULTS = {"asks": "a call of isinstance", "rounds": "round to digits", "far": "math.hypot", "words": "an f-string"}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_others_have_file_and_line(name):
    method = getattr(Thing, name)
    with pytest.raises(SyntaxError, match=FAULTS[name]) as caught:
        specialised(method, {})
    assert f"{Path(__file__).name}:{method.__code__.co_firstlineno + 1}:" in str(caught.value)
    for function in (lambda thing: thing, len):
        with pytest.raises((SyntaxError, OSError, TypeError)):
            specialised(function, {})
    assert [text.rpartition(" uses ")[2] for text in source.outside(Thing)].count("math.hypot") == 1
    assert source.outside(Distance) == ()


NUMBERS = (-inf, -1e300, -2.5, -1.0, -0.5, -0.0, 0.0, 0.5, 1.0, 2.5, 710.0, 1e300, inf, nan)


@pytest.mark.parametrize("name", sorted(source.STRICT))
def test_strict_functions_are_those_of_python(name):
    ours, pythons = source.STRICT[name], getattr(math, name, {"int": int, "round": round}.get(name))
    for x in NUMBERS:
        try:
            expected = pythons(x)
        except (ValueError, OverflowError):
            with pytest.raises((ValueError, OverflowError)):
                ours(x)
            continue
        if abs(x) > 2.0**62 and name in {"floor", "ceil", "int", "trunc", "round"}:
            continue  # it has no place in a word
        assert ours(x) == expected or (isnan(ours(x)) and isnan(expected))
