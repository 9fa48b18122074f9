"""`./zenpark import FILE.yaml`: experiment files of Robotic Park's authors become experiment files of zenpark.

What they say is carried over as far as zenpark has the same thing; the rest is listed, in the new file and on
standard output. `docs/import.md` says what becomes of what.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from agents.body.kinds import KINDS
from experiments.authoring.robotic_park.file import Park, Robot, read
from experiments.authoring.robotic_park.heights import Heights, find_heights
from experiments.authoring.robotic_park.links import commonest, formation_table, shorten_names
from experiments.authoring.robotic_park.starts import starts_from
from experiments.catalogue import index
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.problems import refusal
from experiments.file.reference import written
from experiments.file.text import content

RATE_HZ: Final = 100.0  # of bodies: their position controllers run at that
ROOM: Final = 0.6  # [m] around starts and shape
PARK: Final = (4.0, 4.0, 2.5)  # [m] the arena, if there is room in it
WIDTH: Final = 110
RADIO: Final = re.compile(r"radio://(\d+)/\d+/(?:250K|1M|2M)/[0-9A-Fa-f]{10}")


def convert(file: str, target: str | None, duration_s: float, poses: str | None = None) -> tuple[Path, list[str]]:
    """Write the experiment file of one of theirs; return its path and what was not carried over.

    Raises:
        DocumentError: If the file cannot be read, is no experiment of theirs, or the new one cannot be written.
    """
    source = Path(file)
    try:
        text = content(source, file)
    except FileNotFoundError:
        hint = "name an experiment file of Robotic Park's authors (.yaml)"
        raise refusal(file, "there is no such file", hint) from None
    made, notes = convert_text(text, file, duration_s, poses)
    path = entries.write_new(made, Path(target) if target else Path(f"{source.stem}.toml"))
    document.read(path)
    return path, notes


def convert_text(text: str, label: str, duration_s: float, poses: str | None = None) -> tuple[str, list[str]]:
    """The text of the experiment file, and what was not carried over.

    Args:
        label: Its name; the files that an index names are looked for beside it.
        poses: A file with starts, see `starts_from`; they go before those of theirs.

    Raises:
        DocumentError: With the errors in theirs, by the path of the key.
    """
    notes: list[str] = []
    park = read(label, text, {} if poses is None else starts_from(poses), notes)
    _note_robots(park, notes)
    pose_hz = _rate("local_pose.T", "poses", [robot.pose_s for robot in park.robots], notes)
    coordination_hz = _rate(
        "task.controller.period", "decisions", [task.period for _, task in park.tasks] or [0.1], notes
    )
    trigger: dict[str, Any] = {"kind": "periodic", "period_s": 1.0 / pose_hz}
    chosen = commonest("communication", [robot.communication for robot in park.robots], notes)
    if chosen is not None:
        trigger = {"kind": "send-on-delta", "threshold": chosen[0]}
        if chosen[1]:
            notes.append(f"communication.threshold.ai = {chosen[1]:g}: the part of the threshold that grows")
    found = find_heights(park, notes)
    formation, links, anchors = formation_table(park, found, notes)
    update = commonest("task.controller", [task.update for _, task in park.tasks] or [None], notes)
    if update is not None:
        formation["update"] = {"kind": "relative-control", "floor": update[0], "share": update[1]}
    notes = list(dict.fromkeys(notes))
    name = Path(label)
    tables: dict[str, dict[str, Any]] = {
        "": {
            "title": _plain(f"{name.stem}: {len(park.robots)} robots, {park.mode}"),
            "source": f"an experiment file of Robotic-Park-Lab, {_plain(name.name)}",
            "duration_s": duration_s,
            **({"architecture": "centralised"} if park.central else {}),
            "trigger": trigger,
            **({"positioning": "vicon-twin"} if any(robot.external for robot in park.robots) else {}),
        },
        "arena": {"size": _arena(found)},
        "rates": {"body_hz": RATE_HZ, "pose_hz": pose_hz, "coordination_hz": coordination_hz},
        "formation": formation,
        "robots": {robot.name: _robot(robot, found, row) for row, robot in enumerate(park.robots)},
        "formation.links": links,
        "formation.anchors": anchors,
    }
    lines = [f"#:schema ./{index.SCHEMA}", f"# Imported from {_plain(name.name)}."]
    lines += ["# Not carried over, or not as it was:"] if notes else []
    for note in notes:
        lines += textwrap.wrap(_plain(note), WIDTH, initial_indent="# - ", subsequent_indent="#   ")
    made_up = {robot.name for robot in park.robots if robot.pose is None}
    for header, table in tables.items():
        lines += [f"[{header}]"] if header and table else []
        for key, value in table.items():
            remark = "  # start made up" if header == "robots" and key in made_up else ""
            lines.append(f"{written(key) if ' ' in key else key} = {written(value)}{remark}")
        lines += [""] if table else []
    return "\n".join(lines), notes


def _plain(text: str) -> str:
    """Text that may stand in a comment and in quotes."""
    return "".join(letter if letter.isprintable() and letter not in '"\\' else "?" for letter in text)


def _arena(found: Heights) -> list[float]:
    """Their park, or as much as starts and shape need, to the next half metre [m]."""
    places = np.concatenate([found.start, found.shape])
    reach = 2.0 * (np.abs(places[:, :2]).max(axis=0) + ROOM)
    needed = [*reach.tolist(), float(found.hover.max(initial=0.0)) + ROOM]
    return [max(size, float(np.ceil(2.0 * need) / 2.0)) for size, need in zip(PARK, needed, strict=True)]


def _robot(robot: Robot, found: Heights, row: int) -> dict[str, Any]:
    start, flies = found.start[row, :2].tolist(), KINDS[robot.kind].flies
    if not flies and robot.pose is not None and robot.pose[2]:
        start.append(robot.pose[2])
    made: dict[str, Any] = {"kind": robot.kind, "start": start}
    if flies:
        made["hover"] = float(found.hover[row])
    made |= _body(robot)
    if robot.external:
        made["position"] = "external"
    if robot.place == "digital_twin":
        made["shadow"] = {}
    return made


def _body(robot: Robot) -> dict[str, str]:
    """Address of a real robot and its process; nothing for twins, and where there is no address."""
    if robot.place == "virtual":
        return {}
    radio = RADIO.fullmatch(robot.uri)
    if robot.kind == "crazyflie" and radio:
        return {"body": robot.uri, "process": f"radio{radio[1]}"}
    if robot.kind in ("khepera4", "tello") and re.fullmatch(r"[\w.-]+(:\d+)?", robot.host):
        return {"body": f"{robot.kind}://{robot.host}"}
    return {}


def _note_robots(park: Park, notes: list[str]) -> None:
    """What robots of theirs have and zenpark's do not."""

    def those(what: Callable[[Robot], object], note: str) -> None:
        if names := [robot.name for robot in park.robots if what(robot)]:
            notes.append(note.format(shorten_names(names), "is" if len(names) == 1 else "are"))

    those(
        lambda robot: robot.place != "virtual" and not _body(robot),
        "{} {} real, but without an address of a known kind: twins instead",
    )
    those(_body, "real robots ({}) keep their addresses; try the file with --virtual or --bodies twin first")
    those(
        lambda robot: robot.external,
        "positioning Extern ({}): the motion capture's address is not in their file; positioning is a twin of it",
    )
    those(
        lambda robot: robot.gated,
        "{}: position controllers that act on events; zenpark's run at every tick",
    )
    if roles := dict.fromkeys(task.role for _, task in park.tasks if task.role != "consensus"):
        notes.append(f"task.role: {', '.join(roles)}; leaders are the robots without neighbours")
    count = sum(robot.idle for robot in park.robots)
    those(
        lambda robot: robot.idle,
        f"task.enable is False for {{}}: {count} relations are left out, and these robots have no neighbours",
    )


def _rate(key: str, what: str, periods: Sequence[float], notes: list[str]) -> float:
    """The rate [Hz] nearest to the commonest period [s] that divides the rate of bodies."""
    hz = 1.0 / commonest(key, periods, notes)
    divisors = [RATE_HZ / times for times in range(1, 1001) if (1000 * RATE_HZ / times).is_integer()]
    nearest = min(divisors, key=lambda each: abs(np.log(each / hz)))
    if abs(nearest - hz) > 1e-6 * hz:
        notes.append(f"{what} at {hz:g} Hz become {nearest:g} Hz, which divides the {RATE_HZ:g} Hz of bodies")
    return nearest
