"""Do hosts, robots and network go together."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from agents import plugins
from agents.endpoint import Endpoint
from agents.plugins import did_you_mean
from experiments.experiment import Experiment
from experiments.problem import Fault, shown

_WHAT: Final = {"address": "address that ssh takes", "zenpark": "path of a command", "lab": "path of a folder"}
_WRITE: Final = {
    "address": "write it like lab1, pi@192.0.2.7 or ssh://pi@192.0.2.7:2222; all else belongs in ~/.ssh/config",
    "zenpark": "write it like zenpark/zenpark, without blanks or options",
    "lab": "write it like zenpark-lab, without blanks",
}


def faults(experiment: Experiment) -> Iterator[Fault]:
    """Robots that nobody or two hosts have, processes and bodies that cannot be divided, endpoints that clash."""
    where: dict[str, str] = {}
    for host, each in experiment.hosts.items():
        for name, value in (("address", each.address), ("zenpark", each.zenpark), ("lab", each.lab)):
            if value is not None and not re.fullmatch(r"[^\s\x00-\x1f-][^\s\x00-\x1f]*", value):
                message = f"{shown(value)} is no {_WHAT[name]}"
                yield Fault(("hosts", host, name), message, _WRITE[name])
        for number, robot in enumerate(each.robots):
            path = ("hosts", host, "robots", number)
            if robot not in experiment.robots:
                yield Fault(path, f"no robot is called '{robot}'", did_you_mean(robot, experiment.robots))
            elif robot in where:
                message = f"'{robot}' runs on '{where[robot]}' already"
                yield Fault(path, message, "name it once: a robot is one process on one machine")
            else:
                where[robot] = host
                yield from _body(experiment, host, number)
    yield from _processes(experiment, where)
    yield from _network(experiment)


def _body(experiment: Experiment, host: str, number: int) -> Iterator[Fault]:
    robot = experiment.hosts[host].robots[number]
    body = experiment.robots[robot].body
    if body in plugins.names(plugins.DEVICES):
        message = f"'{robot}' is behind a protocol twin ('{body}'), which runs on this machine and cannot be seen there"
        yield Fault(("hosts", host, "robots", number), message, "let it run here, or give it another body")


def _processes(experiment: Experiment, where: dict[str, str]) -> Iterator[Fault]:
    """A process is on one machine, and so are all of its robots."""
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
            try:
                Endpoint.parse(endpoint)
            except ValueError as error:
                message, _, hint = str(error).partition("; ")
                yield Fault(("network", name, number), message, hint)
    if network.address is not None and network.listen is None:
        message = "`address` says where hosts find what `listen` listens on, and that is not given"
        hint = 'add listen = ["tls/0.0.0.0:7447"], or leave address out: hosts then use their ssh connection'
        yield Fault(("network", "address"), message, hint, on_key=True)
