"""`./zenpark import crazyflies.yaml`: the drones of Crazyswarm2, or of Crazyswarm, become an experiment file.

Crazyswarm2 lists `robots` by name with uri, initial_position and type; Crazyswarm lists `crazyflies` with id and
channel. Either says where drones stand and how they are reached, not what they do: here they hover. What else stands
there is listed, in the new file and on standard output.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final

from msgspec import Meta, Struct

from agents.body.device_address import DeviceAddress
from agents.body.interface import BodyError
from agents.errors import did_you_mean, join_names
from agents.plugins import registry
from bridges.crazyflie.protocol import addresses as protocol
from bridges.crazyflie.protocol.parameters import parameter_faults
from experiments.authoring.robotic_park.file import MISSING, YamlValue, load, text_of
from experiments.catalogue import index
from experiments.definition.experiment import VICON_TWIN, Name
from experiments.file import catalogue as entries
from experiments.file import document
from experiments.file.problems import DocumentError, Problem, refusal
from experiments.file.reference import written

HOVER: Final = 0.6  # height of a drone for which the file has none [m]
APART: Final = 0.5  # distance between drones with a made-up place [m]
TOUCH: Final = 0.2  # places nearer than this are one [m]: a Crazyflie is 0.13 m wide, and stands where it was put
ROOM: Final = 1.0  # space around the starts [m]
LEAST: Final = (4.0, 4.0, 2.5)  # smallest arena [m]
WIDTH: Final = 110  # letters of a line of comments
MOCAP: Final = "motion_capture.yaml"  # file of Crazyswarm2 beside the other
TAKEN: Final = ("enabled", "uri", "initial_position", "type", "id", "channel", "initialPosition")
NOISE: Final = ("[disturbance.all]", "position_sigma = 0.0003        # m, white noise of motion capture, of twins", "")
SURE_HZ: Final = protocol.PACKETS_PER_RADIO / protocol.MEASURED_SHARE  # exchanges of a radio that is not measured [1/s]

Coordinate = Annotated[float, Meta(ge=-1e3, le=1e3)]
Position = tuple[Coordinate, Coordinate, Coordinate]


class _Entry(Struct, frozen=True):
    """Drone of Crazyswarm2."""

    uri: str
    initial_position: Position
    type: str = ""


class _NumberedEntry(Struct, frozen=True, rename="camel"):
    """Drone of Crazyswarm; its address ends with its number."""

    id: Annotated[int, Meta(ge=0, le=255)]
    channel: Annotated[int, Meta(ge=0, le=protocol.LAST_CHANNEL)]
    initial_position: Position
    type: str = ""


class _Enabled(Struct, frozen=True):
    enabled: bool = True


class _Capture(Struct, frozen=True):
    enabled: bool = True
    marker: str = ""
    tracking: str = ""  # "vendor": by the system's own software; else by that of Crazyswarm


class _Type(Struct, frozen=True):
    motion_capture: _Capture = _Capture(enabled=False)


@dataclass(frozen=True)
class SwarmDrone:
    """Drone that is enabled."""

    name: str
    key: str  # its path in the file
    uri: str
    position: Position
    capture: _Capture
    made_up: bool = False  # True for a place that is not that of the file
    # firmware parameters, and rates at which its radio carries all its drones
    device: Mapping[str, Any] = field(default_factory=dict)

    @property
    def radio(self) -> str:
        return protocol.dongle_of(self.uri)


def is_crazyswarm(file: str, text: str) -> bool:
    """Whether a YAML file is one of Crazyswarm2 or Crazyswarm; raises DocumentError if it is no YAML."""
    return bool({"robots", "crazyflies"} & load(file, text).value.keys())


def convert(file: str, text: str, target: str | None, duration_s: float) -> tuple[Path, list[str]]:
    """Write the experiment file of a `crazyflies.yaml`; return its path and what was not carried over.

    Raises:
        DocumentError: With the errors of all drones, by the paths of the keys; or the new file cannot be written.
    """
    made, notes = convert_text(text, file, duration_s)
    return entries.write_new(made, Path(target or f"{Path(file).stem}.toml")), notes


def convert_text(text: str, label: str, duration_s: float) -> tuple[str, list[str]]:
    """The text of the experiment file, and what was not carried over; raises DocumentError as `convert`."""
    root, notes = load(label, text), list[str]()
    drones = _with_rates(_on_one_channel(_apart(_enabled(root, notes), notes), notes), notes)
    source = _positioning(Path(label).parent, drones, notes)
    notes = [*dict.fromkeys([*notes, *_notes(root, drones)])]
    made = _text(Path(label).name, drones, source, duration_s, notes)
    document.loads(made)
    return made, notes


def _enabled(root: YamlValue, notes: list[str]) -> list[SwarmDrone]:
    """The drones that are enabled; a note names the others."""
    listed = _listed(root)
    left, drones, problems = list[str](), list[SwarmDrone](), list[Problem]()
    for name, entry in listed:
        try:
            if entry.typed(_Enabled).enabled:
                drones.append(_drone(root, name, entry, notes))
            else:
                left.append(name)
        except DocumentError as error:
            problems += error.problems
    first: dict[DeviceAddress, SwarmDrone] = {}
    for each in drones:
        other = first.setdefault(protocol.device_of(each.uri), each)
        if other is not each:
            message = f"{each.key}: {other.name} and {each.name} have one address, {each.uri}"
            problems.append(Problem(root.file, 0, 0, message, "give each drone its own; the Crazyflie client sets it"))
    if problems:
        raise DocumentError(problems)
    if not drones:
        raise refusal(root.file, "no drone is enabled", "write enabled: true for those that shall fly")
    if left:
        notes.append(f"disabled, and left out: {join_names(left, 12)}")
    return drones


def _listed(root: YamlValue) -> list[tuple[str, YamlValue]]:
    """Names and tables of all drones."""
    value = root.value.get("robots", root.value.get("crazyflies"))
    if isinstance(value, dict) and "robots" in root.value:
        rows = [(str(name), YamlValue(root.file, f"robots.{name}", each)) for name, each in value.items()]
    elif isinstance(value, list) and "robots" not in root.value:
        tables = [YamlValue(root.file, f"crazyflies[{number}]", each) for number, each in enumerate(value)]
        rows = [(f"cf{each.value.get('id') if isinstance(each.value, dict) else ''}", each) for each in tables]
    else:
        hint = "Crazyswarm2 has robots: by name, with uri, initial_position and type; Crazyswarm a list crazyflies:"
        raise refusal(root.file, "its drones are not listed as Crazyswarm2 or Crazyswarm list them", hint)
    for _, each in rows:
        if not isinstance(each.value, dict):
            raise refusal(root.file, f"{each.key} is no table", "give it uri, initial_position and type")
    return rows


def _drone(root: YamlValue, name: str, entry: YamlValue, notes: list[str]) -> SwarmDrone:
    if "robots" not in root.value:
        numbered = entry.typed(_NumberedEntry)
        uri, key = f"radio://0/{numbered.channel}/2M/E7E7E7E7{numbered.id:02X}", entry.key
        kind, position = numbered.type, numbered.initial_position
    else:
        given, key = entry.typed(_Entry), f"{entry.key}.uri"
        uri, kind, position = given.uri, given.type, given.initial_position
    try:
        YamlValue(root.file, "", name).typed(Name)
    except DocumentError:
        hint = "use letters, digits and _, beginning with a letter, at most 32"
        raise refusal(root.file, f"{entry.key}: {name!r} cannot be a name", hint) from None
    try:
        protocol.address(name, uri)
    except BodyError as error:
        message, _, hint = str(error).removeprefix(f"{name}: ").partition("; ")
        raise refusal(root.file, f"{key}: {message}", hint) from None
    capture, types = _capture(root, entry.key, kind), root.value.get("robot_types")
    parameters = _parameters(
        (root.value.get("all"), types.get(kind) if isinstance(types, dict) else None, entry.value), notes
    )
    return SwarmDrone(name, key, uri, position, capture, device={"parameters": parameters} if parameters else {})


def _capture(root: YamlValue, key: str, kind: str) -> _Capture:
    """Motion capture of a type of drones, which Crazyswarm gives to all."""
    if "robots" not in root.value:
        return _Capture()
    types = root.value.get("robot_types", {})
    if not kind or not isinstance(types, dict):
        return _Capture(enabled=False)
    if kind not in types:
        raise refusal(root.file, f"{key}.type: no {kind!r} among the robot_types", did_you_mean(kind, types))
    return YamlValue(root.file, f"robot_types.{kind}", types[kind]).typed(_Type).motion_capture


def _apart(drones: Sequence[SwarmDrone], notes: list[str]) -> list[SwarmDrone]:
    """The drones with a place each: motion capture finds them wherever they stand, so a file may give all the same."""
    placed, moved = list[SwarmDrone](), list[SwarmDrone]()
    for each in drones:
        alone = all(math.dist(each.position[:2], other.position[:2]) >= TOUCH for other in placed)
        (placed if alone else moved).append(each)
    for each in moved:
        place = next(
            (x, y, 0.0)
            for x, y in _lattice()
            if all(math.dist((x, y), other.position[:2]) >= APART - 1e-9 for other in placed)
        )
        placed.append(replace(each, position=place, made_up=True))
    if moved:
        names = join_names([each.name for each in moved], 12)
        notes.append(
            f"{names}: on one place with another drone in that file; their starts here are made up: put the drones "
            "there, or write where they stand"
        )
    by_name = {each.name: each for each in placed}
    return [by_name[each.name] for each in drones]


def _lattice() -> Iterator[tuple[float, float]]:
    """Places of a square lattice, ring by ring from the origin [m]."""
    ring = 0
    while True:
        for i in range(-ring, ring + 1):
            for j in range(-ring, ring + 1):
                if max(abs(i), abs(j)) == ring:
                    yield APART * i, APART * j
        ring += 1


def _on_one_channel(drones: Sequence[SwarmDrone], notes: list[str]) -> list[SwarmDrone]:
    """The drones with a radio for each channel: a process drives its radio on one channel."""
    taken = {each.radio for each in drones}
    radio_of: dict[tuple[str, tuple[int, str]], str] = {}
    found = list[SwarmDrone]()
    for each in drones:
        if each.radio:
            air = each.radio, protocol.air_of(each.uri)
            if air not in radio_of:
                used = each.radio in radio_of.values()
                radio_of[air] = (
                    next(str(n) for n in range(len(taken) + 1) if str(n) not in taken) if used else each.radio
                )
                taken.add(radio_of[air])
            uri = each.uri.replace(f"//{each.radio}/", f"//{radio_of[air]}/", 1)
            found.append(replace(each, uri=uri))
        else:
            found.append(each)
    for (radio, (channel, rate)), given in radio_of.items():
        if given != radio:
            notes.append(
                f"radio {radio} has drones on several channels; one radio here keeps to one, so those on channel "
                f"{channel}, {rate}, are on radio {given}: plug it in, or give all drones of a radio one channel"
            )
    return found


def _with_rates(drones: Sequence[SwarmDrone], notes: list[str]) -> list[SwarmDrone]:
    """The drones with rates at which each radio carries all of its own."""
    device = dict[str, dict[str, Any]]()
    for radio in dict.fromkeys(each.radio for each in drones if each.radio):
        here = [each for each in drones if each.radio == radio]
        outside = any(each.capture.enabled for each in here)
        each = protocol.chosen(radio, {}, external=outside)
        robots, fits = protocol.fitting(each, len(here), SURE_HZ)
        if robots < len(here):
            notes.append(
                f"radio {radio} has {len(here)} drones; one radio is sure to carry {robots}: it is measured when they "
                "connect, and refused if it carries too little"
            )
        if fits != each:
            device[radio] = {"log_hz": fits.log_hz, "stream_hz": fits.stream_hz}
            if isinstance(fits.positioning, protocol.Outside):
                device[radio]["positioning"] = {"system": "external", "rate_hz": fits.positioning.rate_hz}
            notes.append(f"radio {radio} has {len(here)} drones, and rates that it carries for them in `device`")
    return [replace(each, device={**each.device, **device.get(each.radio, {})}) for each in drones]


def _positioning(folder: Path, drones: Sequence[SwarmDrone], notes: list[str]) -> str | dict[str, str]:
    """Source of positions, by the file of the motion capture beside; empty if no drone needs one."""
    if not any(each.capture.enabled for each in drones):
        return ""
    beside = folder / MOCAP
    try:
        text = text_of(str(beside), "")
    except DocumentError as error:
        if error.problems[0].message != MISSING:
            raise
        notes.append(f"motion capture: no {MOCAP} beside the file; its twin is taken: write positioning yourself")
        return VICON_TWIN
    parameters = load(str(beside), text).value
    for key in ("/motion_capture_tracking", "ros__parameters"):
        parameters = parameters.get(key, {}) if isinstance(parameters, dict) else {}
    system, host = (
        str(parameters.get(key, "")) if isinstance(parameters, dict) else "" for key in ("type", "hostname")
    )
    system = system.removesuffix("_closed_source")
    if system in registry.names(registry.POSITIONING) and re.fullmatch(r"[\w.-]+(:\d+)?", host):
        source = f"{system}://{host}"  # Crazyswarm2 leaves axes as they are: Motive is set to z up there
        return {"source": source, "up": "z"} if system == "optitrack" else source
    notes.append(f"motion capture: {system or 'no type'} at {host or 'no host'} in {MOCAP}; its twin is taken")
    return VICON_TWIN


def _notes(root: YamlValue, drones: Sequence[SwarmDrone]) -> Iterator[str]:
    """Notes on what the file has besides."""
    yield "real drones keep their addresses; `run` flies them: try the file with --virtual or --bodies twin first"
    if high := [each.name for each in drones if abs(each.position[2]) > 0.01]:
        yield f"{join_names(high, 12)}: the height of initial_position; drones start on the floor, and their yaw is 0"
    if single := [each.name for each in drones if each.capture.enabled and "single_marker" in each.capture.marker]:
        yield f"{join_names(single, 12)}: a single marker; here motion capture must know each drone as a rigid body"
    followed = [each for each in drones if each.capture.enabled and each.capture.tracking != "vendor"]
    if several := [each.name for each in followed if "single_marker" not in each.capture.marker]:
        yield (
            f"{join_names(several, 12)}: Crazyswarm tells drones with equal markers apart by where they start; here "
            "motion capture does, by its own rigid bodies: give each drone its name there, and markers of its own"
        )
    others = dict.fromkeys(key for _, entry in _listed(root) for key in entry.value if key not in TAKEN)
    unread = [key for key in (*_keys(root.value.get("all")), *others) if key != "firmware_params"]
    if unread:
        yield f"{', '.join(dict.fromkeys(unread))}: logging, limits and tools of Crazyswarm; zenpark has its own"


def _parameters(tables: Iterable[object], notes: list[str]) -> dict[str, float]:
    """Firmware parameters of a drone that may be set, by tables of which later ones win; a note for each other one."""
    found: dict[str, float] = {}
    for table in tables:
        groups = table.get("firmware_params") if isinstance(table, Mapping) else None
        for group, values in groups.items() if isinstance(groups, Mapping) else ():
            for name, value in values.items() if isinstance(values, Mapping) else ():
                try:
                    found[f"{group}.{name}"] = float(value)  # YAML has 1e-3 as a text
                except (TypeError, ValueError):
                    notes.append(f"firmware_params: {group}.{name}: {value!r} is no number")
    reasons: dict[str, list[str]] = {}
    for fault in [*parameter_faults(found)]:
        del found[fault.name]
        reasons.setdefault(f"{fault.message.removeprefix(fault.name)}; {fault.remedy}", []).append(fault.name)
    notes += [f"firmware_params: {join_names(names, 8)}{reason}" for reason, names in reasons.items()]
    return found


def _keys(table: object) -> Iterable[str]:
    return map(str, table) if isinstance(table, Mapping) else ()


def _text(
    name: str, drones: Sequence[SwarmDrone], source: str | dict[str, str], duration_s: float, notes: Sequence[str]
) -> str:
    plain = "".join(letter if letter.isprintable() and letter not in '"\\' else "?" for letter in name)
    lines = [f"#:schema ./{index.SCHEMA}", f"# Imported from {plain}. Not carried over, or not as it was:"]
    for note in notes:
        lines += textwrap.wrap(note, WIDTH, initial_indent="# - ", subsequent_indent="#   ")
    lines += [f'title = "{len(drones)} Crazyflies of {plain}"', f"duration_s = {duration_s:g}"]
    lines += [f"positioning = {written(source)}"] if source else []
    reach = [2.0 * (max(abs(each.position[axis]) for each in drones) + ROOM) for axis in (0, 1)]
    size = [max(least, math.ceil(2.0 * need) / 2.0) for least, need in zip(LEAST, [*reach, HOVER + ROOM], strict=True)]
    lines += ["", "[arena]", f"size = {written(size)}   # centred on the origin: write that of your net", "", *NOISE]
    for each in drones:
        lines += [f"[robots.{each.name}]", 'kind = "crazyflie"']
        remark = "   # made up" if each.made_up else ""
        lines += [f"start = {written([round(value, 4) for value in each.position[:2]])}{remark}", f"hover = {HOVER:g}"]
        lines += [f"body = {written(each.uri)}"]
        lines += [f'process = "radio{each.radio}"'] if each.radio else []
        lines += ['position = "external"'] if each.capture.enabled else []
        lines += [f"device = {written(each.device)}"] if each.device else []
        lines.append("")
    first = drones[0].name
    lines += [
        "# Without links each drone hovers where it took off. A way for one, and for another to follow it:",
        "# [[timeline]]",
        "# at_s = 10.0",
        f'# robot = "{first}"',
        '# plan = { kind = "circle", radius = 0.3, period_s = 10.0 }',
        "# [formation.links]",
        f'# "{first} > {drones[-1].name if len(drones) > 1 else "cf2"}" = 0.5',
        "",
    ]
    return "\n".join(lines)
