"""Formats of files with poses over time: CSV with named columns, TUM, exports of Vicon, Motive and QTM, Crazyswarm's
polynomials.

The text itself shows its format. Errors name the line, and behind `; ` the remedy.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise, takewhile
from math import atan2, cos, hypot, isfinite, nan, radians, sin
from typing import Final, NamedTuple

from agents.errors import did_you_mean
from agents.plugins.recorded.curves import AXES, ORDER, Curve, Piece, Polynomials, Samples, TimedPose

Rows = Sequence[tuple[int, list[str]]]  # numbers of lines, and their cells

FORMS: Final = (
    "a CSV begins with names such as t,x,y,z,yaw; TUM has lines t x y z qx qy qz qw; the exports of Vicon, Motive "
    "and QTM, and Crazyswarm's polynomials are known too"
)
UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "rad": 1.0}
UNITS_OF_ANGLES: Final = {"deg": radians(1.0), "°": radians(1.0)}
NAMES: Final = {  # names of a column, in small letters and without its unit
    "t": ("t", "time", "timestamp", "stamp", "sec", "secs", "seconds", "elapsed"),
    "x": ("x", "px", "tx", "pos_x", "position_x", "p_x"),
    "y": ("y", "py", "ty", "pos_y", "position_y", "p_y"),
    "z": ("z", "pz", "tz", "pos_z", "position_z", "p_z", "height"),
    "yaw": ("yaw", "theta", "heading", "psi"),
    "qx": ("qx", "q_x", "orientation_x"),
    "qy": ("qy", "q_y", "orientation_y"),
    "qz": ("qz", "q_z", "orientation_z"),
    "qw": ("qw", "q_w", "orientation_w"),
}
QUATERNION: Final = ("qx", "qy", "qz", "qw")
VECTOR: Final = ("rx", "ry", "rz")
COLUMNS: Final = {name: column for column, names in NAMES.items() for name in names}
UNIT: Final = re.compile(r"(.+?)\s*(?:\[\s*([\w°]+)\s*\]|\(\s*([\w°]+)\s*\)|_(ns|us|ms|s|mm|cm|m|rad|deg))")
VICON_HEADER: Final = "frame,sub frame,"
MOTIVE_HEADER: Final = "frame,time"
QTM_HEADER: Final = "frame\ttime\t"
HIDDEN: Final = ("", "NULL")  # cells of a body that was not seen
RIGID_BODY: Final = "Rigid Body"  # kind of a body in Motive's export
MOTIVE_UNITS: Final = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
FARTHEST: Final = 1e4  # largest place [m] or angle [rad]
LARGEST: Final = 1e6  # largest coefficient of a polynomial, and duration of a piece [s]
LATEST_S: Final = 1e12  # largest time [s]
TICK_S: Final = 1e-6  # least time between two poses [s]
HIDDEN_S: Final = 0.5  # a body that motion capture loses for longer has no path [s]


class FormatError(ValueError):
    """File that is no trajectory; the text has line and remedy."""


def read(text: str, body: str = "", up: str = "y") -> Curve:
    """The trajectory of a file's text.

    Args:
        body: Object of a file that has several.
        up: Axis of Motive's export that points up; the file does not say it.

    Raises FormatError.
    """
    lines = text.lstrip("\ufeff").replace("\r\n", "\n").split("\n")
    for head, line in enumerate(lines[:20]):
        if (columns := _columns_of_export(lines, head, line.lower(), body, up)) is not None:
            return Samples(_exported(lines, head, body, columns))
    rows = _rows(lines, body)
    if not rows:
        raise FormatError(f"the file holds no numbers; {FORMS}")
    first = rows[0][1]
    if first[0].lower() == "duration":
        return Polynomials(_pieces(rows[1:]))
    if _is_number(first[0]):
        if len(first) == 1 + ORDER * AXES:
            return Polynomials(_pieces(rows))
        if len(first) != 8:
            raise FormatError(f"line {rows[0][0]}: {len(first)} numbers without names above them; {FORMS}")
        return Samples(_samples(rows, dict(zip(("t", "x", "y", "z", *QUATERNION), range(8), strict=True)), {}))
    places, factors = _columns(rows[0], body)
    return Samples(_samples(_lines_of(body, rows), places, factors))


def _rows(lines: Sequence[str], body: str) -> Rows:
    """Cells of the lines that hold any; the last line behind # that names columns is one, if none else does."""
    given = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
    comments = [(number, line.strip("# ")) for number, line in takewhile(lambda each: each[1].startswith("#"), given)]
    given = [(number, line) for number, line in given if not line.startswith("#")]
    if given and _is_number(_split(given[0][1], _sign(given[0][1]))[0]):
        heads = [(number, line) for number, line in comments if {"t", "x", "y"} <= _known(line, body)]
        given = [*heads[-1:], *given]
    sign = _sign(given[0][1]) if given else None
    rows = [(number, _split(line, sign)) for number, line in given]
    if sign == ";":  # decimal commas
        rows = [(number, [cell.replace(",", ".") for cell in cells]) for number, cells in rows]
    return [(number, cells[:-1] if cells[-1] == "" else cells) for number, cells in rows]


