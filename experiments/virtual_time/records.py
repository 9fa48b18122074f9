"""Objects of a tick as records in memory, for functions that are compiled.

Numbers stand in a record as they are, tuples of numbers in place, other objects and lists as addresses, eight bytes
each. Which attributes a record has follows from the values that an object has; texts and the like are left out.

Attributes that a class names: `FIXED` are constants, `RARE` are of no use to quiet functions, `UNSIGNED` have 64 bits.
`NAMED` are dictionaries of tuples of floats with the same names for ever. `MEASURED` are those of floats by measure.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from typing import Any, Final, NamedTuple, cast

import numpy as np

from agents.plugins.law import Law

WORD: Final = 8  # bytes
FLOAT, INT, BOOL, UNSIGNED = "float", "int", "bool", "unsigned"
NUMBERS: Final[dict[type, str]] = {float: FLOAT, int: INT, bool: BOOL}
LONG: Final = 1000  # length from which a text or a table of a law is none that its step reads
MEASURES: Final = 12  # most measures of the laws of a run
LEFT_OUT: Final = {"assignment", "_assignment", "_generator"}  # names of no use to a quiet function


class Floats(NamedTuple):
    """Tuple of numbers."""

    size: int


class Named(NamedTuple):
    """Dictionary of tuples of numbers, in the order of their names."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]


class Measured(NamedTuple):
    """Dictionary of measures: a bit for each that is there, as a float, and their values."""

    size: int = 1 + MEASURES


@dataclass(frozen=True)
class Items:
    """List, tuple or array of values of one kind."""

    item: Any
    words: int = field(init=False, repr=False, compare=False)  # words of an item
    code: str = field(init=False, repr=False, compare=False)  # letter of `struct` for a word

    def __post_init__(self) -> None:
        object.__setattr__(self, "words", width(self.item))
        object.__setattr__(self, "code", _code(self.item))


class RecordLayout:
    """Attributes of objects of one class with values of the same kinds."""

    def __init__(self, owner: type, fields: dict[str, Any], fixed: dict[str, Any]) -> None:
        """`fixed`: attributes that are constants, with their values."""
        self.owner, self.fields, self.fixed = owner, fields, fixed
        self.frozen = is_frozen(owner)
        self.offset, words = dict[str, int](), 0
        for attribute, kind in fields.items():
            self.offset[attribute], words = words, words + width(kind)
        self.words = max(words, 1)
        self.store, self.load = _storing(self), _loading(self)

    def __repr__(self) -> str:
        return f"{self.owner.__name__} at {id(self)}"


def width(kind: Any) -> int:
    """Words that a value takes."""
    if isinstance(kind, Floats | Measured):
        return kind.size
    return sum(kind.sizes) if isinstance(kind, Named) else 2 if isinstance(kind, Items) else 1


def numbers(of: Any) -> list[float]:
    """All numbers of a dictionary that is `Named` or `Measured`, where they stand; in compiled functions alone."""
    raise TypeError(type(of).__name__)


@cache
def attributes(owner: type) -> tuple[str, ...]:
    """Attributes of objects with slots, of structs."""
    names = list(getattr(owner, "__struct_fields__", ()))
    for base in reversed(owner.__mro__):
        slots = base.__dict__.get("__slots__", ())
        names += [slots] if isinstance(slots, str) else slots
    return tuple(name for name in dict.fromkeys(names) if name not in LEFT_OUT)


@cache
def marks(owner: type) -> tuple[tuple[str, ...], set[str], list[set[str]]]:
    """Attributes of objects with slots, those of no use, and those that a class names; see above."""
    names = [set(getattr(owner, each, ())) for each in ("FIXED", "NAMED", "MEASURED", "UNSIGNED")]
    return attributes(owner), LEFT_OUT | set(getattr(owner, "RARE", ())), names


def is_frozen(owner: type) -> bool:
    """Whether objects of a class never change."""
    struct, data = getattr(owner, "__struct_config__", None), getattr(owner, "__dataclass_params__", None)
    return (struct is not None and struct.frozen) or (data is not None and data.frozen)


