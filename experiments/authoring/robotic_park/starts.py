"""Starts of robots from a file beside an experiment of Robotic Park: an index, a Webots world or a table."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Final

from experiments.authoring.robotic_park.file import Pose, kind_of, load, pose_of
from experiments.file.problems import DocumentError, Problem, refusal
from experiments.file.text import content

WORD: Final = re.compile(r'"[^"]*"|#[^\n]*|[{}\[\]]|[^\s{}\[\]"#]+')


def starts_from(file: str) -> dict[str, Pose]:
    """Starts of robots by name: from an index or experiment (.yaml), a Webots world (.wbt) or a table.

    A table has a robot a line: its name, x, y [m] and, if wanted, z [m] or, of robots on wheels, the yaw [rad].

    Raises:
        DocumentError: If the file cannot be read, or tells no start.
    """
    try:
        text = content(Path(file), file)
    except FileNotFoundError:
        hint = "name an index of robots (.yaml), a Webots world (.wbt) or a table of name, x, y"
        raise refusal(file, "there is no such file", hint) from None
    kind = Path(file).suffix.lower()
    read = {".wbt": _world, ".yaml": _index, ".yml": _index}.get(kind, _table)
    found = read(file, text)
    if not found:
        raise refusal(file, "tells the start of no robot", "a line of a table: dron01 0.5 -0.2")
    return found


def _index(file: str, text: str) -> dict[str, Pose]:
    root = load(file, text)
    listed = (root.get("Robots") if root.has("Robots") else root).tables()
    return {
        str(each.value.get("name", each.name)): pose_of(each.get("pose"), each.value["pose"])
        for each in listed
        if each.has("pose") and not isinstance(each.value["pose"], dict)
    }


def _table(file: str, text: str) -> dict[str, Pose]:
    found, problems = {}, []
    for number, line in enumerate(text.splitlines(), 1):
        name, *rest = [part for part in re.split(r"[,;\s]+", line.partition("#")[0]) if part] or [""]
        if not name:
            continue
        try:
            values = [float(part) for part in rest]
        except ValueError:
            values = []
        if len(values) not in (2, 3) or not all(map(math.isfinite, values)):
            problems.append(Problem(file, number, 1, "is no start", "name, x, y and, if wanted, z or the yaw"))
            continue
        x, y, z = (*values, 0.0)[:3]
        found[name] = (x, y, z)
    if problems:
        raise DocumentError(problems)
    return found


def _world(file: str, text: str) -> dict[str, Pose]:
    """Starts in a Webots world: `name` and `translation` of its nodes; the yaw where `rotation` is about z."""
    found: dict[str, Pose] = {}
    words = [word for word in WORD.findall(text) if not word.startswith("#")]
    depth, name, place, yaw = 0, "", [0.0, 0.0, 0.0], 0.0
    for at, word in enumerate(words):
        if word in "{[":
            depth += 1
            if depth == 1:
                name = words[at - 2] if at >= 3 and words[at - 3] == "DEF" else ""
                place, yaw = [0.0, 0.0, 0.0], 0.0
        elif word in "}]":
            depth -= 1
            if depth == 0 and name:
                flies = kind_of(name) in ("crazyflie", "tello")
                found[name] = (place[0], place[1], place[2] if flies else yaw)
        elif depth == 1 and word == "name":
            name = words[at + 1].strip('"') if at + 1 < len(words) else ""
        elif depth == 1 and word in ("translation", "rotation"):
            values = _numbers(file, words[at + 1 : at + (4 if word == "translation" else 5)])
            if word == "translation":
                place = values
            elif abs(values[2]) > 1.0 - 1e-3:
                yaw = math.copysign(1.0, values[2]) * values[3]
    return found


def _numbers(file: str, words: list[str]) -> list[float]:
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = []
    if len(found) < 3 or not all(map(math.isfinite, found)):
        hint = "name another file with --poses"
        raise refusal(file, f"cannot be read near '{' '.join(words)}'", hint)
    return [*found, 0.0][:4]
