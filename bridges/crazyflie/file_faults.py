"""Faults of the Crazyflies of an experiment file: addresses, radios, positioning systems. Needs no cflib."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Final

from agents.body.interface import BodyEntry, BodyFault, judged, settings
from bridges.crazyflie.geometry import check_anchors, in_one_plane, stations
from bridges.crazyflie.protocol.addresses import (
    CrazyflieSettings,
    Lighthouse,
    Loco,
    Outside,
    address,
    air_of,
    dongle_of,
)
from bridges.crazyflie.protocol.crazyradio import software
from bridges.crazyflie.protocol.parameters import parameter_faults

BODY: Final = ("body",)
SYSTEM: Final = ("device", "positioning")
PARAMETERS: Final = ("device", "parameters")
APART: Final = 2  # [channels of 1 MHz] distance from which on two radios leave each other alone


def file_faults(robots: Sequence[BodyEntry]) -> Iterator[BodyFault]:
    """As `Body.faults`."""
    addressed = []
    for each in robots:
        misaddressed = list(judged(each, BODY, partial(address, each.name, each.address)))
        yield from misaddressed
        addressed += [each] if not misaddressed else []
        yield from _positioning(each)
        table = settings(CrazyflieSettings, each.name, each.device)
        for wrong in parameter_faults(table.parameters, table.unprotected):
            yield BodyFault(each.name, PARAMETERS, wrong.message, wrong.remedy, wrong.severity)
    yield from _forwarded(robots)
    yield from _radios([each for each in addressed if dongle_of(each.address) and software(each.address) is None])


def _positioning(robot: BodyEntry) -> Iterator[BodyFault]:
    system = settings(CrazyflieSettings, robot.name, robot.device).positioning
    if isinstance(system, Outside) and not robot.external:
        message, remedy = 'positioning system "external" needs position = "external"', "add it to the robot's table"
        yield BodyFault(robot.name, SYSTEM, message, remedy)
    elif isinstance(system, Lighthouse) and system.file is not None and not robot.host:
        for fault in judged(robot, (*SYSTEM, "file"), partial(stations, system.file, system.base_stations)):
            yield replace(fault, here=True)
    elif isinstance(system, Loco):
        anchors, key = system.anchors, (*SYSTEM, "anchors")
        wrong = list(judged(robot, key, partial(check_anchors, anchors)))
        yield from wrong
        if not wrong and in_one_plane(anchors):
            message = "all anchors stand in one plane: on both sides of it ranges are equal, and near it they say least"
            yield BodyFault(robot.name, key, message, "move one out of it by 1 m or more", "warning")


def _forwarded(robots: Iterable[BodyEntry]) -> Iterator[BodyFault]:
    """A note on drones with markers and without a positioning system in their table."""
    tables = {each.name: settings(CrazyflieSettings, each.name, each.device) for each in robots if each.external}
    if names := [name for name, table in tables.items() if table.positioning is None]:
        message = (
            f"positions from outside go to the estimators of {', '.join(names)}, at most {Outside().rate_hz:g} a "
            'second; positioning = { system = "external" } in `device` sets rate and noise'
        )
        yield BodyFault(names[0], ("device",), message, severity="note")


def _radios(robots: Sequence[BodyEntry]) -> Iterator[BodyFault]:
    """Faults of robots that share a radio, or the channel of another one."""
    first: dict[tuple[str, str], BodyEntry] = {}
    for each in robots:
        radio = dongle_of(each.address)
        other = first.setdefault((each.host, radio), each)
        air, other_air = air_of(each.address), air_of(other.address)
        if air != other_air:
            channel = f"{each.name} on channel {air[0]}, {air[1]}"
            message = f"radio {radio} has {channel}, and {other.name} on {other_air[0]}, {other_air[1]}"
            yield BodyFault(each.name, BODY, message, "give all drones of a radio one channel and data rate")
        elif each.process != other.process:
            message = f"{other.name} and {each.name} share radio {radio}, which one process drives"
            yield BodyFault(each.name, BODY, message, f'give both process = "{_process(other, radio)}"')
    for one, two in combinations(first.values(), 2):
        channels = air_of(one.address)[0], air_of(two.address)[0]
        if abs(channels[0] - channels[1]) < APART:
            message = (
                f"radios {dongle_of(one.address)} and {dongle_of(two.address)} are on channels {channels[0]} and "
                f"{channels[1]}: each disturbs the other"
            )
            yield BodyFault(two.name, BODY, message, f"give them channels that are {APART} or more apart", "warning")


def _process(robot: BodyEntry, radio: str) -> str:
    return f"radio{radio}" if robot.process == robot.name else robot.process