def _sign(line: str) -> str | None:
    return next((sign for sign in (";", ",", "\t") if sign in line), None)


def _split(line: str, sign: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(sign)]


def _known(line: str, body: str) -> set[str]:
    """Columns that a line names."""
    found = (_column(name, body) for name in _split(line, _sign(line)))
    return {column.name for column in found if column}


def _lines_of(body: str, rows: Rows) -> Rows:
    """Lines below the names: those of a robot and a case in a table of several, as `./zenpark export --csv` writes."""
    (number, names), *found = rows
    for column, wanted, hint in (
        ("robot", body, 'write body = "{}", or another'),
        ("case", "", 'keep the lines of "{}", or of another'),
    ):
        if column not in names:
            continue
        place = names.index(column)
        values = dict.fromkeys(cells[place] for _, cells in found if place < len(cells))
        if wanted in values:
            found = [row for row in found if row[1][place : place + 1] == [wanted]]
        elif len(values) > 1:
            listed = ", ".join([*values][:12])
            raise FormatError(f"line {number}: it has the {column}s {listed}; {hint.format(next(iter(values)))}")
    return found


class _Column(NamedTuple):
    name: str  # one of `NAMES`
    factor: float  # metres, seconds or radians in its unit
    owner: str  # object in front of the name, such as `CF01` or `CF01_pose`


def _columns(header: tuple[int, list[str]], body: str) -> tuple[dict[str, int], dict[str, float]]:
    """Number of each column that is known, and the factor of its unit."""
    number, names = header
    known = [(place, column) for place, name in enumerate(names) if (column := _column(name, body))]
    owners = dict.fromkeys(column.owner for _, column in known if column.name == "x")
    taken = [owner for owner in owners if not body or f"_{_bare(body)}_" in f"_{owner}_"]
    if len(taken) > 1:
        several = [owner for owner in taken if owner]
        hint = f'write body = "{several[0]}", or another'
        raise FormatError(f"line {number}: it has places of {', '.join(several)}; {hint}")
    places, factors = dict[str, int](), dict[str, float]()
    for place, column in sorted(known, key=lambda each: each[1].owner not in taken):
        if column.name not in places and (column.name == "t" or column.owner in (*taken, "")):
            places[column.name], factors[column.name] = place, column.factor
    if missing := [name for name in ("t", "x", "y") if name not in places]:
        of_body = f" of {body}" if body else ""
        hint = f"name the columns t, x, y (, z, yaw), with units such as x_mm; this line has {', '.join(names)[:80]}"
        raise FormatError(f"line {number}: no column {', '.join(missing)}{of_body}; {hint}")
    return places, factors


