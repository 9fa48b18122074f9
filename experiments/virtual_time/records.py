"""Objects of a tick as records in memory, for functions that are compiled.

Numbers stand in a record as they are, tuples of numbers in place, other objects and lists as addresses, eight bytes
each. Which attributes a record has follows from the values that an object has; texts and the like are left out.
"""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Sequence
from functools import cache
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np

WORD: Final = 8  # bytes
FLOAT, INT, BOOL = "float", "int", "bool"
NUMBERS: Final[dict[type, str]] = {float: FLOAT, int: INT, bool: BOOL}
LEFT_OUT: Final = {"assignment", "_assignment", "_generator", "_preflight"}  # of no use to a quiet function


class Floats(NamedTuple):
    """Tuple of numbers."""

    size: int


class Items(NamedTuple):
    """List, tuple or array of values of one kind."""

    item: Any


class Layout:
    """Attributes of objects of one class whose values are of the same kinds."""

    def __init__(self, owner: type, fields: dict[str, Any], fixed: dict[str, Any], name: str) -> None:
        """`fixed`: attributes that are constants, with their values; `name` tells layouts apart in any process."""
        self.owner, self.fields, self.fixed, self.name = owner, fields, fixed, name
        self.offset, words = dict[str, int](), 0
        for field, kind in fields.items():
            self.offset[field], words = words, words + width(kind)
        self.words = max(words, 1)

    def __repr__(self) -> str:
        return self.name


def width(kind: Any) -> int:
    """Words that a value takes."""
    if isinstance(kind, Floats):
        return kind.size
    return 2 if isinstance(kind, Items) else 1


@cache
def attributes(owner: type) -> tuple[str, ...]:
    """Attributes of objects with slots, of structs."""
    names = list(getattr(owner, "__struct_fields__", ()))
    for base in reversed(owner.__mro__):
        slots = base.__dict__.get("__slots__", ())
        names += [slots] if isinstance(slots, str) else slots
    return tuple(name for name in dict.fromkeys(names) if name not in LEFT_OUT)


def is_frozen(owner: type) -> bool:
    """Whether objects of a class never change."""
    struct, data = getattr(owner, "__struct_config__", None), getattr(owner, "__dataclass_params__", None)
    return (struct is not None and struct.frozen) or (data is not None and data.frozen)


LAYOUTS: Final[dict[tuple[Any, ...], Layout]] = {}  # a class that was defined anew is another one


class Layouts:
    """Layouts of objects; of an empty list the kind is known once another object had something in it."""

    def __init__(self) -> None:
        self._filled: dict[tuple[type, str], Items] = {}
        self._of: dict[int, tuple[Any, Layout | None]] = {}  # by identity; the object is kept, or another would take it
        self.guessed = False  # whether a list was empty of which no other one was filled

    def forget(self) -> None:
        """Look at all objects anew."""
        self._of.clear()
        self.guessed = False

    def hold(self) -> bool:
        """Whether all constant attributes of the objects are what they were."""
        for thing, layout in self._of.values():
            for name, value in () if layout is None else layout.fixed.items():
                now = getattr(thing, name)
                if now is not value and (value is None or now is None or now != value):
                    return False
        return True

    def kind(self, value: Any, where: tuple[type, str] | None = None) -> Any:
        """Kind of a value, None if it has no place in a record; `where`: class and name of the attribute."""
        if (number := NUMBERS.get(type(value))) is not None:
            return number
        if isinstance(value, int):  # of an enumeration
            return INT
        if isinstance(value, array):
            return Items(FLOAT)
        if isinstance(value, list | tuple):
            return self._kind_of_items(value, where)
        if value is None or isinstance(value, str | dict | set | type) or callable(value):
            return None
        return self.of(value)

    def _kind_of_items(self, value: Sequence[Any], where: tuple[type, str] | None) -> Any:
        if not value:
            found = None if where is None else self._filled.get(where)
            self.guessed = self.guessed or found is None
            return found
        of = set(map(type, value))
        if of == {float}:
            if isinstance(value, tuple):
                return Floats(len(value))
            items = Items(FLOAT)
        elif of == {tuple}:  # of as many numbers
            items = Items(self.kind(value[0]))
        else:
            kinds = {self.kind(each) for each in value}
            if len(kinds) > 1 or None in kinds:
                return None
            items = Items(kinds.pop())
        if where is not None:
            self._filled[where] = items
        return items

    def of(self, thing: Any) -> Layout | None:
        """Layout of an object; None within a circle of objects, of which one is left out."""
        known = self._of.get(id(thing))
        if known is not None:
            return known[1]
        self._of[id(thing)] = (thing, None)
        owner: type = type(thing)
        fields, fixed = dict[str, Any](), dict[str, Any]()
        names = getattr(owner, "FIXED", ())
        for name in attributes(owner) or getattr(thing, "__dict__", ()):
            try:
                value = getattr(thing, name)
            except AttributeError:  # never set
                continue
            if name in names:
                kind = None
            elif (kind := NUMBERS.get(type(value))) is None and value is not None:
                kind = self.kind(value, (owner, name))
            if kind is not None:
                fields[name] = kind
            elif value is None or name in names or (isinstance(value, list | tuple) and not value):
                fixed[name] = value
        key = (owner, tuple(fields.items()), repr(fixed) if fixed else "")
        layout = LAYOUTS.get(key)
        if layout is None:
            text = f"{owner.__module__}.{owner.__qualname__} {fields} {fixed}"
            name = f"{owner.__name__}-{hashlib.sha256(text.encode()).hexdigest()[:20]}"
            layout = LAYOUTS[key] = Layout(owner, fields, fixed, name)
        self._of[id(thing)] = (thing, layout)
        return layout


