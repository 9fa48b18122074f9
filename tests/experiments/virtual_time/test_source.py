"""Source of quiet functions as a compiler gets it: constants decided, branches left out, loops that count."""

import math
from array import array
from math import inf, isnan, nan
from pathlib import Path
from typing import ClassVar

import msgspec
import pytest

from agents.plugins.laws import Distance
from experiments.virtual_time import source
from experiments.virtual_time.records import BOOL, FLOAT, INT, Floats, Image, Items, Layouts
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
    assert (space["squared"](None, 3), source.POWER in names) == (("power", ("power", 3, 2), 3), True)


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


class Part:
    __slots__ = ("at", "size")

    def __init__(self, size):
        self.size, self.at = size, (size, 0.0, nan)


class Whole:
    FIXED: ClassVar = ("fast",)
    __slots__ = ("count", "fast", "first", "late", "name", "numbers", "ok", "other", "parts", "second", "times")

    def __init__(self, parts=()):
        self.count, self.ok, self.fast, self.name, self.other = 7, True, True, "text", None
        self.first = self.second = Part(1.5)
        self.parts, self.numbers, self.times = list(parts), [1.0, inf], array("d", [1.0, 2.0])


class Frozen(msgspec.Struct, frozen=True):
    gain: float = 0.5
    only: bool = True


def stored(*things):
    layouts = Layouts()
    return Image([(thing, layouts.of(thing)) for thing in things], 1)


def test_kinds_of_attributes():
    kind = Layouts().of(Whole([Part(1.0)]))
    first = kind.fields["first"]
    lists = {"parts": Items(first), "numbers": Items(FLOAT), "times": Items(FLOAT)}
    assert kind.fields == {"count": INT, "ok": BOOL, "first": first, "second": first, **lists}
    assert (kind.fixed, kind.words) == ({"fast": True, "other": None}, 4 + 2 * 3)  # two words for each list
    circle = Part(1.0)
    circle.at = circle
    found = [first.fields, *(Layouts().of(each).fields for each in (circle, Frozen()))]
    assert found == [{"at": Floats(3), "size": FLOAT}, {"size": FLOAT}, {"gain": FLOAT, "only": BOOL}]


def test_same_attributes_same_layout_unless_of_other_classes():
    def defined():
        class Local(msgspec.Struct, frozen=True):
            gain: float = 1.0

        return Local

    layouts, one, other = Layouts(), defined(), defined()
    assert layouts.of(Part(1.0)) is layouts.of(Part(2.0)) is Layouts().of(Part(3.0))
    assert [layouts.of(each()).owner for each in (one, other)] == [one, other]
    empty, full = Whole(), Whole([Part(1.0)])
    assert layouts.of(empty).fixed["parts"] == []
    layouts.of(full)
    assert layouts.guessed
    layouts.forget()
    assert layouts.of(empty) is layouts.of(full)  # an empty list takes the kind of others
    assert layouts.of(empty).fields["parts"] == Items(layouts.of(full.first))


OTHER = {"fast": [False], "other": [3.0], "parts": [[1.0], [Part(1.0)]], "first": [Frozen()], "count": [0.5]}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in OTHER.items() for value in values])
def test_object_of_another_layout_is_refused(name, value):
    whole = Whole()
    kind = Layouts().of(whole)
    Image([(whole, kind)])
    setattr(whole, name, value)
    with pytest.raises(TypeError, match=r"as before|Whole"):
        Image([(whole, kind)])


def test_one_object_is_one_record():
    shared = Part(2.0)
    one, other = Whole([shared]), Whole([shared, Part(3.0)])
    other.first = other.second = one.first
    image = stored(one, other)
    assert len({image.address(each) for each in (shared, one.first, other.second, other.parts[1], one, other)}) == 5


def test_load_gives_what_was_stored():
    whole = Whole([Part(1.0), Part(2.0)])
    kept = whole.first
    image = stored(whole)
    image.load()
    known = whole.count, type(whole.count), whole.ok, whole.fast, whole.name, whole.other
    assert known == (7, int, True, True, "text", None)
    assert type(whole.ok) is bool
    assert whole.first is whole.second is kept
    assert kept.at == pytest.approx((1.5, 0.0, nan), nan_ok=True)
    assert (whole.numbers, [part.size for part in whole.parts]) == ([1.0, inf], [1.0, 2.0])
    image.words[Layouts().of(whole).offset["count"]] = 9
    image.load()
    assert whole.count == 9
    image = stored(frozen := Frozen())
    image.words[:] = 0
    image.load()
    assert frozen == Frozen()  # not written