def _bare(name: str) -> str:
    return re.sub(r"[./:]+", "_", name.strip()).strip("_ ")


def _column(name: str, body: str) -> _Column | None:
    """Column of a name; None for a name of something else."""
    if name == "%time":
        return _Column("t", 1e-9, "")
    bare = _bare(name.lstrip("%").removesuffix("[]"))
    owner, factor = "", 1.0
    if body and bare.startswith(f"{_bare(body)}_"):
        bare, owner = bare[len(_bare(body)) + 1 :], _bare(body)
    with_unit = UNIT.fullmatch(bare.lower())
    if with_unit and bare.lower() not in COLUMNS:
        bare = bare[: len(with_unit[1])].rstrip("_")
        unit = next(filter(None, with_unit.groups()[1:]))
        if unit not in UNITS and unit not in UNITS_OF_ANGLES:
            return None
        factor = UNITS.get(unit) or UNITS_OF_ANGLES[unit]
    if of_euroc := re.fullmatch(r"([pq])_RS(?:_R)?_([wxyz])", bare):
        bare = f"{of_euroc[1]}_{of_euroc[2]}"
    elif of_ros := re.fullmatch(r"(.*)_((?:position|orientation)_[xyzw])", bare):
        owner, bare = f"{owner}_{of_ros[1]}".strip("_"), of_ros[2]
    return _Column(COLUMNS[bare.lower()], factor, owner) if bare.lower() in COLUMNS else None


def _samples(rows: Rows, places: Mapping[str, int], factors: Mapping[str, float]) -> list[TimedPose]:
    found, zero = list[TimedPose](), None
    for number, cells in rows:
        value = {name: factors.get(name, 1.0) * _number(number, cells, place) for name, place in places.items()}
        if abs(value["t"]) > LATEST_S or any(abs(value[name]) > FARTHEST for name in value if name != "t"):
            raise FormatError(
                f"line {number}: a place or a time beyond all measure; mend its units, or remove the line"
            )
        zero = value["t"] if zero is None else zero
        place = value["x"], value["y"], value.get("z", nan)
        found.append(TimedPose(value["t"] - zero, place, _yaw_of(value), number))
    return _in_order(found)


def _in_order(found: list[TimedPose]) -> list[TimedPose]:
    if len(found) < 2:
        raise FormatError("the file holds fewer than two poses; give one line for each, with its time")
    for before, after in pairwise(found):
        if after.time - before.time < TICK_S:
            message = f"line {after.line}: its time {after.time:g} s is not after that of line {before.line}"
            raise FormatError(f"{message}; sort the lines by time, and remove those that stand twice")
    return found


def _number(line: int, cells: Sequence[str], place: int) -> float:
    cell = cells[place] if place < len(cells) else ""
    try:
        value = float(cell)
    except ValueError:
        what = f"{cell[:40]!r} in column {place + 1} is no number" if cell else f"column {place + 1} is empty"
        raise FormatError(f"line {line}: {what}; mend it, or remove the line") from None
    if not isfinite(value):
        raise FormatError(f"line {line}: {cell!r} in column {place + 1} is no place; mend it, or remove the line")
    return value


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _yaw_of(value: Mapping[str, float]) -> float:
    """Yaw of a quaternion, else of a rotation vector, else the number; NaN without any [rad]."""
    if all(name in value for name in QUATERNION):
        x, y, z, w = (value[name] for name in QUATERNION)
    elif all(name in value for name in VECTOR):
        turn = hypot(*(value[name] for name in VECTOR))
        share = sin(0.5 * turn) / turn if turn else 0.0
        x, y, z = (share * value[name] for name in VECTOR)
        w = cos(0.5 * turn)
    else:
        return value.get("yaw", nan)
    return atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _pieces(rows: Rows) -> list[Piece]:
    found = list[Piece]()
    for number, cells in rows:
        if len(cells) != 1 + AXES * ORDER:
            hint = f"a piece is a duration and {AXES * ORDER} coefficients, of x, y, z and yaw from the 0th power on"
            raise FormatError(f"line {number}: {len(cells)} numbers; {hint}")
        duration, *values = (_number(number, cells, place) for place in range(len(cells)))
        if not TICK_S <= duration <= LARGEST:
            raise FormatError(f"line {number}: the duration {duration:g} s; give a positive one")
        if any(abs(value) > LARGEST for value in values):
            raise FormatError(f"line {number}: a coefficient beyond all measure; mend its units")
        axes = [tuple(values[ORDER * axis : ORDER * (axis + 1)]) for axis in range(AXES)]
        found.append(Piece(duration, (axes[0], axes[1], axes[2], axes[3]), number))
    if not found:
        raise FormatError("the file holds no piece; give one line for each, behind its duration")
    return found


