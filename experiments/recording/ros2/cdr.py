"""Structs as ROS 2 messages: the schema text that tools read, and fast functions to and from CDR.

A recording with messages that describe themselves opens in rerun, Foxglove, rosbags and mcap-ros2 without a ROS
installation. CDR aligns every number to its size. A message is therefore a chain of runs with a fixed layout, with
texts and sequences of any length between them. `codec` finds the runs once and writes two straight-line functions from
them.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Final, Generic, TypeVar

import msgspec
from msgspec import inspect as mi

PACKAGE: Final = "zenpark_msgs"
LITTLE_ENDIAN: Final = b"\0\1\0\0"  # the encapsulation header of plain CDR; alignment counts from behind it
FIELD: Final = re.compile(r"[a-z](_?[a-z0-9])*")  # what ROS allows as the name of a field
NAN: Final = math.nan

S = TypeVar("S", bound=msgspec.Struct)


class Unencodable(ValueError):
    """A struct that holds something its own annotations exclude."""


class Undecodable(ValueError):
    """Bytes that are not a message of the type."""


@dataclass(frozen=True)
class Codec(Generic[S]):
    """A struct as a ROS 2 message."""

    name: str  # type of the message, such as `zenpark_msgs/msg/State`
    schema: str  # its definition as ros2msg text, with the definitions it needs
    encode: Callable[[S], bytes]  # makes CDR with its encapsulation header of the struct; raises `Unencodable`
    decode: Callable[[bytes], S]  # the way back; raises `Undecodable`


@cache
def codec(kind: type[S]) -> Codec[S]:
    """The message type of a struct.

    Fields may be bool, int, float, str, fixed tuples of floats, other structs, lists of these (except of tuples), and
    dict[str, int], which becomes `<name>_keys` and `<name>_values`. A float or fixed tuple that may be None is NaN then
    (and NaN is read as None). Raises TypeError if a field has another type, or a name that ROS does not allow.
    """
    writer = _Writer()
    rebuilt = writer.struct(kind, "o")
    writer.flush()
    encode, decode = writer.functions(rebuilt)
    first, *others = writer.definitions.items()
    texts = [first[1], *(f"MSG: {name}\n{text}" for name, text in others)]
    return Codec(f"{PACKAGE}/msg/{kind.__name__}", SEPARATOR.join(texts), encode, decode)


SEPARATOR: Final = "=" * 80 + "\n"
_PAD4: Final = tuple(bytes(-n % 4) for n in range(4))
_PAD8: Final = tuple(bytes((4 - n) % 8) for n in range(8))  # the encapsulation header shifts everything by four
_COUNT: Final = struct.Struct("<I")


_NUMBERS: Final[dict[type[mi.Type], tuple[str, str]]] = {
    mi.BoolType: ("bool", "?"),
    mi.IntType: ("int64", "q"),
    mi.FloatType: ("float64", "d"),
}


class _Writer:
    """Writes the encoder (`put`), the decoder (`take`) and the definitions of a message side by side."""

    def __init__(self) -> None:
        self.definitions: dict[str, str] = {}  # ros2msg text by type: of the message, then of those inside it
        self._put: list[str] = []
        self._take: list[str] = []
        self._indent = " " * 8
        self._names: dict[str, object] = {
            "HEADER": LITTLE_ENDIAN,
            "PAD4": _PAD4,
            "PAD8": _PAD8,
            "NAN": NAN,
            "count": _COUNT.pack,
            "counted": _COUNT.unpack_from,
            "pack": struct.pack,
            "unpack_from": struct.unpack_from,
            "text": lru_cache(4096)(_text),  # names and phases are the same few, over and over
            "Unencodable": Unencodable,
            "Undecodable": Undecodable,
            "StructError": struct.error,
        }
        self._numbers = 0
        self._codes = ""  # the run of fixed size that is being gathered: its layout, ...
        self._values: list[str] = []  # ... what is put into it, ...
        self._taken: list[str] = []  # ... and where it is taken to
        self._offset: int | None = 0  # modulo 8, unknown behind a text or a sequence

    def struct(self, kind: type[msgspec.Struct], value: str) -> str:
        """Puts the struct `value`; returns the expression that the decoder rebuilds it with."""
        info = mi.type_info(kind)
        assert isinstance(info, mi.StructType)
        if not info.fields:
            raise TypeError(f"{kind.__name__} has no fields; a ROS message needs at least one")
        made, own = self._name("T", kind), f"{PACKAGE}/{kind.__name__}"
        self.definitions[own] = self.definitions.get(own, "")  # entered before those inside it
        parts, lines = [], []
        for field in info.fields:
            where, inner = f"{kind.__name__}.{field.name}", f"{value}.{field.name}"
            name = field.encode_name
            if not FIELD.fullmatch(name):
                raise TypeError(f"{where}: ROS wants lower_snake_case")
            match field.type:
                case mi.DictType(key_type=mi.StrType() as key, value_type=mi.IntType() as number):
                    (keys, _), (values, _) = (
                        self._sequence(key, inner, where),
                        self._sequence(number, f"{inner}.values()", where),
                    )
                    parts.append(f"{field.name}=dict(zip({keys}, {values}))")
                    lines += [f"string[] {name}_keys", f"int64[] {name}_values"]
                case _:
                    rebuilt, ros = self._encode_expression(field.type, inner, where)
                    parts.append(f"{field.name}={rebuilt}")
                    lines.append(f"{ros} {name}")
        self.definitions[own] = "\n".join(lines) + "\n"
        return f"{made}({', '.join(parts)})"

    def _encode_expression(self, kind: mi.Type, value: str, where: str) -> tuple[str, str]:
        """Puts the expression `value`; returns the expression that rebuilds it, and its type in ROS."""
        match kind:
            case mi.StructType(cls=cls):
                return self.struct(cls, value), f"{PACKAGE}/{cls.__name__}"
            case mi.StrType():
                return self._text(value), "string"
            case mi.BoolType() | mi.IntType() | mi.FloatType():
                ros, code = _NUMBERS[type(kind)]
                return self._fixed(code, value)[0], ros
            case mi.TupleType(item_types=items) if items and all(isinstance(item, mi.FloatType) for item in items):
                taken = self._fixed("d" * len(items), f"*({value})")
                return f"({', '.join(taken)},)", f"float64[{len(items)}]"
            case mi.ListType(item_type=mi.StructType() | mi.StrType() | mi.BoolType() | mi.IntType() | mi.FloatType()):
                return self._sequence(kind.item_type, value, where)
            case mi.UnionType(types=(one, mi.NoneType()) | (mi.NoneType(), one)) if isinstance(
                one, mi.FloatType | mi.TupleType
            ):
                held = self._name("o")
                missing = f"({'NAN, ' * len(one.item_types)})" if isinstance(one, mi.TupleType) else "NAN"
                rebuilt, ros = self._encode_expression(
                    one, f"({missing} if ({held} := {value}) is None else {held})", where
                )
                absent = " and ".join(f"{each} != {each}" for each in rebuilt.strip("(,)").split(", "))
                return f"None if {absent} else {rebuilt}", ros
        raise TypeError(f"{where}: no ROS message can hold {type(kind).__name__} here")

    def flush(self) -> None:
        """Ends the run: what comes next has no fixed place."""
        if self._codes:
            run = struct.Struct("<" + self._codes)
            put, take = self._name("R", run.pack), self._name("R", run.unpack_from)
            self._lines(
                f"out += {put}({', '.join(self._values)})",
                f"{', '.join(self._taken)}, = {take}(data, i); i += {run.size}",
            )
        self._codes = ""
        self._values, self._taken = [], []

    def functions(self, rebuilt: str) -> tuple[Callable[[S], bytes], Callable[[bytes], S]]:
        """The encoder and the decoder."""
        source = [
            "def encode(o):",
            "    try:",
            "        out = bytearray(HEADER)",
            *self._put,
            "        return bytes(out)",
            "    except (StructError, TypeError, OverflowError, UnicodeEncodeError) as error:",
            "        raise Unencodable(f'{type(o).__name__}: {error}') from None",
            "def decode(data):",
            "    try:",
            "        i = 4",
            *self._take,
            f"        made = {rebuilt}",
            "    except (StructError, UnicodeDecodeError) as error:",
            "        raise Undecodable(str(error)) from None",
            "    if i > len(data) or data[:2] != HEADER[:2]:",
            "        raise Undecodable('cut short, or not little-endian CDR')",
            "    return made",
        ]
        exec("\n".join(source), self._names)
        return self._names["encode"], self._names["decode"]  # type: ignore[return-value]

    def _fixed(self, codes: str, value: str) -> list[str]:
        """Adds numbers of one kind to the run, with the padding before them."""
        if codes[0] != "?":
            if self._offset is None:
                self.flush()
                self._lines("out += PAD8[len(out) & 7]", "i += 4 - i & 7")
            elif self._offset:
                self._codes += f"{8 - self._offset}x"
            self._offset = 0
        elif self._offset is not None:
            self._offset = (self._offset + len(codes)) % 8
        self._codes += codes
        self._values.append(value)
        taken = [self._name("v") for _ in codes]
        self._taken += taken
        return taken

    def _text(self, value: str) -> str:
        self.flush()
        self._offset = None
        length, taken = self._name("n"), self._name("v")
        self._lines(
            f"out += PAD4[len(out) & 3]; out += text({value})",
            f"i += -i & 3; {length}, = counted(data, i); {taken} = str(data[i + 4:i + 3 + {length}], 'utf-8')",
        )
        self._lines("", f"i += 4 + {length}")
        return taken

    def _sequence(self, item: mi.Type, value: str, where: str) -> tuple[str, str]:
        self.flush()
        self._offset = None
        held, length, taken = self._name("o"), self._name("n"), self._name("v")
        self._lines(
            f"{held} = {value}; out += PAD4[len(out) & 3]; out += count(len({held}))",
            f"i += -i & 3; {length}, = counted(data, i); i += 4",
        )
        if type(item) in _NUMBERS:
            ros, code = _NUMBERS[type(item)]
            size = struct.calcsize(f"<{code}")
            if size == 8:
                self._lines(f"if {held}: out += PAD8[len(out) & 7]", f"if {length}: i += 4 - i & 7")
            self._lines(
                f"out += pack(f'<{{len({held})}}{code}', *{held})",
                f"{taken} = list(unpack_from(f'<{{{length}}}{code}', data, i)); i += {size} * {length}",
            )
        else:
            each = self._name("o")
            self._lines(f"for {each} in {held}:", f"{taken} = []")
            self._lines("", f"for _ in range({length}):")
            self._indent += "    "
            rebuilt, ros = self._encode_expression(item, each, where)
            self.flush()
            self._lines("", f"{taken}.append({rebuilt})")
            self._indent = self._indent[:-4]
            self._offset = None
        return taken, f"{ros}[]"

    def _lines(self, put: str, take: str) -> None:
        if put:
            self._put.append(self._indent + put)
        self._take.append(self._indent + take)

    def _name(self, letter: str, value: object = None) -> str:
        self._numbers += 1
        name = f"{letter}{self._numbers}"
        if value is not None:
            self._names[name] = value
        return name


def _text(value: str) -> bytes:
    encoded = value.encode()
    return _COUNT.pack(len(encoded) + 1) + encoded + b"\0"
