"""Starts of robots from a file beside an experiment of Robotic Park: an index or a Webots world."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Final

from experiments.authoring.robotic_park.file import Pose, kind_of, load, pose_of
from experiments.file.problems import refusal
from experiments.file.text import content

WORD: Final = re.compile(r'"[^"]*"|#[^\n]*|[{}\[\]]|[^\s{}\[\]"#]+')


def starts_from(file: str) -> dict[str, Pose]:
    """Starts of robots by name: from an index or experiment (.yaml), or a Webots world (.wbt).

    Raises:
        DocumentError: If the file cannot be read, or tells no start.
    """
    hint = "name an index of robots (.yaml) or a Webots world (.wbt)"
    try:
        text = content(Path(file), file)
    except FileNotFoundError:
        raise refusal(file, "there is no such file", hint) from None
    found = (_world if Path(file).suffix.lower() == ".wbt" else _index)(file, text)
    if not found:
        raise refusal(file, "tells the start of no robot", hint)
    return found


def _index(file: str, text: str) -> dict[str, Pose]:
    root = load(file, text)
    listed = (root.get("Robots") if root.has("Robots") else root).tables()
    return {
        str(each.value.get("name", each.name)): pose_of(each.get("pose"), each.value["pose"])
        for each in listed
        if each.has("pose") and not isinstance(each.value["pose"], dict)
    }


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