class Export(NamedTuple):
    """Columns of a body in the export of a motion capture system, and the factors of their units."""

    places: dict[str, int]
    factors: dict[str, float]


def _columns_of_export(lines: Sequence[str], head: int, line: str, body: str, up: str) -> Export | None:
    """Columns of an export, if this line names them."""
    if line.startswith(VICON_HEADER):
        return _vicon(lines, head, body)
    if line.startswith(QTM_HEADER):
        return _qtm(lines, head, body)
    return _motive(lines, head, body, up) if line.startswith(MOTIVE_HEADER) and head > 1 else None


def _exported(lines: Sequence[str], head: int, body: str, columns: Export) -> list[TimedPose]:
    """Poses of a body below the line `head` with the names of the columns, without frames in which it was hidden."""
    rows = list[tuple[int, list[str]]]()
    for number, line in enumerate(lines[head + 1 :], head + 2):
        cells = _cells(line)
        if not any(cells) and rows:
            break  # the next section of the file
        # neither a line of units, nor one without the body
        if not _is_number(cells[0]) or any(k >= len(cells) or cells[k] in HIDDEN for k in columns.places.values()):
            continue
        if any(cells[columns.places[axis]].strip("-0.") for axis in "xyz"):  # QTM writes zeros for a hidden body
            rows.append((number, cells))
    found = _samples(rows, *columns)
    for before, after in pairwise(found):
        if after.time - before.time > HIDDEN_S:
            message = f"line {after.line}: {body or 'the body'} was hidden for {after.time - before.time:.2g} s"
            raise FormatError(f"{message}; record again, or fill the gap before the export")
    return found


def _cells(line: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split("\t" if "\t" in line else ",")]


def _chosen(bodies: Collection[str], body: str, line: int) -> str:
    """The body that is asked for, else the only one."""
    if not body and len(bodies) > 1:
        raise FormatError(f'line {line}: it has {", ".join(bodies)}; write body = "{next(iter(bodies))}", or another')
    if body and body not in bodies:
        raise FormatError(f"line {line}: no body {body!r}; {did_you_mean(body, bodies)}")
    return body or next(iter(bodies), "")


