"""Support processes of a run: world, protocol twins, motion capture, routers, central controller; their restarts."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from agents.errors import ExplainedError
from agents.network import endpoints as topology
from agents.plugins import registry
from experiments.definition.access_rights import has_world
from experiments.definition.experiment import VICON_TWIN
from experiments.definition.plan import Plan
from experiments.real_time.conductor.case_context import CaseContext
from experiments.real_time.hosts.launcher import ROUTER, Launcher, Process, is_router

READY_S: Final = 15.0
POLL_S: Final = 0.02
VICON: Final = "vicon://"


class StandInError(ExplainedError):
    """A protocol twin or a positioning system that did not start, with its output."""


class RouterEnded(StandInError):
    """A router that ended instead of listening: its port was taken, or its lab cannot be used."""


def start_world(context: CaseContext) -> Process | None:
    """Start the world of an experiment, for the first time or again; None if no robot asks for one."""
    if not has_world(context.plan):
        return None
    return context.start("world", "experiments.real_time.processes.world", str(context.file))


def _announced(process: Process, pattern: str, count: int, interrupted: Callable[[], bool]) -> dict[str, str]:
    """Wait until a process has printed `count` lines of a form; returns the two groups of each."""
    deadline = time.monotonic() + READY_S
    while True:
        found = dict(re.findall(pattern, process.output, re.MULTILINE))
        if len(found) >= count:
            return found
        if interrupted() or not process.alive or time.monotonic() > deadline:
            what = "was interrupted" if interrupted() else f"did not start ({process.exit})"
            raise StandInError(f"{process.name} {what}: {process.tail() or 'no output'}")
        time.sleep(POLL_S)


def start_routers(launcher: Launcher, routers: Sequence[Router], rights: Path | None) -> None:
    """Start routers, and wait until they listen.

    Without that, robots would join a stranger's router where another run took the port at the same moment.

    Raises:
        RouterEnded: If one ends instead.
        StandInError: If one does not listen in time.
    """
    for process in [router.start(launcher, rights) for router in routers]:
        try:
            _announced(process, r"^(router) (ready)\b", 1, lambda: False)
        except StandInError as error:
            raise (error if process.alive else RouterEnded(str(error))) from None


LEAST_SIGMA: Final = 1e-5  # [m] noise of simulated motion capture: what repeats itself to the last bit is not believed
LINGER_S: Final = 15.0  # the router outlives a killed conductor, so that the landing is recorded
STARTS: Final = 4  # a process that dies more often is not helped by another start


@dataclass
class _Supervised:
    """Supervised process; texts for the robots' state meanwhile, and when it is given up."""

    start: Callable[[], object]
    meanwhile: str = ": robots hold meanwhile"
    given_up: str = ""
    starts: int = 1