LAYOUTS: Final[dict[tuple[Any, ...], RecordLayout]] = {}  # a class that was defined again is another one


class Layouts:
    """Layouts of objects; of an empty list the kind is known once another object had something in it."""

    def __init__(self) -> None:
        self._filled: dict[tuple[type, str], Items] = {}
        self._of: dict[
            int, tuple[Any, RecordLayout | None]
        ] = {}  # layouts by identity; the object is kept, or another would take it
        self._empty = set[tuple[type, str] | None]()  # attributes with a list that was empty then

    @property
    def guessed(self) -> bool:
        """Whether a list was empty of which another one was filled later."""
        return not self._empty.isdisjoint(self._filled)

    def forget(self) -> None:
        """Forget all objects, to look at them again."""
        self._of.clear()
        self._empty.clear()

    def kind(self, value: Any, where: tuple[type, str] | None = None) -> Any:
        """Kind of a value, None if it has no place in a record; `where`: class and name of the attribute."""
        if (number := NUMBERS.get(type(value))) is not None:
            return number
        if isinstance(value, int):  # member of an enumeration
            return INT
        if isinstance(value, array | memoryview):  # their items are floats
            return Items(FLOAT)
        if isinstance(value, list | tuple):
            return self._kind_of_items(value, where)
        if value is None or isinstance(value, str | dict | set | type) or callable(value):
            return None
        return self.of(value)

    def _kind_of_items(self, value: Sequence[Any], where: tuple[type, str] | None) -> Any:
        if not value:
            found = None if where is None else self._filled.get(where)
            if found is None:
                self._empty.add(where)
            return found
        of = set(map(type, value))
        if of == {float}:
            if isinstance(value, tuple):
                return Floats(len(value))
            items = Items(FLOAT)
        elif of == {tuple}:  # numbers of one type
            items = Items(self.kind(value[0]))
        else:
            kinds = {self.kind(each) for each in value}
            if len(kinds) > 1 or None in kinds:
                return None
            items = Items(kinds.pop())
        if where is not None:
            self._filled[where] = items
        return items

    def of(self, thing: Any) -> RecordLayout | None:
        """Layout of an object; None within a circle of objects, of which one is left out."""
        known = self._of.get(id(thing))
        if known is not None:
            return known[1]
        self._of[id(thing)] = (thing, None)
        owner: type = type(thing)
        fields, fixed = dict[str, Any](), dict[str, Any]()
        listed, rare, (names, named, measured, unsigned) = marks(owner)
        for name in (*listed, *getattr(thing, "__dict__", ())):
            if name in rare:
                continue
            try:
                value = getattr(thing, name)
            except AttributeError:  # never set
                continue
            kind: Any = None
            if name in named and value:
                kind = Named(tuple(sorted(value)), tuple(len(value[each]) for each in sorted(value)))
            elif name in measured:
                kind = Measured()
            elif name in unsigned:
                kind = UNSIGNED
            elif name not in names and value is not None:
                kind = NUMBERS.get(type(value)) or self.kind(value, (owner, name))
            if kind is not None:
                fields[name] = kind
            elif isinstance(thing, Law) and isinstance(value, str | dict) and len(value) < LONG:
                fixed[name] = value
            elif value is None or name in names or name in named or (isinstance(value, list | tuple) and not value):
                fixed[name] = value[:0] if isinstance(value, list) else value  # it may be filled later
        key = (owner, tuple(fields.items()), repr(fixed) if fixed else "")
        layout = LAYOUTS.get(key)
        if layout is None:
            layout = LAYOUTS[key] = RecordLayout(owner, fields, fixed)
        self._of[id(thing)] = (thing, layout)
        return layout


