"""Consistency of hosts, robots, network and channel."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from agents.network.channel_model import LinkEffects
from agents.network.endpoints import Endpoint
from agents.plugins import files, registry
from experiments.definition.experiment import Experiment, LinkChannelTable
from experiments.definition.link_conditions import link_effects
from experiments.definition.links import pairs_or_none
from experiments.definition.plan import Plan
from experiments.file.choices import chosen
from experiments.file.problems import Fault, Path, after_the_end, shown, unknown_robot

_SSH: Final = "write it like lab1, pi@192.0.2.7 or ssh://pi@192.0.2.7:2222; all else belongs in ~/.ssh/config"
_WORDS: Final = {  # parts of a host: what each is, and how to write it
    "address": ("address that ssh takes", _SSH),
    "zenpark": ("path of a command", "write it like zenpark/zenpark, without blanks or options"),
    "lab": ("path of a folder", "write it like zenpark-lab, without blanks"),
}


def host_faults(experiment: Experiment) -> Iterator[Fault]:
    """Faults of hosts: robots of two hosts or of none, processes that cannot be divided, endpoints that clash."""
    where: dict[str, str] = {}
    choices = chosen(experiment) if experiment.hosts else []
    if here := [files.plain(name) for _, name in choices if files.is_choice(name)]:
        message = f"'{here[0]}' is a file of this machine, which robots of other machines do not load"
        yield Fault(("hosts",), message, "make it a plug-in to install (docs/plugins.md), or leave [hosts] out")
    for host, each in experiment.hosts.items():
        for name, (what, hint) in _WORDS.items():
            value = getattr(each, name)
            if value is not None and not re.fullmatch(r"[^\s\x00-\x1f-][^\s\x00-\x1f]*", value):
                yield Fault(("hosts", host, name), f"{shown(value)} is no {what}", hint)
        for number, robot in enumerate(each.robots):
            path = ("hosts", host, "robots", number)
            if robot not in experiment.robots:
                yield from unknown_robot(path, robot, experiment.robots)
            elif robot in where:
                message = f"'{robot}' runs on '{where[robot]}' already"
                yield Fault(path, message, "name it once: a robot is one process on one machine")
            else:
                where[robot] = host
                body = experiment.robots[robot].body
                if body in registry.names(registry.DEVICES):
                    message = f"'{robot}' is behind a protocol twin ('{body}'), which runs on this machine alone"
                    yield Fault(path, message, "let it run here, or give it another body")
    yield from _processes(experiment, where)
    yield from _network(experiment)


def _processes(experiment: Experiment, where: dict[str, str]) -> Iterator[Fault]:
    """Robots of one process must be on one machine."""
    first: dict[str, str] = {}
    for name, robot in experiment.robots.items():
        if robot.process is None:
            continue
        other = first.setdefault(robot.process, name)
        if where.get(other) != where.get(name):
            message = f"'{name}' and '{other}' share the process '{robot.process}' but not the machine"
            hint = "name both in the same host, or give them processes of their own"
            yield Fault(("robots", name, "process"), message, hint)


def _network(experiment: Experiment) -> Iterator[Fault]:
    network = experiment.network
    if network.listen is not None and network.connect is not None:
        message = "`listen` is for the router that zenpark starts, `connect` for routers that run already"
        yield Fault(("network", "listen"), message, "leave one of them out", on_key=True)
    for name, endpoints in (("listen", network.listen), ("connect", network.connect)):
        if endpoints is not None and not endpoints:
            yield Fault(("network", name), f"`{name}` is empty", "leave it out, or give an endpoint")
        for number, endpoint in enumerate(endpoints or ()):
            yield from _endpoint(("network", name, number), endpoint)
    if network.topology == "mesh":
        yield from _mesh(experiment)
    elif network.addresses:
        hint = 'add topology = "mesh", or leave addresses out'
        yield Fault(("network", "addresses"), "`addresses` are where robots listen in a mesh", hint, on_key=True)
    if network.routers > 1 and network.connect is not None:
        message = "`routers` is the number that zenpark starts, and with `connect` it starts none"
        hint = "leave routers out; link the routers that you start: ./zenpark router --connect OTHER"
        yield Fault(("network", "routers"), message, hint, on_key=True)
    if network.listen and len(network.listen) % network.routers:
        message = f"{network.routers} routers cannot share {len(network.listen)} endpoints"
        yield Fault(("network", "routers"), message, "give each an endpoint of its own in listen, or leave listen out")
    if network.address is not None and network.listen is None:
        message = "`address` is where hosts find the endpoints of `listen`, and that is not given"
        hint = 'add listen = ["tls/0.0.0.0:7447"], or leave address out: hosts then use their ssh connection'
        yield Fault(("network", "address"), message, hint, on_key=True)


def _mesh(experiment: Experiment) -> Iterator[Fault]:
    """Faults of a mesh, which has no routers: robots on other machines need an address."""
    network = experiment.network
    for name, given in (("listen", network.listen), ("connect", network.connect), ("routers", network.routers > 1)):
        if given:
            message = f"a mesh has no routers, and `{name}` is about them"
            yield Fault(("network", name), message, "leave it out, or leave topology out", on_key=True)
    away = {robot: host for host, each in experiment.hosts.items() for robot in each.robots}
    for robot, host in away.items():
        if robot in experiment.robots and robot not in network.addresses:
            message = f"'{robot}' runs on '{host}', and its endpoint there is not given"
            hint = f'add addresses.{robot} = "tls/ADDRESS:PORT" to [network], with a lab; or leave topology out'
            yield Fault(("network", "topology"), message, hint)
    for robot, endpoint in network.addresses.items():
        path = ("network", "addresses", robot)
        yield from unknown_robot(path, robot, experiment.robots)
        yield from _endpoint(path, endpoint, one=True)


def _endpoint(path: Path, text: str, *, one: bool = False) -> Iterator[Fault]:
    """Faults of an endpoint; `one`: it stands for one address."""
    try:
        if Endpoint.parse(text).is_wildcard and one:
            yield Fault(path, "a wildcard is no address to connect", "give the one at which its neighbours find it")
    except ValueError as error:
        message, _, hint = str(error).partition("; ")
        yield Fault(path, message, hint)


FORM: Final = '"A > B" are poses from A to B, "A - B" both ways'
AT: Final = ("channel", "links")
ROUNDING: Final = 1e-9


def channel_faults(plan: Plan) -> Iterator[Fault]:
    """All contradictions in [channel]."""
    experiment, channel = plan.experiment, plan.experiment.channel
    yield from _bursts(channel, ("channel",), channel)
    linked = _pose_pairs(plan) if channel.links or any(outage.links for outage in channel.outages) else None
    given: dict[tuple[str, str], str] = {}
    for text, own in channel.links.items():
        path = (*AT, text)
        yield from _link(experiment, linked, text, path, on_key=True)
        yield from _bursts(link_effects(channel, own), path, own)
        for pair in pairs_or_none(text):
            if pair in given:
                message = f"the link {pair[1]} > {pair[0]} has its settings by '{given[pair]}' already"
                yield Fault(path, message, "keep one of the two", on_key=True)
                break
            given[pair] = text
    for number, outage in enumerate(channel.outages):
        where = ("channel", "outages", number)
        yield from after_the_end((*where, "from_s"), "outage", outage.from_s, experiment.duration_s)
        for k, text in enumerate(outage.links):
            yield from _link(experiment, linked, text, (*where, "links", k))
        for k, robot in enumerate(outage.robots):
            yield from unknown_robot((*where, "robots", k), robot, experiment.robots)


def _link(
    experiment: Experiment, linked: set[tuple[str, str]] | None, text: str, path: Path, *, on_key: bool = False
) -> Iterator[Fault]:
    """Faults of a text that names a link on which poses are sent; `linked` are all of those, if known."""
    both = pairs_or_none(text)
    if not both:
        yield Fault(path, f"{text!r} is no link", FORM, on_key=on_key)
        return
    names = dict.fromkeys(reversed(both[0]))
    for name in names:
        yield from unknown_robot(path, name, experiment.robots, on_key=on_key)
    if not names.keys() <= experiment.robots.keys():
        return
    absent = [pair for pair in both if linked is not None and pair not in linked]
    if absent:
        receiver, sender = absent[0]
        hint = f"leave it out, or add the link to [formation.links]; {FORM}"
        yield Fault(path, f"there is no link {sender} > {receiver}", hint, on_key=on_key)


def _pose_pairs(plan: Plan) -> set[tuple[str, str]] | None:
    """The (receiver, sender) pairs of all links, for formation and avoidance; None if other faults hide them."""
    try:
        names, links = plan.names, plan.pose_links
    except (ValueError, KeyError):
        return None
    return {(names[i], names[j]) for i, j in zip(links.receiver.tolist(), links.sender.tolist(), strict=True)}


def _bursts(held: LinkEffects, path: Path, own: LinkEffects | LinkChannelTable) -> Iterator[Fault]:
    """Faults of burst losses: `held` are the effects on a link, `own` those at this place of the file."""
    loss, burst = held.loss, held.burst
    if burst is None or (own.loss is None and own.burst is None):
        return
    at = (*path, "burst" if own.burst is not None else "loss")
    if loss == 0.0:
        if own.burst is not None:
            yield Fault(at, "burst shapes losses, and nothing is lost here", "give a loss too, or leave burst out")
    elif loss < 1.0 and burst * (1.0 - loss) < 1.0 - ROUNDING:
        least = 1.0 / (1.0 - loss)
        message = f"where {100 * loss:g} % is lost by chance, {least:.3g} are lost in a row on average, not {burst:g}"
        yield Fault(at, message, f"give a burst of at least {least:.3g}, or leave burst out: losses by chance")
