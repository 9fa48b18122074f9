"""Robots in reserve: those on standby, which somebody may add to a run, and spares, which take over a name."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TypeVar

import msgspec

from agents import plugins
from experiments.experiment import Experiment, Hybrid
from experiments.links import pairs
from experiments.problem import Fault

T = TypeVar("T")


def faults(experiment: Experiment) -> Iterator[Fault]:
    """Reserves that nobody could call upon, or not one by one."""
    robots = experiment.robots
    for name, robot in robots.items():
        if robot.standby and robot.process is not None:
            message = f"'{name}' is on standby and shares the process '{robot.process}' with robots that may run"
            yield Fault(("robots", name, "process"), message, "give it a process of its own: leave `process` out")
    if all(robot.standby for robot in robots.values()):
        name = next(iter(robots))
        yield Fault(("robots", name, "standby"), "all robots are on standby", "let one or more take part")
    kinds = {robot.kind for robot in robots.values()}
    for name, spare in experiment.spares.items():
        path = ("spares", name)
        if name in robots:
            yield Fault(path, f"'{name}' is the name of a robot already", "rename one of them", on_key=True)
        if spare.kind not in kinds:
            hint = f"spares take over from robots of their kind: {', '.join(sorted(kinds))}"
            yield Fault((*path, "kind"), f"no robot is a {spare.kind}", hint)
        if spare.process is not None:
            yield Fault((*path, "process"), f"'{name}' begins in a process of its own", "leave `process` out")
        if spare.standby:
            yield Fault((*path, "standby"), "a spare always waits", "leave `standby` out")
        if plugins.body_name(spare.body) in plugins.names(plugins.DEVICES):
            message = f"'{name}' is behind a protocol twin ('{spare.body}'), which starts before the run only"
            yield Fault((*path, "body"), message, "give it the body twin, or a real one")
    if experiment.on_loss == "replace" and not experiment.spares:
        message = "who is lost is to be replaced, but there is no spare"
        yield Fault(("on_loss",), message, 'add [spares.NAME], or say on_loss = "restart"')


def taking_part(experiment: Experiment) -> Experiment:
    """The experiment without its robots on standby, as it runs while nobody adds them: in virtual time nobody can."""
    robots = {name: robot for name, robot in experiment.robots.items() if not robot.standby}
    if len(robots) == len(experiment.robots):
        return experiment
    formation, channel, who = experiment.formation, experiment.channel, experiment.architecture
    links = _between(formation.links, robots)
    changes = [
        msgspec.structs.replace(change, links={text: to for text, to in change.links.items() if text in links})
        for change in formation.changes
    ]
    outages = [
        msgspec.structs.replace(
            outage,
            links=list(_between(dict.fromkeys(outage.links), robots)),
            robots=[name for name in outage.robots if name in robots],
        )
        for outage in channel.outages
    ]
    outages = [  # one that names nobody any more would mean everybody
        short for short, whole in zip(outages, channel.outages, strict=True)
        if short.links or short.robots or not (whole.links or whole.robots)
    ]  # fmt: skip
    if isinstance(who, Hybrid):
        led = [name for name in who.robots if name in robots]
        who = "distributed" if not led else "centralised" if len(led) == len(robots) else Hybrid(who.kind, led)
    return msgspec.structs.replace(
        experiment,
        robots=robots,
        formation=msgspec.structs.replace(
            formation,
            leader=formation.leader if formation.leader in robots else None,
            links=links,
            anchors={name: anchor for name, anchor in formation.anchors.items() if name in robots},
            changes=changes,
        ),
        timeline=[leg for leg in experiment.timeline if leg.robot in robots],
        architecture=who,
        channel=msgspec.structs.replace(channel, links=_between(channel.links, robots), outages=outages),
        hosts={
            name: msgspec.structs.replace(host, robots=[robot for robot in host.robots if robot in robots])
            for name, host in experiment.hosts.items()
        },
    )


def _between(links: Mapping[str, T], robots: Collection[str]) -> dict[str, T]:
    """Those of the links whose ends are both among `robots`."""
    return {text: to for text, to in links.items() if {*pairs(text)[0]} <= {*robots}}