class Image:
    """Objects stored in memory, for as long as compiled functions work on them."""

    def __init__(
        self, roots: Sequence[tuple[Any, RecordLayout]], words: int = 1 << 12, measures: list[str] | None = None
    ) -> None:
        """Store `roots`, each with its layout, and all objects that they lead to.

        Args:
            words: About as many as they take.
            measures: Names of measures, to which others are added.

        Raises:
            TypeError: If an object is not as its layout says.
        """
        self.roots, self._size = roots, words
        self.measures = [] if measures is None else measures
        while not self._store():
            self._size *= 2

    def address(self, thing: Any) -> int:
        return self.known[id(thing)]

    def read(self, things: Iterable[object] | None = None) -> None:
        """Read the values of some objects back, of those that have a record; or of all, with their lists."""
        places = self.places
        if things is not None:
            for thing in things:
                if (found := places.get(id(thing))) is not None:
                    found[1].load(thing, self, found[2])
            return
        for thing, layout, at in places.values():
            layout.load(thing, self, at)
        for items, kind, at in self._lists:
            items[:] = _items(self.memory, at, len(items), kind)

    def write(self, things: Iterable[object]) -> None:
        """Write the values of some objects that have a record."""
        for thing in things:
            if (found := self.places.get(id(thing))) is not None:
                found[1].store(self, thing, found[2])

    def free(self) -> None:
        """Forget all objects, since functions that were called back still refer to the image."""
        self.roots = ()
        self.places.clear()
        self.arrays.clear()

    def _store(self) -> bool:
        """Write the values of all objects; returns whether there is room for them."""
        self.words = np.zeros(self._size, dtype=np.int64)
        self.memory, self._base = self.words.data.cast("B"), self.words.ctypes.data
        self.known: dict[int, int] = {}  # address by identity
        # objects that can change, by identity, each with its place [bytes]
        self.places: dict[int, tuple[Any, RecordLayout, int]] = {}
        self._lists: list[tuple[list[Any], Items, int]] = []
        self.arrays: dict[int, array[float]] = {}  # arrays that records refer to, by identity
        self.used = 0
        try:
            for thing, layout in self.roots:
                self.put(thing, layout)
        except _FullError:
            return False
        return True

    def take(self, thing: Any, words: int) -> int:
        """Room for an object of `words` words: its place in the memory [bytes]."""
        at, self.used = WORD * self.used, self.used + words
        if self.used > self._size:
            raise _FullError
        self.known[id(thing)] = self._base + at
        return at

    def put(self, thing: Any, layout: RecordLayout) -> int:
        """Store an object, and what it leads to, unless it is there already; returns its address."""
        found = self.known.get(id(thing))
        if found is not None:
            return found
        at = self.take(thing, layout.words)
        try:
            layout.store(self, thing, at)
        except (struct.error, AttributeError, LookupError) as error:
            raise TypeError(f"{layout.owner.__name__} has an attribute that has changed its type: {error}") from error
        if not layout.frozen:
            self.places[id(thing)] = thing, layout, at
        return self._base + at

    def measured(self, values: Mapping[str, float]) -> list[float]:
        """Measures as numbers; raises IndexError for too many."""
        found, known = [0.0] * (1 + MEASURES), 0
        for name, value in values.items():
            if name not in self.measures:
                self.measures.append(name)
            k = self.measures.index(name)
            found[1 + k] = value
            known |= 1 << k
        return [float(known), *found[1:]]

    def as_measures(self, known: float, *values: float) -> dict[str, float]:
        """Measures by name."""
        return {name: values[k] for k, name in enumerate(self.measures) if int(known) >> k & 1}

    def put_items(self, items: Any, kind: Items) -> tuple[int, int]:
        """Store a list unless it is there already; returns its address and its length."""
        count, item = len(items), kind.item
        if isinstance(items, array):
            self.arrays[id(items)] = items
            return items.buffer_info()[0], count
        if isinstance(items, memoryview):
            return np.frombuffer(items).ctypes.data, count
        found = self.known.get(id(items))
        if found is None:
            at = self.take(items, count * kind.words)
            found = self._base + at
            values: Iterable[Any] = items
            if isinstance(item, RecordLayout):
                values = [self.put(each, item) for each in items]
            elif isinstance(item, Items):
                values = chain.from_iterable([self.put_items(each, item) for each in items])
            else:
                if isinstance(item, Floats):
                    values = chain.from_iterable(items)
                if isinstance(items, list):
                    self._lists.append((items, kind, at))
            struct.pack_into(f"{count * kind.words}{kind.code}", self.memory, at, *values)
        return found, count


