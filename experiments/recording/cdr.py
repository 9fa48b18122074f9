"""Structs as ROS 2 messages: the schema text that tools read, and fast functions to and from CDR.

A recording whose messages describe themselves opens in rerun, Foxglove, rosbags and mcap-ros2 without a ROS
installation. CDR aligns every number to its size, so a message is a chain of runs whose layout is fixed, with texts and
sequences of any length between them. `codec` finds the runs once and writes two straight-line functions from them.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Final, Generic, TypeVar

import msgspec
from msgspec import inspect as mi

from agents.network.messages import Setpoint, Vector

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
    encode: Callable[[S], bytes]  # from the struct to CDR with its encapsulation header; raises `Unencodable`
    decode: Callable[[bytes], S]  # the way back; raises `Undecodable`


@cache
def codec(kind: type[S]) -> Codec[S]:
    """The message type of a struct.

    Fields may be bool, int, float, str, fixed tuples of floats, other structs, lists of these (except of tuples), and
    dict[str, int], which becomes `<name>_keys` and `<name>_values`. A float or fixed tuple that may be None is NaN then
    (and NaN is read as None), an int that may be None is -1.

    Raises:
        TypeError: If a field has another type, or a name that ROS does not allow.
    """
    record = _record(kind)
    writer = _Writer()
    rebuilt = writer.visit(record, "o")
    writer.flush()
    encode, decode = writer.functions(rebuilt)
    return Codec(f"{PACKAGE}/msg/{kind.__name__}", _schema(record), encode, decode)


@dataclass(frozen=True)
class _Scalar:
    ros: str
    code: str
    optional: bool = False


@dataclass(frozen=True)
class _Text:
    ros: str = "string"


@dataclass(frozen=True)
class _Array:
    length: int
    optional: bool = False


@dataclass(frozen=True)
class _Record:
    kind: type[msgspec.Struct]
    fields: tuple[tuple[str, _Shape], ...]

    @property
    def ros(self) -> str:
        return f"{PACKAGE}/{self.kind.__name__}"


@dataclass(frozen=True)
class _Sequence:
    item: _Scalar | _Text | _Record


@dataclass(frozen=True)
class _Table:
    pass


_Shape = _Scalar | _Text | _Array | _Record | _Sequence | _Table
_PLAIN: Final[dict[type[mi.Type], _Shape]] = {
    mi.BoolType: _Scalar("bool", "?"),
    mi.IntType: _Scalar("int64", "q"),
    mi.FloatType: _Scalar("float64", "d"),
    mi.StrType: _Text(),
}


def _record(kind: type[msgspec.Struct]) -> _Record:
    info = mi.type_info(kind)
    assert isinstance(info, mi.StructType)
    if not info.fields:
        raise TypeError(f"{kind.__name__} has no fields; a ROS message needs at least one")
    for field in info.fields:
        if not FIELD.fullmatch(field.name):
            raise TypeError(f"{kind.__name__}.{field.name}: ROS wants lower_snake_case")
    where = kind.__name__
    return _Record(kind, tuple((field.name, _shape(field.type, f"{where}.{field.name}")) for field in info.fields))


def _shape(kind: mi.Type, where: str) -> _Shape:
    found = _PLAIN.get(type(kind))
    match kind:
        case mi.StructType(cls=cls):
            found = _record(cls)
        case mi.TupleType(item_types=items) if items and all(isinstance(item, mi.FloatType) for item in items):
            found = _Array(len(items))
        case mi.ListType(item_type=item):
            inner = _shape(item, where)
            if isinstance(inner, _Text | _Record) or (isinstance(inner, _Scalar) and not inner.optional):
                found = _Sequence(inner)
        case mi.DictType(key_type=mi.StrType(), value_type=mi.IntType()):
            found = _Table()
        case mi.UnionType(types=(one, mi.NoneType()) | (mi.NoneType(), one)):
            inner = _shape(one, where)
            if isinstance(inner, _Array) or (isinstance(inner, _Scalar) and inner.code != "?"):
                found = replace(inner, optional=True)
    if found is None:
        raise TypeError(f"{where}: no ROS message can hold {type(kind).__name__} here")
    return found


def _schema(record: _Record) -> str:
    """The definition of a message, followed by those of the messages inside it, each once."""
    own: list[str] = []
    others: dict[str, str] = {}
    for name, shape in record.fields:
        inner = shape.item if isinstance(shape, _Sequence) else shape
        if isinstance(inner, _Record):
            first, *rest = _schema(inner).split(SEPARATOR)
            others.update({inner.ros: first}, **{text.splitlines()[0].removeprefix("MSG: "): text for text in rest})
        match shape:
            case _Sequence(item=item):
                own.append(f"{item.ros}[] {name}")
            case _Array(length=length):
                own.append(f"float64[{length}] {name}")
            case _Table():
                own += [f"string[] {name}_keys", f"int64[] {name}_values"]
            case _:
                own.append(f"{shape.ros} {name}")
    parts = ["\n".join(own) + "\n"]
    parts += [text if text.startswith("MSG: ") else f"MSG: {name}\n{text}" for name, text in others.items()]
    return SEPARATOR.join(parts)


SEPARATOR: Final = "=" * 80 + "\n"
_PAD4: Final = tuple(bytes(-n % 4) for n in range(4))
_PAD8: Final = tuple(bytes((4 - n) % 8) for n in range(8))  # the encapsulation header shifts everything by four
_COUNT: Final = struct.Struct("<I")


class _Writer:
    """Writes the encoder (`put`) and the decoder (`take`) of a message side by side."""

    def __init__(self) -> None:
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

    def visit(self, shape: _Shape, value: str) -> str:
        """Puts the expression `value`; returns the expression that the decoder rebuilds it with."""
        match shape:
            case _Scalar(code=code, optional=optional):
                if optional:
                    held, missing = self._name("o"), "NAN" if code == "d" else "-1"
                    value = f"{missing} if ({held} := {value}) is None else {held}"
                (rebuilt,) = self._fixed(code, value)
                if optional:
                    rebuilt = f"None if {_absent(rebuilt) if code == 'd' else f'{rebuilt} == -1'} else {rebuilt}"
            case _Array(length=length, optional=optional):
                if optional:
                    held = self._name("o")
                    value = f"({'NAN, ' * length}) if ({held} := {value}) is None else {held}"
                taken_all = self._fixed("d" * length, f"*({value})")
                rebuilt = f"({', '.join(taken_all)},)"
                if optional:
                    rebuilt = f"None if {' and '.join(map(_absent, taken_all))} else {rebuilt}"
            case _Text():
                rebuilt = self._text(value)
            case _Record(kind=kind, fields=fields):
                made = self._name("T", kind)
                parts = [f"{name}={self.visit(inner, f'{value}.{name}')}" for name, inner in fields]
                rebuilt = f"{made}({', '.join(parts)})"
            case _Sequence(item=item):
                rebuilt = self._sequence(item, value)
            case _Table():
                keys = self._sequence(_Text(), value)
                rebuilt = f"dict(zip({keys}, {self._sequence(_Scalar('int64', 'q'), f'{value}.values()')}))"
        return rebuilt

    def flush(self) -> None:
        """Ends the run: what comes next has no fixed place."""
        if self._codes:
            run = struct.Struct("<" + self._codes)
            put, take = self._name("R", run.pack), self._name("R", run.unpack_from)
            self._lines(
                f"out += {put}({', '.join(self._values)})",
                f"{', '.join(self._taken)}, = {take}(data, i); i += {run.size}",
            )
        self._codes, self._values, self._taken = "", [], []

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

    def _sequence(self, item: _Scalar | _Text | _Record, value: str) -> str:
        self.flush()
        self._offset = None
        held, length, taken = self._name("o"), self._name("n"), self._name("v")
        self._lines(
            f"{held} = {value}; out += PAD4[len(out) & 3]; out += count(len({held}))",
            f"i += -i & 3; {length}, = counted(data, i); i += 4",
        )
        if isinstance(item, _Scalar) and item.code == "?":
            self._lines(
                f"out += pack(f'{{len({held})}}?', *{held})",
                f"{taken} = list(unpack_from(f'{{{length}}}?', data, i)); i += {length}",
            )
        elif isinstance(item, _Scalar):
            self._lines(f"if {held}: out += PAD8[len(out) & 7]", f"if {length}: i += 4 - i & 7")
            self._lines(
                f"out += pack(f'<{{len({held})}}{item.code}', *{held})",
                f"{taken} = list(unpack_from(f'<{{{length}}}{item.code}', data, i)); i += 8 * {length}",
            )
        else:
            each = self._name("o")
            self._lines(f"for {each} in {held}:", f"{taken} = []")
            self._lines("", f"for _ in range({length}):")
            self._indent += "    "
            rebuilt = self.visit(item, each)
            self.flush()
            self._lines("", f"{taken}.append({rebuilt})")
            self._indent = self._indent[:-4]
            self._offset = None
        return taken

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


def _absent(number: str) -> str:
    return f"{number} != {number}"


def _text(value: str) -> bytes:
    encoded = value.encode()
    return _COUNT.pack(len(encoded) + 1) + encoded + b"\0"


POSE_STAMPED: Final = "geometry_msgs/msg/PoseStamped"
POSE_STAMPED_SCHEMA: Final = SEPARATOR.join(
    [
        "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
        "MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
        "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n",
        "MSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    ]
)


def pose_stamped(frame_id: str) -> Callable[[float, Vector, float, Setpoint | None], bytes]:
    """The encoder of `geometry_msgs/msg/PoseStamped` for one frame.

    Returns:
        A function of the UTC stamp [s], the position [m], the yaw [rad] and the attitude (quaternion w, x, y, z), which
        if known stands for the yaw; it raises `Unencodable`.
    """
    text = _text(frame_id)
    layout = struct.Struct(f"<4siI{len(text)}s{-len(text) % 8}x7d")  # the frame is constant, so the layout is too

    def encode(stamp: float, position: Vector, yaw: float, attitude: Setpoint | None) -> bytes:
        try:
            seconds, nanoseconds = divmod(round(stamp * 1e9), 1_000_000_000)
            w, *turned = attitude or (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))
            return layout.pack(LITTLE_ENDIAN, seconds, nanoseconds, text, *position, *turned, w)
        except (struct.error, TypeError, ValueError, OverflowError) as error:
            raise Unencodable(f"{POSE_STAMPED}: {error}") from None

    return encode
