"""Objects of a tick as records: layouts, what is stored, and what is read back."""

from array import array
from math import inf, nan
from typing import ClassVar

import msgspec
import pytest

from experiments.virtual_time.records import BOOL, FLOAT, INT, Floats, Image, Items, Layouts


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
    image.read()
    known = whole.count, type(whole.count), whole.ok, whole.fast, whole.name, whole.other
    assert known == (7, int, True, True, "text", None)
    assert type(whole.ok) is bool
    assert whole.first is whole.second is kept
    assert kept.at == pytest.approx((1.5, 0.0, nan), nan_ok=True)
    assert (whole.numbers, [part.size for part in whole.parts]) == ([1.0, inf], [1.0, 2.0])
    image.words[Layouts().of(whole).offset["count"]] = 9
    image.read()
    assert whole.count == 9
    image = stored(frozen := Frozen())
    image.words[:] = 0
    image.read()
    assert frozen == Frozen()  # not written
