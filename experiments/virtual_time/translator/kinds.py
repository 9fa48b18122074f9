"""Types and values of the functions in C, as `experiments.virtual_time.translator.translation` knows them."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, NamedTuple

from experiments.virtual_time.records import BOOL, FLOAT, INT, UNSIGNED, Floats, Items, Measured, Named, RecordLayout

# types: numbers, by C's names, and what has no value; that of an object is its layout, that of a list its `Items`
DOUBLE, WHOLE, WORD, BOOLEAN, VOID, NONE, NAME = "double", "whole", "word", "_Bool", "void", "none", "name"
STORED: Final = {FLOAT: DOUBLE, INT: WHOLE, BOOL: WHOLE, UNSIGNED: WORD}  # types in a record
WORDS: Final = {
    DOUBLE: "a float",
    WHOLE: "a whole number",
    WORD: "a whole number of 64 bits",
    BOOLEAN: "a bool",
    VOID: "nothing",
    NONE: "None",
    NAME: "a name",
}
LARGEST: Final = 1 << 61  # whole number of which C knows sums
ALL_BITS: Final = (1 << 64) - 1
C_WORDS: Final = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|inline|int|long|register|"
    "restrict|return|short|signed|sizeof|static|struct|switch|typedef|union|unsigned|void|volatile|while|"
    "whole|word|fail|way|turns|back|unknown|inf|exact|largest|nothing|longjmp|fly.*|stretch.*|_.*|.*_|py_.*"
)


class OutsideError(Exception):
    """Something outside of the subset, with its place."""


class Several(NamedTuple):
    """Type of a tuple; or of a dictionary or an object that is a value with names of its parts."""

    parts: tuple[Any, ...]
    names: tuple[str, ...] = ()
    owner: type = tuple


@dataclass(frozen=True)
class Made:
    """Type of a list that a function makes."""

    item: Any


@dataclass(frozen=True)
class TextType:
    """Type of one text."""

    value: str


class Value(NamedTuple):
    """C expression with its type; of a constant its value, else ..., of a tuple that is put together its parts."""

    type: Any
    text: str
    constant: Any = ...
    parts: Sequence[Value] | None = None


def type_of(kind: Any) -> Any:
    """Type of a value of a record."""
    if isinstance(kind, Floats | Measured):
        return Several((DOUBLE,) * kind.size, (), type(kind) if isinstance(kind, Measured) else tuple)
    if isinstance(kind, Named):
        return Several(tuple(Several((DOUBLE,) * size) for size in kind.sizes), kind.names, dict)
    return BOOLEAN if kind == BOOL else STORED[kind] if isinstance(kind, str) else kind


def item_of(kind: Any) -> Any:
    """Type of the items of a list."""
    return kind.item if isinstance(kind, Made) else type_of(kind.item)


def has_value(kind: Any) -> bool:
    """Whether C knows values of a type."""
    return kind != NONE and not isinstance(kind, TextType)


def valueless(kind: Any) -> Value:
    """Value of None or of a text."""
    return constant(kind.value if isinstance(kind, TextType) else None)


def listed(kind: Any) -> str:
    """A type in words."""
    if isinstance(kind, TextType | Made | Items):
        return "a text" if isinstance(kind, TextType) else "a list"
    if isinstance(kind, Several) and kind.owner is tuple:
        return f"a tuple of {len(kind.parts)}"
    return f"an object of {kind.owner.__name__}" if isinstance(kind, RecordLayout | Several) else WORDS[kind]


def constant(x: Any) -> Value:
    """A constant; raises TypeError for one that C does not have."""
    if x is None:
        return Value(NONE, "0", None)
    if isinstance(x, int) and abs(x) < LARGEST:  # also a member of an enumeration
        return Value(BOOLEAN, str(int(x)), x) if isinstance(x, bool) else Value(WHOLE, f"({int(x)}LL)", int(x))
    if isinstance(x, int) and LARGEST <= x <= ALL_BITS:
        return Value(WORD, f"({x}ULL)", x)
    if type(x) is float:
        text = x.hex() if math.isfinite(x) else "unknown.number" if math.isnan(x) else "inf" if x > 0.0 else "-inf"
        return Value(DOUBLE, f"({text})", x)
    if isinstance(x, str):
        return Value(TextType(x), "0", x)
    if not isinstance(x, tuple | list | Mapping):
        raise TypeError(f"a {type(x).__name__}, which is no number")
    parts = [constant(each) for each in x]  # keys of a dictionary
    return Value(Several(tuple(each.type for each in parts)), "", x if isinstance(x, Mapping) else tuple(x), parts)


@cache
def mangled(name: str) -> str:
    """A name of Python that is free in C."""
    name = "".join(each if each.isascii() else f"u{ord(each):x}" for each in name)
    return f"{name}_" if C_WORDS.fullmatch(name) else name


def place(function: Callable[..., Any], line: int = 1) -> str:
    """File and line of a function, at line `line` of its source."""
    code = inspect.unwrap(function).__code__
    return f"{code.co_filename}:{code.co_firstlineno + line - 1}"
