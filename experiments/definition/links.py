"""Links as the file writes them: "A > B" (B receives from A), "A - B" (both receive)."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final, NamedTuple

from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_NOTHING, BY_RELATIVE, Link
from agents.plugins.law import Law, Need
from agents.vectors import UNKNOWN
from experiments.definition.experiment import NO_TARGET, TARGETS, Experiment, TargetTable

_LINK: Final = re.compile(r"\s*(\w+)\s*([>-])\s*(\w+)\s*", re.ASCII)
_ALMOST: Final = re.compile(r"\s*(\w+)\s*([^\w\s]+)\s*(\w+)\s*", re.ASCII)
FORM: Final = 'a link reads "A > B" (B receives from A) or "A - B" (both receive)'
RELEASE: Final = 1.1  # multiple of the range: what separates coming from going, so that a link does not flicker


class TargetKind(NamedTuple):
    """Kind of target that a law takes of a link."""

    fields: tuple[str, ...]  # fields of `TargetTable` that give it; the first is the one that a drawn shape gives
    words: str
    example: str  # text that a file could have
    wants: int | None  # how the law takes every link, see `agents.formation.link`; None: by its own target


_ANY: Final = TargetKind(TARGETS, "a distance, an offset or a bearing", "0.6", None)
TARGET_KINDS: Final[dict[Need, TargetKind]] = {
    "distance": TargetKind(("distance", "offset"), "a distance or an offset", "0.6", BY_DISTANCE),
    "relative": TargetKind(("offset",), "an offset", "{ offset = [0.6, 0.0] }", BY_RELATIVE),
    "bearing": TargetKind(("bearing", "offset"), "a bearing or an offset", "{ bearing = [1.0, 0.0] }", BY_BEARING),
    "any": _ANY,
    "nothing": _ANY._replace(fields=(*_ANY.fields, NO_TARGET)),
}


@dataclass(frozen=True)
class OneWay:
    """One-way link: sender and receiver, target, and the time or range in which it exists."""

    receiver: str  # name
    sender: str  # name
    target: Link  # target at the beginning; a change makes copies
    since: float = 0.0  # begin [s]
    until: float = math.inf  # end [s], infinity for the end of the run
    reach: float = math.inf  # nearer than this it is there [m], infinity always
    release: float = math.inf  # farther than this it is there no more [m]
    text: str = ""  # text of the file; empty for links by proximity only


def link_pairs(text: str) -> tuple[tuple[str, str], ...]:
    """The (receiver, sender) pairs that a link stands for, one or two.

    Raises ValueError if it reads otherwise; the message is what to write instead.
    """
    match = _LINK.fullmatch(text)
    if match is None:
        raise ValueError(_remedy(text))
    first, sign, second = match.groups()
    return ((second, first),) if sign == ">" else ((second, first), (first, second))


def pairs_or_none(text: str) -> tuple[tuple[str, str], ...]:
    """The same; none if it reads otherwise, which is reported where links are checked."""
    return link_pairs(text) if _LINK.fullmatch(text) else ()


def one_way_links(experiment: Experiment, law: Law) -> list[OneWay]:
    """Every possible link, in the robots' order: by receiver, then sender.

    Raises:
        ValueError: If a link is not written as it must be; never for an experiment that `document.read` returned.
        KeyError: If it names no robot; likewise.
    """
    formation = experiment.formation
    near = formation.proximity
    reach, release = (math.inf, math.inf) if near is None else (near.range, near.release or RELEASE * near.range)
    found = []
    for text, given in formation.link_tables.items():
        for receiver, sender in link_pairs(text):
            target = link_target(experiment, text, given, receiver)
            target.gain = given.gain or getattr(formation, gain_key(law, target.wants))
            until = math.inf if given.until_s is None else given.until_s
            found.append(OneWay(receiver, sender, target, given.from_s, until, reach, release, text))
    if near is not None and near.distance is not None:
        linked = {(link.receiver, link.sender) for link in found}
        target = Link(near.distance, getattr(formation, gain_key(law, BY_DISTANCE)))
        found += [
            OneWay(a, b, target, reach=reach, release=release)
            for a in experiment.robots
            for b in experiment.robots
            if a != b and (a, b) not in linked
        ]
    row = {name: number for number, name in enumerate(experiment.robots)}
    return sorted(found, key=lambda link: (row[link.receiver], row[link.sender]))


def link_target(experiment: Experiment, text: str, given: TargetTable | float, receiver: str) -> Link:
    """Target of a link for one of its ends, as distance, offset and bearing; its gain is left open."""
    given = given if isinstance(given, TargetTable) else TargetTable(distance=given)
    if given.kind == NO_TARGET:
        return Link(wants=BY_NOTHING)
    if given.distance is not None:
        return Link(given.distance)
    second, first = link_pairs(text)[0]
    sign = 1.0 if receiver == second else -1.0
    if given.bearing is not None:
        length = math.hypot(*given.bearing)
        x, y, z = (*(sign * value / length for value in given.bearing), math.nan)[:3]
        return Link(bearing=(x, y, z), wants=BY_BEARING)
    offset = list(given.offset or ())
    rise = held_height(experiment, second) - held_height(experiment, first)
    x, y, z = (sign * value for value in (offset if len(offset) == 3 else [*offset, rise]))
    length = math.hypot(x, y, z)
    bearing = (x / length, y / length, z / length) if length > 0.0 else UNKNOWN
    return Link(length, relative=(x, y, z), bearing=bearing, wants=BY_RELATIVE)


def held_height(experiment: Experiment, name: str) -> float:
    """Height that a robot holds [m]."""
    return experiment.robots[name].hover or 0.0


def gain_key(law: Law, wants: int) -> str:
    """Key of `[formation]`, `gain` or `stiffness`, that is the gain of links with a kind of target, as the law says."""
    if law.PULLS_BY == "by link":
        return "gain" if wants == BY_DISTANCE else "stiffness"
    return law.PULLS_BY


def _remedy(text: str) -> str:
    almost = _ALMOST.fullmatch(text)
    if almost is None:
        return FORM
    first, sign, second = almost.groups()
    if "<" in sign and ">" in sign:
        return f'write "{first} - {second}" when both receive'
    if "<" in sign:
        return f'write "{second} > {first}" when {first} receives from {second}'
    if ">" in sign:
        return f'write "{first} > {second}" when {second} receives from {first}'
    return f'write "{first} > {second}" when {second} receives from {first}, "{first} - {second}" when both receive'
