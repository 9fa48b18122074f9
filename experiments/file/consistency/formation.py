"""Consistency of a formation: links and their targets, anchors, changes, and links by range."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from agents.errors import did_you_mean
from agents.formation.link import BY_BEARING
from experiments.definition.experiment import NO_TARGET, ChangeTable, Experiment, TargetTable
from experiments.definition.links import FORM, TARGET_KINDS, held_height, link_pairs
from experiments.definition.plan import Plan
from experiments.file.problems import Fault, Path, after_the_end, unknown_robot

ROUNDED: Final = 1e-3  # [m] heights written with three decimals


def formation_faults(plan: Plan) -> Iterator[Fault]:
    """All contradictions in [formation]."""
    experiment, formation = plan.experiment, plan.experiment.formation
    found = list(_links(experiment))
    yield from found
    places = [("anchors", name) for name in formation.anchors] + [("shape", name) for name in formation.shape]
    for table, name in places:
        yield from unknown_robot(("formation", table, name), name, experiment.robots, on_key=True)
    if found:
        return  # what follows looks links up
    for text, link in formation.link_tables.items():
        path = ("formation", "links", text)
        yield from _asked(plan, text, link, path)
        yield from after_the_end((*path, "from_s"), "link", link.from_s, experiment.duration_s)
    for number, change in enumerate(formation.changes):
        yield from _change(plan, number, change)
    near = formation.proximity
    if near is not None and near.distance is None and not formation.links:
        message = "there are no links that could come and go by range"
        hint = "add distance = 0.5, which any two robots keep while they are near each other, or [formation.links]"
        yield Fault(("formation", "proximity"), message, hint)


def _links(experiment: Experiment) -> Iterator[Fault]:
    robots = experiment.robots
    if experiment.formation.leader is not None:
        yield from unknown_robot(("formation", "leader"), experiment.formation.leader, robots)
    given: dict[tuple[str, str], str] = {}
    for text in experiment.formation.links:
        path = ("formation", "links", text)
        try:
            both = link_pairs(text)
        except ValueError as error:
            hint = str(error)
            yield Fault(path, f"{text!r} is no link", hint if hint == FORM else f"{hint}; {FORM}", on_key=True)
            continue
        for name in dict.fromkeys(reversed(both[0])):
            yield from unknown_robot(path, name, robots, on_key=True)
        if both[0][0] == both[0][1]:
            yield Fault(path, f"'{both[0][0]}' cannot receive from itself", "name two robots", on_key=True)
            continue
        again = [pair for pair in both if pair in given]
        if again:
            receiver, sender = again[0]
            first = given[again[0]]
            what = f"stands twice, as '{first}' and" if f"{sender} > {receiver}" != first else "stands again in"
            message = f"the link from {sender} to {receiver} {what} '{text}'"
            yield Fault(path, message, "remove one of the two: 'A - B' is 'A > B' and 'B > A'", on_key=True)
        given.update(dict.fromkeys(both, text))


def _asked(plan: Plan, text: str, given: TargetTable, path: Path) -> Iterator[Fault]:
    """Targets that the law does not take, or that robots with held heights cannot meet."""
    experiment, needs = plan.experiment, TARGET_KINDS[plan.law.NEEDS]
    if given.kind not in needs.fields:
        message = f"the law '{plan.law_name}' needs {needs.words} of every link; this one asks for a {given.kind}"
        hint = f'draw all in [formation.shape] and write "{text}" = "shape", or write such as "{text}" = '
        hint = f'{hint}{needs.example}, or take law = "mixed", which goes by each link'
        if given.kind == NO_TARGET:
            message = f"the law '{plan.law_name}' needs a target of every link, and {text!r} has none"
            hint = f"give {needs.words}"
        yield Fault(path, message, hint)
        return
    second, first = link_pairs(text)[0]
    rise = held_height(experiment, second) - held_height(experiment, first)
    if given.offset is not None:
        if needs.wants == BY_BEARING and not any(given.offset) and rise == 0.0:
            yield Fault((*path, "offset"), "an offset of zeros has no direction", "give x, y other than 0")
        if len(given.offset) == 3 and abs(given.offset[2] - rise) > ROUNDED:
            message = f"'{second}' is held {rise:g} m above '{first}', not {given.offset[2]:g} m"
            yield Fault((*path, "offset", 2), message, "leave the third number out, or change hover")
    slope = given.bearing[2] if given.bearing is not None and len(given.bearing) == 3 else None
    if slope is not None and slope * rise <= 0.0 and not slope == rise == 0.0:
        message = f"'{second}' is held {rise:g} m above '{first}': this direction is never met"
        yield Fault((*path, "bearing", 2), message, "leave the third number out: a direction seen from above")


def _change(plan: Plan, number: int, change: ChangeTable) -> Iterator[Fault]:
    experiment, path = plan.experiment, ("formation", "changes", number)
    links = experiment.formation.link_tables
    yield from after_the_end((*path, "at_s"), "change", change.at_s, experiment.duration_s)
    before = {pair: link.kind for text, link in links.items() for pair in link_pairs(text)}
    for text, to in change.links.items():
        where = (*path, "links", text)
        new = to if isinstance(to, TargetTable) else TargetTable(distance=to)
        try:
            both = link_pairs(text)
        except ValueError as error:
            yield Fault(where, f"{text!r} is no link", str(error), on_key=True)
            continue
        if not set(both) <= set(before):
            message = f"{text!r} is none of the formation's links"
            yield Fault(where, message, did_you_mean(text, links), on_key=True)
        elif (old := before[both[0]]) != new.kind:
            message = f"{text!r} asks for a {old} before, and for a {new.kind} then: there is no way between them"
            yield Fault(where, message, f"give a {old}")
        else:
            yield from _asked(plan, text, new, where)
    if change.rotate and {*before.values()} == {"distance"}:
        message = "nothing here knows a direction: distances are met whichever way the formation faces"
        yield Fault((*path, "rotate"), message, "give links an offset or a bearing, and law a law that goes by them")
    for text, link in links.items() if change.scale != 1.0 else ():
        if link.bearing is not None and any(link.bearing[2:]):
            message = f"the slope of {text!r} changes when the formation grows and heights are held"
            yield Fault((*path, "scale"), message, "give that bearing as seen from above, without the third number")
