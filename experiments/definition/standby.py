"""Reserves: robots on standby, which `./zenpark robot add` lets join a run, and robots without an address."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TypeVar

import msgspec

from experiments.definition.experiment import Hybrid
from experiments.definition.links import link_pairs
from experiments.definition.plan import Plan

T = TypeVar("T")


def without_standby(plan: Plan, added: Collection[str] = ()) -> Plan:
    """Remove the robots on standby, but those `added`: none is in virtual time, or before `./zenpark robot add`."""
    experiment = plan.experiment
    robots = {name: robot for name, robot in experiment.robots.items() if not robot.standby or name in added}
    if len(robots) == len(experiment.robots):
        return plan
    formation, channel, architecture = experiment.formation, experiment.channel, experiment.architecture
    links = _links_between(formation.links, robots)
    changes = [
        msgspec.structs.replace(change, links={text: to for text, to in change.links.items() if text in links})
        for change in formation.changes
    ]
    outages = []
    for outage in channel.outages:
        between = list(_links_between(dict.fromkeys(outage.links), robots))
        cut_off = [name for name in outage.robots if name in robots]
        if between or cut_off or not (outage.links or outage.robots):  # one without names would mean all links
            outages.append(msgspec.structs.replace(outage, links=between, robots=cut_off))
    if isinstance(architecture, Hybrid):
        led = [name for name in architecture.robots if name in robots]
        hybrid = Hybrid(architecture.kind, led)
        architecture = "distributed" if not led else "centralised" if len(led) == len(robots) else hybrid
    return plan.changed(
        robots=robots,
        formation=msgspec.structs.replace(
            formation,
            leader=formation.leader if formation.leader in robots else None,
            links=links,
            anchors={name: anchor for name, anchor in formation.anchors.items() if name in robots},
            changes=changes,
        ),
        timeline=[leg for leg in experiment.timeline if leg.robot in robots],
        architecture=architecture,
        channel=msgspec.structs.replace(channel, links=_links_between(channel.links, robots), outages=outages),
        hosts={
            name: msgspec.structs.replace(host, robots=[robot for robot in host.robots if robot in robots])
            for name, host in experiment.hosts.items()
        },
    )


def _links_between(links: Mapping[str, T], robots: Collection[str]) -> dict[str, T]:
    """Links with both ends among `robots`."""
    return {text: to for text, to in links.items() if {*link_pairs(text)[0]} <= {*robots}}


def robots_without_address(plan: Plan) -> dict[str, str]:
    """Robots on hosts without an address, so that they are not started from here; robot to host."""
    hosts = plan.experiment.hosts.items()
    return {robot: name for name, host in hosts if host.address is None for robot in host.robots}