def _vicon(lines: Sequence[str], head: int, body: str) -> Export:
    """Vicon's export: kind, rate, names of the bodies, names of the columns, units, numbers."""
    rates = [float(line.strip(", ")) for line in lines[:head] if _is_number(line.strip(", "))]
    if not rates or not rates[0] > 0.0:
        reason = f"its rate is {rates[0]:g} Hz" if rates else "no rate stands above its columns"
        raise FormatError(f"{reason}; export from Vicon with the header, rate included")
    names = [name.removeprefix("Global Angle ") for name in _cells(lines[head - 1])]
    columns = [cell.lower() for cell in _cells(lines[head])]
    units = [cell.lower() for cell in _cells(lines[head + 1] if head + 1 < len(lines) else "")]
    bodies = {name.partition(":")[0]: place for place, name in enumerate(names) if name and place > 1}
    begin = bodies.get(_chosen(bodies, body, head), 2)
    end = min((place for place in bodies.values() if place > begin), default=len(columns))
    place = {name: k for k, name in enumerate(columns[:end]) if k >= begin}
    if not {"tx", "ty", "tz"} <= place.keys():
        raise FormatError(f"line {head + 1}: no columns TX, TY, TZ; export the objects with their places")
    turn = QUATERNION if "rw" in place else VECTOR
    unit = units[place["rz"]] if "rz" in place and place["rz"] < len(units) else ""
    places = {"t": 0, **{axis: place[f"t{axis}"] for axis in "xyz"}}
    places |= {name: place[f"r{name[1]}"] for name in turn if f"r{name[1]}" in place}
    factors = {"t": 1.0 / rates[0], **dict.fromkeys("xyz", 1e-3)}
    return Export(places, factors | dict.fromkeys(turn, UNITS_OF_ANGLES.get(unit, 1.0)))


def _qtm(lines: Sequence[str], head: int, body: str) -> Export:
    """QTM's export: its settings, then names of the columns, of which the first of each body has its name, numbers."""
    columns = _cells(lines[head])
    begins = {name.removesuffix(" X"): k for k, name in enumerate(columns) if name.endswith(" X")}
    if not begins:
        raise FormatError(f"line {head + 1}: no column ends with X; export 6D data from QTM, with the header")
    begin = begins[_chosen(begins, body, head + 1)]
    places = {"t": 1, **{axis: begin + k for k, axis in enumerate("xyz")}}
    if columns[begin + 5 : begin + 6] == ["Yaw"]:
        places["yaw"] = begin + 5
    return Export(places, {**dict.fromkeys("xyz", 1e-3), "yaw": radians(1.0)})


def _motive(lines: Sequence[str], head: int, body: str, up: str) -> Export:
    """Motive's export: its settings, then kinds and names of the bodies, quantities, names of the columns, numbers."""
    settings = _cells(lines[0])
    unit = next((value.lower() for key, value in pairwise(settings) if key == "Length Units"), "")
    if unit not in MOTIVE_UNITS:
        raise FormatError(f"line 1: no Length Units; export from Motive in {', '.join(MOTIVE_UNITS)}, with the header")
    above = [_cells(line) for line in lines[:head]]
    kinds = next((row for row, cells in enumerate(above) if RIGID_BODY in cells), None)
    if kinds is None:
        raise FormatError(f"line {head + 1}: no rigid body; export from Motive with Rigid Bodies")
    names, quantities = above[kinds + 1], above[-1]
    axes = _cells(lines[head])
    rigid = [k for k, kind in enumerate(above[kinds]) if kind == RIGID_BODY and k < min(len(names), len(quantities))]
    name = _chosen(dict.fromkeys(names[k] for k in rigid), body, kinds + 2)
    found = {f"{quantities[k]} {axes[k]}".lower(): k for k in rigid if names[k] == name and k < len(axes)}
    if not {f"position {axis}" for axis in "xyz"} <= found.keys():
        raise FormatError(f"line {head + 1}: no Position X, Y, Z of {name}; export the rigid bodies with their places")
    axes_of_arena = {"x": ("x", 1.0), "y": ("z", -1.0), "z": ("y", 1.0)} if up == "y" else {a: (a, 1.0) for a in "xyz"}
    places, factors = {"t": 1}, dict[str, float]()
    turned = {f"rotation {axis}" for axis in "xyzw"} <= found.keys()  # angles of Euler are not read
    for axis, (source, sign) in axes_of_arena.items():
        places[axis], factors[axis] = found[f"position {source}"], sign * MOTIVE_UNITS[unit]
        if turned:
            places[f"q{axis}"], factors[f"q{axis}"] = found[f"rotation {source}"], sign
            places["qw"] = found["rotation w"]
    return Export(places, factors)
