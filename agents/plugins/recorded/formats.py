"""Formats of files with poses over time: CSV with named columns, TUM, Vicon's export, polynomials of Crazyswarm.

The text itself shows its format. Errors name the line, and behind `; ` the remedy.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from math import atan2, cos, hypot, isfinite, nan, radians, sin
from typing import Final, NamedTuple

from agents.errors import did_you_mean
from agents.plugins.recorded.curves import AXES, ORDER, Curve, Piece, Polynomials, Samples, TimedPose

Rows = Sequence[tuple[int, list[str]]]  # numbers of lines, and their cells

FORMS: Final = (
    "a CSV begins with names such as t,x,y,z,yaw; TUM has lines t x y z qx qy qz qw; Vicon's export and Crazyswarm's "
    "polynomials are known too"
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
COLUMNS: Final = {name: column for column, names in NAMES.items() for name in names}
UNIT: Final = re.compile(r"(.+?)\s*(?:\[\s*([\w°]+)\s*\]|\(\s*([\w°]+)\s*\)|_(ns|us|ms|s|mm|cm|m|rad|deg))")
VICON_HEADER: Final = "frame,sub frame,"
FARTHEST: Final = 1e4  # largest place [m] or angle [rad]
LARGEST: Final = 1e6  # largest coefficient of a polynomial, and duration of a piece [s]
LATEST_S: Final = 1e12  # largest time [s]
TICK_S: Final = 1e-6  # least time between two poses [s]
HIDDEN_S: Final = 0.5  # a body that motion capture loses for longer has no path [s]


class FormatError(ValueError):
    """File that is no trajectory; the text has line and remedy."""


def read(text: str, body: str = "") -> Curve:
    """The trajectory of a file's text; `body` is the object of a file that has several.

    Raises FormatError.
    """
    lines = text.lstrip("\ufeff").replace("\r\n", "\n").split("\n")
    head = next((k for k, line in enumerate(lines[:20]) if line.lower().startswith(VICON_HEADER)), None)
    if head is not None:
        return Samples(_vicon(lines, head, body))
    rows = _rows(lines)
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
    return Samples(_samples(rows[1:], places, factors))


def _rows(lines: Sequence[str]) -> Rows:
    """Cells of the lines that hold any; a first line behind # is one if it names columns."""
    given = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
    if given and given[0][1].startswith("#") and {"x", "y"} <= set(re.split(r"[#,;\s]+", given[0][1].lower())):
        given[0] = given[0][0], given[0][1].lstrip("# ")
    given = [(number, line) for number, line in given if not line.startswith("#")]
    first = given[0][1] if given else ""
    sign = next((sign for sign in (";", ",", "\t") if sign in first), None)
    rows = [(number, [cell.strip().strip('"') for cell in line.split(sign)]) for number, line in given]
    if sign == ";":  # decimal commas
        rows = [(number, [cell.replace(",", ".") for cell in cells]) for number, cells in rows]
    return [(number, cells[:-1] if cells[-1] == "" else cells) for number, cells in rows]


def _columns(header: tuple[int, list[str]], body: str) -> tuple[dict[str, int], dict[str, float]]:
    """Number of each column that is known, and the factor of its unit."""
    number, names = header
    places, factors = dict[str, int](), dict[str, float]()
    for place, name in enumerate(names):
        found = _column(name.lstrip("%"), body)
        if found is not None and found[0] not in places:
            places[found[0]], factors[found[0]] = place, 1e-9 if name == "%time" else found[1]
    if missing := [name for name in ("t", "x", "y") if name not in places]:
        of_body = f" of {body}" if body else ""
        hint = f"name the columns t, x, y (, z, yaw), with units such as x_mm; this line has {', '.join(names)[:80]}"
        raise FormatError(f"line {number}: no column {', '.join(missing)}{of_body}; {hint}")
    return places, factors


def _column(name: str, body: str) -> tuple[str, float] | None:
    """Column of a name, and the factor of its unit; None for a name of something else."""
    bare = re.sub(r"[./:]+", "_", name.strip()).strip("_")
    if body and bare.startswith(f"{body}_"):
        bare = bare[len(body) + 1 :]
    bare, factor = bare.lower(), 1.0
    with_unit = UNIT.fullmatch(bare)
    if with_unit and bare not in COLUMNS:
        bare = with_unit[1].rstrip("_")
        unit = next(filter(None, with_unit.groups()[1:]))
        if unit not in UNITS and unit not in UNITS_OF_ANGLES:
            return None
        factor = UNITS.get(unit) or UNITS_OF_ANGLES[unit]
    if of_ros := re.search(r"(?:position|orientation)_[xyzw]$", bare):
        bare = of_ros[0]
    return (COLUMNS[bare], factor) if bare in COLUMNS else None


