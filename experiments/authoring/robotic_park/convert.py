"""`./zenpark import FILE.yaml`: experiment files of Robotic Park's authors become experiment files of zenpark.

What they say is carried over as far as zenpark has the same thing; the rest is listed, in the new file and on
standard output. `docs/import.md` says what becomes of what.
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from agents.body.kinds import KINDS
from experiments.authoring.robotic_park.file import Park, Robot, Threshold, read
from experiments.authoring.robotic_park.heights import Heights, find_heights
from experiments.authoring.robotic_park.links import FormationLines, formation_lines, shorten_names
from experiments.authoring.robotic_park.starts import starts_from
from experiments.catalogue import index
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.problems import refusal
from experiments.file.text import content

RATE_HZ: Final = 100.0  # of bodies: their position controllers run at that
ROOM: Final = 0.6  # [m] around starts and shape
PARK: Final = (4.0, 4.0, 2.5)  # [m] the arena, if there is room in it
WIDTH: Final = 110
RADIO: Final = re.compile(r"radio://(\d+)/\d+/(?:250K|1M|2M)/[0-9A-Fa-f]{10}")


@dataclass(frozen=True)
class Rates:
    """Rates of poses and decisions [Hz]."""

    pose_hz: float
    coordination_hz: float


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
    park = read(label, text, {} if poses is None else starts_from(poses))
    _tools(park, notes)
    rates = _rates(park, notes)
    trigger, update = _trigger(park, rates, notes), _update(park, notes)
    found = find_heights(park, notes)
    formation = formation_lines(park, found, notes)
    notes = list(dict.fromkeys(notes))
    return _written(park, label, duration_s, rates, (trigger, update), found, formation, notes), notes


def _written(  # noqa: PLR0917 - everything that was found out
    park: Park,
    label: str,
    duration_s: float,
    rates: Rates,
    triggers: tuple[str, str],
    found: Heights,
    formation: FormationLines,
    notes: Sequence[str],
) -> str:
    trigger, update = triggers
    size = _arena(park, found)
    name = Path(label).stem
    lines = [f"#:schema ./{index.SCHEMA}", f"# Imported from {_plain(Path(label).name)}."]
    if notes:
        lines.append("# Not carried over, or not as it was:")
        for note in notes:
            lines += textwrap.wrap(_plain(note), WIDTH, initial_indent="# - ", subsequent_indent="#   ")
    lines += [
        f'title = "{_plain(name)}: {len(park.robots)} robots, {park.mode}"',
        f'source = "an experiment file of Robotic-Park-Lab, {_plain(Path(label).name)}"',
        f"duration_s = {duration_s:g}",
        *(['architecture = "centralised"'] if park.architecture == "centralized" else []),
        f"trigger = {trigger}",
        *(['positioning = "vicon-twin"'] if any(robot.external for robot in park.robots) else []),
        "",
        "[arena]",
        f"size = [{size[0]:g}, {size[1]:g}, {size[2]:g}]",
        "",
        "[rates]",
        f"body_hz = {RATE_HZ:g}",
        f"pose_hz = {rates.pose_hz:g}",
        f"coordination_hz = {rates.coordination_hz:g}",
        "",
        "[formation]",
        *formation.settings,
        *([f"update = {update}"] if update else []),
        "",
        "[robots]",
        *(_robot(robot, found, row) for row, robot in enumerate(park.robots)),
        "",
    ]
    for table, rows in (("links", formation.links), ("anchors", formation.anchors)):
        if rows:
            lines += [f"[formation.{table}]", *rows, ""]
    return "\n".join(lines)


def _plain(text: str) -> str:
    """Text that may stand in a comment and in quotes."""
    return "".join(letter if letter.isprintable() and letter not in '"\\' else "?" for letter in text)


def _arena(park: Park, found: Heights) -> list[float]:
    """Their park, or as much as starts and shape need, to the next half metre [m]."""
    places = np.concatenate([found.start, found.shape])
    reach = 2.0 * (np.abs(places[:, :2]).max(axis=0) + ROOM)
    needed = [*reach.tolist(), float(found.hover.max(initial=0.0)) + ROOM]
    return [max(size, float(np.ceil(2.0 * need) / 2.0)) for size, need in zip(PARK, needed, strict=True)]


def _robot(robot: Robot, found: Heights, row: int) -> str:
    body, process = _body(robot)
    x, y = found.start[row, :2].tolist()
    flies = KINDS[robot.kind].flies
    yaw = 0.0 if flies or robot.pose is None else robot.pose[2]
    parts = [f'kind = "{robot.kind}"', f"start = [{x:g}, {y:g}{f', {yaw:g}' if yaw else ''}]"]
    if flies:
        parts.append(f"hover = {found.hover[row]:g}")
    if body:
        parts.append(f'body = "{body}"')
    if process:
        parts.append(f'process = "{process}"')
    if robot.external:
        parts.append('position = "external"')
    if robot.place == "digital_twin":
        parts.append("shadow = {}")
    return f"{robot.name} = {{ {', '.join(parts)} }}{'  # start made up' if robot.pose is None else ''}"


def _body(robot: Robot) -> tuple[str, str]:
    """Address of a real robot and its process; empty for twins, and where there is no address."""
    if robot.place == "virtual":
        return "", ""
    radio = RADIO.fullmatch(robot.uri)
    if robot.kind == "crazyflie" and radio:
        return robot.uri, f"radio{radio[1]}"
    if robot.kind in ("khepera4", "tello") and re.fullmatch(r"[\w.-]+(:\d+)?", robot.host):
        return f"{robot.kind}://{robot.host}", ""
    return "", ""


def _tools(park: Park, notes: list[str]) -> None:
    if park.tool and park.mode != "physical":
        notes.append(
            f"Operation: the simulator and its world ({park.tool}); twins are zenpark's own, in an empty arena"
        )
    if park.kind != "formation":
        notes.append(f"Experience: type {park.kind}; only formations are known")
    if park.architecture not in {"distributed", "centralized"}:
        notes.append(f"Architecture: {park.architecture}; every robot decides for itself here")
    if park.others:
        notes.append(f"{', '.join(park.others)}: zenpark records, watches and reports by itself")
    away = [robot.name for robot in park.robots if robot.place != "virtual" and not _body(robot)[0]]
    if away:
        verb = "is" if len(away) == 1 else "are"
        notes.append(f"{shorten_names(away)} {verb} real, but without an address of a known kind: twins instead")
    if len(away) < sum(robot.place != "virtual" for robot in park.robots):
        notes.append("real robots keep their addresses; try the file with --virtual or --bodies twin first")
    if any(robot.external for robot in park.robots):
        notes.append(
            "positioning Extern: the motion capture's address is not in their file; positioning is a twin of it"
        )
    gated = [robot.name for robot in park.robots if robot.gated]
    if gated:
        notes.append(f"{shorten_names(gated)}: position controllers that act on events; zenpark's run at every tick")
    roles = Counter(task.role for _, task in park.tasks if task.role != "consensus")
    if roles:
        notes.append(f"task.role: {', '.join(roles)}; leaders are the robots without neighbours")
    idle = [robot for robot in park.robots if robot.idle]
    if idle:
        count = sum(robot.idle for robot in idle)
        names = shorten_names([robot.name for robot in idle])
        notes.append(
            f"task.enable is False for {names}: {count} relations are left out, and these robots have no neighbours"
        )
    notes += park.remarks


def _rates(park: Park, notes: list[str]) -> Rates:
    period = _most_common("task.controller.period", [task.period for _, task in park.tasks], 0.1, notes)
    asked = _most_common("local_pose.T", [robot.pose_s for robot in park.robots], 0.02, notes)
    return Rates(_divisor("poses", 1.0 / asked, notes), _divisor("decisions", 1.0 / period, notes))


def _divisor(what: str, hz: float, notes: list[str]) -> float:
    """The nearest rate that divides that of bodies."""
    divisors = [RATE_HZ / times for times in range(1, 1001) if (1000 * RATE_HZ / times).is_integer()]
    nearest = min(divisors, key=lambda each: abs(np.log(each / hz)))
    if abs(nearest - hz) > 1e-6 * hz:
        notes.append(f"{what} at {hz:g} Hz become {nearest:g} Hz, which divides the {RATE_HZ:g} Hz of bodies")
    return nearest


def _trigger(park: Park, rates: Rates, notes: list[str]) -> str:
    """Trigger of poses, one for all robots."""
    chosen = _most_thresholds("communication", [robot.communication for robot in park.robots], notes)
    if not chosen.event:
        return f'{{ kind = "periodic", period_s = {1.0 / rates.pose_hz:g} }}'
    if chosen.relative:
        notes.append(f"communication.threshold.ai = {chosen.relative:g}: the part of the threshold that grows")
    return f'{{ kind = "send-on-delta", threshold = {chosen.constant:g} }}'


def _update(park: Park, notes: list[str]) -> str:
    """Control trigger; empty: the law is computed at every decision."""
    given = [task.update for _, task in park.tasks]
    update = _most_thresholds("task.controller", given, notes) if given else None
    if update is None or not update.event:
        return ""
    return f'{{ kind = "relative-control", floor = {update.constant:g}, share = {update.relative:g} }}'


def _most_thresholds(what: str, given: Sequence[Threshold], notes: list[str]) -> Threshold:
    """The threshold that most robots have, whatever kind they call it."""
    odd = Counter(each.kind for each in given if each.event and each.kind != "Constant")
    if odd:
        notes.append(f"{what}.threshold.type: {', '.join(odd)}; taken as a constant one with what ai adds")
    plain = [
        Threshold(True, each.constant, each.relative, "") if each.event else Threshold(False, 0.0, 0.0, "")
        for each in given
    ]
    counted = Counter(plain)
    if len(counted) > 1:
        notes.append(f"{what}: {len(counted)} sorts among the robots; all get the commonest")
    return counted.most_common(1)[0][0]


def _most_common(what: str, given: Sequence[float], default: float, notes: list[str]) -> float:
    """The value that most robots have."""
    if not given:
        return default
    counted = Counter(given)
    value = counted.most_common(1)[0][0]
    if len(counted) > 1:
        notes.append(
            f"{what}: {', '.join(f'{each:g}' for each in sorted(counted))} s among the robots; all get {value:g}"
        )
    return value
