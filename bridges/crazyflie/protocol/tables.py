"""Tables of contents: parameters and log variables, built in or those of a lab's own drone, as bytes on the wire."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from struct import Struct
from typing import Final

import msgspec

from agents.body.interface import BodyError

READ_ONLY: Final = 0x40
EXTENDED: Final = 0x10  # may be stored on board
FLAGS: Final = {"": 0, "!": READ_ONLY, "*": EXTENDED}

PACKINGS: Final = {
    "u8": Struct("<B"),
    "u16": Struct("<H"),
    "u32": Struct("<L"),
    "u64": Struct("<Q"),
    "i8": Struct("<b"),
    "i16": Struct("<h"),
    "i32": Struct("<i"),
    "i64": Struct("<q"),
    "half": Struct("<e"),
    "float": Struct("<f"),
    "double": Struct("<d"),
}
PARAMETER_CODES: Final = {
    "u8": 0x08, "u16": 0x09, "u32": 0x0A, "u64": 0x0B, "i8": 0x00, "i16": 0x01, "i32": 0x02, "i64": 0x03, "float": 0x06,
    "double": 0x07,
}  # fmt: skip
LOG_CODES: Final = {"u8": 1, "u16": 2, "u32": 3, "i8": 4, "i16": 5, "i32": 6, "float": 7, "half": 8}
LOG_TYPES: Final = {code: kind for kind, code in LOG_CODES.items()}
BUILT_IN: Final = Path(__file__).with_name("inventory.txt")
RANGE: Final = re.compile(r"(\w*?)(\d+)-(\d+)")  # several names with a number each


@dataclass(frozen=True)
class DeviceVariable:
    """One parameter or log variable: type on board, value at the start, access."""

    name: str
    type: str
    value: float = 0.0
    flags: int = 0


def pack(kind: str, value: float) -> bytes:
    """Value in the type `kind`; whole numbers wrap, as in C, and floats that are too large are infinite."""
    packing = PACKINGS[kind]
    if kind[0] not in "ui":
        try:
            return packing.pack(value)
        except OverflowError:
            return packing.pack(math.copysign(math.inf, value))
    bits = 8 * packing.size
    whole = int(value) & ((1 << bits) - 1)
    return packing.pack(whole - (1 << bits) if kind[0] == "i" and whole >> (bits - 1) else whole)


class VariableTable:
    """Variables in the order of their numbers."""

    def __init__(self, variables: Sequence[DeviceVariable], codes: Mapping[str, int]) -> None:
        """`codes`: codes of the types on the wire; they are part of the checksum, because cflib keeps all tables in one
        cache by checksum."""
        self.variables = tuple(variables)
        self.number = {variable.name: i for i, variable in enumerate(self.variables)}
        # the last NUL is required: cflib always cuts one byte off
        self.items = tuple(
            bytes((codes[variable.type] | variable.flags,)) + variable.name.replace(".", "\0").encode() + b"\0"
            for variable in self.variables
        )
        self.crc = zlib.crc32(bytes(codes.values()) + b"".join(self.items))


@dataclass(frozen=True)
class Inventory:
    """Both tables of a Crazyflie."""

    parameters: VariableTable
    logs: VariableTable


class LogTocElement(msgspec.Struct, tag_field="__class__", tag="LogTocElement"):
    """Log variable in cflib's cache."""

    ident: int
    group: str
    name: str
    ctype: str
    access: int = 0
    extended: bool = False


class ParamTocElement(LogTocElement, tag_field="__class__", tag="ParamTocElement"):
    """Parameter in cflib's cache."""


Cached = dict[str, dict[str, LogTocElement | ParamTocElement]]


@cache
def inventory(files: tuple[str, ...] = ()) -> Inventory:
    """Tables built in, or those of `files` of cflib's cache, one for parameters, one for log variables.

    Variables of a file start with the value that the variable of the same name has in the built-in table, otherwise 0.
    Raises BodyError if a file is no table of cflib's cache, or two are of the same kind.
    """
    sections = list(_sections(BUILT_IN.read_text("ascii")))
    read: dict[type, list[DeviceVariable]] = {}
    for file in files:
        kind, variables = _cached(file)
        if kind in read:
            raise BodyError(f"{file}: a second table of the same kind; give one of parameters and one of log variables")
        known = {variable.name: variable.value for variable in sections[0 if kind is ParamTocElement else 1]}
        read[kind] = [replace(variable, value=known.get(variable.name, 0.0)) for variable in variables]
    return Inventory(
        VariableTable(read.get(ParamTocElement, sections[0]), PARAMETER_CODES),
        VariableTable(read.get(LogTocElement, sections[1]), LOG_CODES),
    )


def _sections(text: str) -> Iterator[list[DeviceVariable]]:
    for section in re.split(r"^\[\w+\]$", text, flags=re.MULTILINE)[1:]:
        variables = []
        for line in filter(None, section.splitlines()):
            head, names = line.split(": ")
            group, kind = head.split()
            flags = FLAGS[kind.lstrip("abcdefghijklmnopqrstuvwxyz0123456789")]
            for word in names.split():
                name, _, value = word.partition("=")
                every = [name]
                if several := RANGE.fullmatch(name):
                    stem, first, last = several.groups()
                    every = [f"{stem}{number}" for number in range(int(first), int(last) + 1)]
                variables += [
                    DeviceVariable(f"{group}.{each}", kind.rstrip("!*"), float(value or 0.0), flags) for each in every
                ]
        yield variables


def _flags(element: LogTocElement) -> int:
    return (READ_ONLY if element.access else 0) | (EXTENDED if element.extended else 0)


def _cached(file: str) -> tuple[type, list[DeviceVariable]]:
    """Kind and variables of a table in cflib's cache."""
    try:
        groups = msgspec.json.decode(Path(file).read_bytes(), type=Cached)
        elements = sorted((element for group in groups.values() for element in group.values()), key=lambda e: e.ident)
        (kind,) = {type(element) for element in elements}
        codes = PARAMETER_CODES if kind is ParamTocElement else LOG_CODES
        variables = [
            DeviceVariable(
                f"{element.group}.{element.name}",
                element.ctype.removesuffix("_t").replace("uint", "u").replace("int", "i"),
                flags=_flags(element) if kind is ParamTocElement else 0,
            )
            for element in elements
        ]
        if [element.ident for element in elements] != list(range(len(elements))):
            raise ValueError("the numbers of its variables are not 0, 1, 2, ...")
        if strange := sorted({variable.type for variable in variables} - set(codes)):
            raise ValueError(f"unknown type {strange[0]}")
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        remedy = "give a file of cflib's cache, such as ./cache/1A2B3C4D.json beside a script that used rw_cache"
        raise BodyError(f"{file}: no table of a Crazyflie: {error}; {remedy}") from error
    return kind, variables