class _FullError(Exception):
    """Lack of room for an object."""


def _code(kind: Any) -> str:
    """Code of `struct` of the words of a kind."""
    return "d" if kind == FLOAT or isinstance(kind, Floats | Named | Measured) else "Q" if kind == UNSIGNED else "q"


def _format(kind: Any) -> str:
    """Format of `struct` of a value of a kind."""
    return f"{width(kind)}{_code(kind)}"


def _items(memory: memoryview, at: int, count: int, kind: Items) -> list[Any]:
    """Numbers, truths or tuples of numbers of a list."""
    values, item = struct.unpack_from(f"{count * kind.words}{kind.code}", memory, at), kind.item
    if isinstance(item, Floats):
        return list(zip(*[iter(values)] * item.size, strict=True))
    return [value != 0 for value in values] if item == BOOL else list(values)


def _storing(layout: RecordLayout) -> Callable[[Image, Any, int], None]:
    """Function that writes an object at a place of an image; raises TypeError for one of another layout."""
    values, conditions = [], ["type(thing) is owner"]
    space = {"owner": layout.owner}
    for name, kind in layout.fields.items():
        space[f"kind_{name}"] = kind
        if isinstance(kind, RecordLayout):
            values.append(f"(known.get(id(thing.{name})) or image.put(thing.{name}, kind_{name}))")
        elif isinstance(kind, Items):
            values.append(f"*image.put_items(thing.{name}, kind_{name})")
        elif isinstance(kind, Named):
            values += [f"*thing.{name}[{each!r}]" for each in kind.names]
            conditions.append(f"len(thing.{name}) == {len(kind.names)}")
        elif isinstance(kind, Measured):
            values.append(f"*image.measured(thing.{name})")
        else:
            values.append(f"*thing.{name}" if isinstance(kind, Floats) else f"thing.{name}")
    for name, value in layout.fixed.items():
        space[f"fixed_{name}"] = value
        conditions.append(f"thing.{name} is None" if value is None else f"thing.{name} == fixed_{name}")
    pack = struct.Struct("".join(map(_format, layout.fields.values()))).pack_into
    source = f"""
def store(image, thing, at):
    if not ({" and ".join(conditions)}):
        raise TypeError(f"{{type(thing).__name__}} is not as before")
    known = image.known
    pack({", ".join(["image.memory", "at", *values])})
"""
    return cast("Callable[[Image, Any, int], None]", _made(source, "store", pack=pack, **space))


def _loading(layout: RecordLayout) -> Callable[[Any, Image, int], None]:
    """Function that reads the numbers of an object back from a place in the memory of an image."""
    targets, statements, formats = list[str](), list[str](), list[str]()
    for name, kind in layout.fields.items():
        if isinstance(kind, RecordLayout | Items):
            formats.append(f"{WORD * width(kind)}x")
            continue
        formats.append(_format(kind))
        if isinstance(kind, Floats | Named | Measured):
            parts = [f"new_{name}_{k}" for k in range(width(kind))]
            targets += parts
            value = f"({', '.join(parts)},)"
            if isinstance(kind, Measured):
                value = f"image.as_measures{value}"
            elif isinstance(kind, Named):
                rest = iter(parts)
                sized = zip(kind.names, kind.sizes, strict=True)
                tuples = [f"{each!r}: ({' '.join(f'{next(rest)},' for _ in range(size))})" for each, size in sized]
                value = f"{{{', '.join(tuples)}}}"
            statements.append(f"thing.{name} = {value}")
        else:
            targets.append(f"new_{name}")
            statements.append(f"thing.{name} = new_{name}" + " != 0" * (kind == BOOL))
    unpack = struct.Struct("".join(formats)).unpack_from
    got = f"({', '.join(targets)},) = unpack(image.memory, at)" if targets else "pass"
    source = "\n    ".join(["def load(thing, image, at):", got, *statements])
    return cast("Callable[[Any, Image, int], None]", _made(source, "load", unpack=unpack))


def _made(source: str, name: str, **space: Any) -> Any:
    exec(source, space)
    return space[name]