class SupportProcesses:
    """Supervised processes of one case: routers, world, central controller, motion capture; and protocol twins."""

    standins: list[str]  # processes of protocol twins, world and motion capture

    def __init__(self, context: CaseContext) -> None:
        """Start nothing: routers are started by others."""
        self._context = context
        self.standins = []
        count = context.plan.experiment.network.routers
        self._known = {
            each.name: _Supervised(
                partial(each.start, context.launcher, context.rights),
                ": all go on at another meanwhile" if count > 1 else "",
                ": no other takes its place" if count > 1 else ": the robots hold, and land at the end",
            )
            for each in make_routers(context.hosts.routers, count)
        } | {context.process("world"): _Supervised(partial(start_world, context))}

    def supervise(self, start: Callable[[], Process], meanwhile: str, given_up: str) -> None:
        """Start a process of the case, and again when it dies."""
        self._known[start().name] = _Supervised(start, meanwhile, given_up)

    def start(self) -> Plan:
        """Start what the robots of the case need; return the case with the addresses of its robots.

        Raises StandInError if a protocol twin or a positioning system does not start in time.
        """
        context, experiment = self._context, self._context.plan.experiment
        world = start_world(context)
        words = registry.names(registry.DEVICES)
        groups: dict[str, list[str]] = {}
        for name, robot in experiment.robots.items():
            if robot.body in words:
                groups.setdefault(robot.body, []).append(name)
        module = "experiments.real_time.processes.protocol_twins"
        processes = {word: context.start(word, module, str(context.file), *names) for word, names in groups.items()}
        addresses: dict[str, str] = {}
        for word, names in groups.items():
            addresses |= _announced(processes[word], r"^address (\w+) (\S+)$", len(names), context.ended)
            self.standins.append(processes[word].name)
        if world is not None:
            _announced(world, r"^(world) (ready)\b", 1, context.ended)
            self.standins.append(world.name)
        robots = {
            name: msgspec.structs.replace(robot, body=addresses.get(name, robot.body))
            for name, robot in experiment.robots.items()
        }
        addressed = context.plan.changed(robots=robots)
        self._start_positioning(addressed)
        if context.plan.guided:
            centre = partial(context.start, "centre", "experiments.real_time.processes.centre", str(context.file))
            given_up = ": the robots that it guides hold, and land at the end"
            self._known[centre().name] = _Supervised(centre, given_up=given_up)
        return addressed

    def _start_positioning(self, plan: Plan) -> None:
        """Start the motion capture of the case; its robots have addresses."""
        context, experiment, measured = self._context, plan.experiment, plan.externally_measured
        if experiment.positioning is None or not measured:
            return
        realm = ["--realm", experiment.network.realm]
        host = experiment.positioning.removeprefix(VICON)
        if experiment.positioning == VICON_TWIN:
            asked = (plan.disturbance(name).position_sigma or 0.0 for name in measured)
            sigma = max(LEAST_SIGMA, *asked)
            noise = ["--sigma", str(sigma), "--seed", str(experiment.seed)]
            arguments = ["--listen", "127.0.0.1:0", *measured, *noise, *realm]
            twin = context.start(VICON_TWIN, "twins.devices.vicon", *arguments)
            self.standins.append(twin.name)
            host = _announced(twin, r"^vicon (ready on) (\S+)$", 1, context.ended)["ready on"]
        maps = [part for name in measured for part in ("--map", f"{name}={name}")]
        bridge = partial(context.start, "vicon", "bridges.vicon.publisher", host, *maps, *realm)
        self.standins.append(bridge().name)
        hold = ": robots without a position hold, drones land"
        self._known[self.standins[-1]] = _Supervised(bridge, hold, hold)

    def again(self, process: Process) -> tuple[str, str] | None:
        """Restart a process that has died; its role and the text of the event. None if it is not supervised."""
        servant = self._known.get(process.name)
        if servant is None:
            return None
        kind = process.name.removeprefix(self._context.process(""))
        more = servant.starts < STARTS
        if more:
            servant.starts += 1
            servant.start()
        what = f"started again{servant.meanwhile}" if more else f"given up{servant.given_up}"
        return kind, f"the {kind} ended ({process.exit}); {what}{'' if is_router(process.name) else process.because}"


@dataclass(frozen=True)
class Router:
    """Router of a run."""

    name: str  # of its process
    listen: Sequence[str]  # where it listens
    # routers before it, which it connects to for as long as it lives, so that any two are linked once
    link: Sequence[str] = ()

    def start(self, launcher: Launcher, rights: Path | None = None) -> Process:
        """Start the router; it outlives a killed launcher until robots have landed. In a lab it enforces `rights`."""
        listen = [part for endpoint in self.listen for part in ("--listen", endpoint)]
        link = [part for endpoint in self.link for part in ("--connect", endpoint)]
        enforced = [] if rights is None else ["--rights", str(rights)]
        return launcher.start(
            self.name, "agents.runtime.router", *listen, *link, *enforced, "--lifeline", "--linger", str(LINGER_S)
        )


def start_router(launcher: Launcher, endpoints: Sequence[str], rights: Path | None = None) -> None:
    Router(ROUTER, endpoints).start(launcher, rights)


def make_routers(endpoints: Sequence[str], count: int) -> list[Router]:
    """`count` routers, with these endpoints in turn."""
    made: list[Router] = []
    for number in range(count):
        link = [topology.from_here(before.listen[0]) for before in made]
        made.append(Router(f"{ROUTER}{number + 1}" if number else ROUTER, list(endpoints[number::count]), link))
    return made