class Image:
    """Objects stored in memory, for as long as compiled functions work on them."""

    def __init__(self, layouts: Layouts, roots: Sequence[tuple[Any, Any]]) -> None:
        """Store `roots`, each with its kind, and all objects that they lead to."""
        self._layouts = layouts
        self._objects: dict[str, tuple[Layout, list[Any]]] = {}  # by layout
        self._lists: list[tuple[Sequence[Any], Any]] = []
        self._seen = set[int]()
        for thing, kind in roots:
            self._collect(thing, kind)
        self._word: dict[int, int] = {}
        word = 0
        for layout, things in self._objects.values():
            for thing in things:
                self._word[id(thing)], word = word, word + layout.words
        for items, kind in self._lists:
            self._word[id(items)], word = word, word + len(items) * width(kind)
        self.words = np.zeros(word + 1, dtype=np.int64)
        self._floats = self.words.view(np.float64)
        self._base = self.words.ctypes.data
        self.store()

    def address(self, thing: Any) -> int:
        if isinstance(thing, array):
            return thing.buffer_info()[0]
        return int(self._base + WORD * self._word[id(thing)])

    def _collect(self, thing: Any, kind: Any) -> None:
        if id(thing) in self._seen or isinstance(thing, array):
            return
        self._seen.add(id(thing))
        if isinstance(kind, Items):
            self._lists.append((thing, kind.item))
            if isinstance(kind.item, Layout | Items):
                for each in thing:
                    self._collect(each, kind.item)
            return
        self._objects.setdefault(kind.name, (kind, []))[1].append(thing)
        for name, field in kind.fields.items():
            if isinstance(field, Layout | Items):
                self._collect(getattr(thing, name), field)

    def store(self) -> None:
        """Write the values of all objects."""
        for layout, things in self._objects.values():
            begin = self._word[id(things[0])]
            for name, kind in layout.fields.items():
                values = list(map(attrgetter(name), things))
                try:
                    self._write(values, kind, begin + layout.offset[name], layout.words)
                except (KeyError, TypeError) as error:
                    raise TypeError(f"{name} of {layout.owner.__name__} has changed its type: {error}") from error
        for items, kind in self._lists:
            if len(items):
                self._write(items, kind, self._word[id(items)], width(kind))

    def _write(self, values: Sequence[Any], kind: Any, begin: int, step: int) -> None:
        """Write values of a kind, one for each `step` words."""
        at = slice(begin, begin + step * len(values), step)
        if kind == FLOAT:
            self._floats[at] = values
        elif isinstance(kind, Floats):
            for k in range(kind.size):
                self._floats[begin + k : begin + k + step * len(values) : step] = [value[k] for value in values]
        elif isinstance(kind, Items):
            self.words[at] = [self.address(value) for value in values]
            self.words[begin + 1 : begin + 1 + step * len(values) : step] = [len(value) for value in values]
        elif isinstance(kind, Layout):
            self.words[at] = [self.address(value) for value in values]
        else:
            found = np.array(values)
            if found.dtype.kind not in "ib":
                raise TypeError(f"whole numbers or truths were expected, not {values[:3]}")
            self.words[at] = found

    def load(self) -> None:
        """Read the values of all objects that can change back."""
        for layout, things in self._objects.values():
            if is_frozen(layout.owner):
                continue
            begin = self._word[id(things[0])]
            for name, kind in layout.fields.items():
                if not isinstance(kind, Layout | Items):
                    values = self._read(len(things), kind, begin + layout.offset[name], layout.words)
                    for thing, value in zip(things, values, strict=True):
                        setattr(thing, name, value)
        for items, kind in self._lists:
            if isinstance(items, list) and not isinstance(kind, Layout | Items):
                items[:] = self._read(len(items), kind, self._word[id(items)], width(kind))

    def _read(self, count: int, kind: Any, begin: int, step: int) -> list[Any]:
        end = begin + step * count
        if isinstance(kind, Floats):
            columns = (self._floats[begin + k : end + k : step].tolist() for k in range(kind.size))
            return list(zip(*columns, strict=True))
        if kind == FLOAT:
            found: list[Any] = self._floats[begin:end:step].tolist()
            return found
        found = self.words[begin:end:step].tolist()
        return [bool(value) for value in found] if kind == BOOL else found