def _samples(rows: Rows, places: dict[str, int], factors: dict[str, float]) -> list[TimedPose]:
    found, zero = list[TimedPose](), None
    turned = all(name in places for name in QUATERNION)
    for number, cells in rows:
        value = {name: factors.get(name, 1.0) * _number(number, cells, place) for name, place in places.items()}
        if abs(value["t"]) > LATEST_S or any(abs(value[name]) > FARTHEST for name in value if name != "t"):
            raise FormatError(
                f"line {number}: a place or a time beyond all measure; mend its units, or remove the line"
            )
        zero = value["t"] if zero is None else zero
        yaw = _yaw(*(value[name] for name in QUATERNION)) if turned else value.get("yaw", nan)
        found.append(TimedPose(value["t"] - zero, (value["x"], value["y"], value.get("z", nan)), yaw, number))
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


def _yaw(x: float, y: float, z: float, w: float) -> float:
    """Yaw of a quaternion of any length [rad]."""
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


class _Channel(NamedTuple):
    """Columns of a body in Vicon's export."""

    place: dict[str, int]
    angle: float  # factor of its angles to radians


def _vicon(lines: Sequence[str], head: int, body: str) -> list[TimedPose]:
    """Poses of a body of Vicon's export: kind, rate, names of the bodies, names of the columns, units, numbers."""
    try:
        rate = next(float(line.strip(", ")) for line in lines[:head] if _is_number(line.strip(", ")))
    except StopIteration:
        raise FormatError(
            "no rate stands above its columns; export from Vicon with the header, rate included"
        ) from None
    if rate <= 0.0:
        raise FormatError(f"its rate is {rate:g} Hz; export from Vicon with the header, rate included")
    channel = _channel(lines, head, body)
    found, zero = list[TimedPose](), None
    for number, line in enumerate(lines[head + 1 :], head + 2):
        cells = [cell.strip() for cell in line.split(",")]
        if not any(cells):
            if found:
                break  # the next section of the file
            continue
        if not _is_number(cells[0]):
            continue  # the line of units
        if any(place >= len(cells) or not cells[place] for place in channel.place.values()):
            continue  # the body was hidden
        value = {name: _number(number, cells, place) for name, place in channel.place.items()}
        time = _number(number, cells, 0) / rate
        if any(abs(each) > 1e3 * FARTHEST for each in value.values()) or abs(time) > LATEST_S:
            raise FormatError(f"line {number}: a place or a time beyond all measure; export again")
        zero = time if zero is None else zero
        place = 1e-3 * value["tx"], 1e-3 * value["ty"], 1e-3 * value["tz"]
        found.append(TimedPose(time - zero, place, _vicon_yaw(value, channel.angle), number))
    for before, after in pairwise(found):
        if after.time - before.time > HIDDEN_S:
            message = f"line {after.line}: {body or 'the body'} was hidden for {after.time - before.time:.2g} s"
            raise FormatError(f"{message}; record again, or fill the gap in Vicon before the export")
    return _in_order(found)


def _channel(lines: Sequence[str], head: int, body: str) -> _Channel:
    names = [cell.strip().removeprefix("Global Angle ") for cell in lines[head - 1].split(",")]
    columns = [cell.strip().lower() for cell in lines[head].split(",")]
    units = [cell.strip().lower() for cell in (lines[head + 1] if head + 1 < len(lines) else "").split(",")]
    bodies = {name.partition(":")[0]: place for place, name in enumerate(names) if name and place > 1}
    if not body and len(bodies) > 1:
        raise FormatError(f'line {head}: it has {", ".join(bodies)}; write body = "{next(iter(bodies))}", or another')
    if body and body not in bodies:
        raise FormatError(f"line {head}: no body {body!r}; {did_you_mean(body, bodies)}")
    begin = bodies[body] if body else next(iter(bodies.values()), 2)
    later = [place for place in bodies.values() if place > begin]
    place = {name: k for k, name in enumerate(columns[: min(later, default=len(columns))]) if k >= begin}
    wanted = [name for name in ("rx", "ry", "rz", "rw", "tx", "ty", "tz") if name in place]
    if not {"tx", "ty", "tz"} <= set(wanted):
        raise FormatError(f"line {head + 1}: no columns TX, TY, TZ; export the objects with their places")
    unit = units[place["rz"]] if "rz" in place and place["rz"] < len(units) else ""
    return _Channel({name: place[name] for name in wanted}, UNITS_OF_ANGLES.get(unit, 1.0))


def _vicon_yaw(value: dict[str, float], angle: float) -> float:
    """Yaw of a quaternion, or else of a rotation vector; NaN without either [rad]."""
    if not {"rx", "ry", "rz"} <= value.keys():
        return nan
    x, y, z = value["rx"], value["ry"], value["rz"]
    if "rw" in value:
        return _yaw(x, y, z, value["rw"])
    turn = angle * hypot(x, y, z)
    share = sin(0.5 * turn) / (turn / angle) if turn else 0.0
    return _yaw(share * x, share * y, share * z, cos(0.5 * turn))
