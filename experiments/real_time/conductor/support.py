"""What stands in for hardware in a run: the world, protocol twins for robots that ask for one, and who measures."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from agents.network import endpoints as topology
from agents.plugins import registry
from experiments.definition import bodies
from experiments.definition.experiment import Experiment, Robot
from experiments.definition.plan import Plan
from experiments.real_time.hosts.launcher import ROUTER, Launcher, Process, is_router

READY_S: Final = 15.0
POLL_S: Final = 0.02
VICON: Final = "vicon://"


class StandInError(RuntimeError):
    """A protocol twin or a positioning system that did not start, with what it said."""


@dataclass(frozen=True)
class StandIns:
    """What was started.

    Attributes:
        experiment: With the addresses at which robots are.
        names: Of the processes.
        positioning: The process that says where robots are, by name, and what starts it again; None: there is none.
    """

    experiment: Experiment
    names: tuple[str, ...]
    positioning: tuple[str, Callable[[], Process]] | None


def start(
    experiment: Experiment,
    file: Path,
    *,
    prefix: str,
    launcher: Launcher,
    connect: Sequence[str],
    interrupted: Callable[[], bool],
) -> StandIns:
    """Starts what the experiment asks for, and fills in at which address each robot is.

    Args:
        experiment: A case.
        file: The same as a file.
        prefix: Of the processes' names.
        launcher: Starts them.
        connect: `--connect` and its endpoints.
        interrupted: Asked while it waits.

    Raises:
        StandInError: If one does not start in time.
    """
    world = start_world(experiment, file, prefix=prefix, launcher=launcher, connect=connect)
    words = registry.names(registry.DEVICES)
    groups: dict[str, list[str]] = {}
    for name, robot in experiment.robots.items():
        if robot.body in words:
            groups.setdefault(robot.body, []).append(name)
    processes = {
        word: launcher.start(
            f"{prefix}-{word}",
            "experiments.real_time.processes.protocol_twins",
            str(file),
            *names,
            *connect,
            "--lifeline",
        )
        for word, names in groups.items()
    }
    addresses: dict[str, str] = {}
    for word, names in groups.items():
        wanted = _said(processes[word], r"^address (\w+) (\S+)$", len(names), interrupted)
        addresses.update(wanted)
    started = [process.name for process in processes.values()]
    if world is not None:
        _said(world, r"^(world) (ready)\b", 1, interrupted)
        started.append(world.name)
    robots = {
        name: msgspec.structs.replace(robot, body=addresses.get(name, robot.body))
        for name, robot in experiment.robots.items()
    }
    measuring, positioning = _positioning(
        experiment, robots, prefix=prefix, launcher=launcher, connect=connect, interrupted=interrupted
    )
    return StandIns(msgspec.structs.replace(experiment, robots=robots), (*started, *measuring), positioning)


def start_world(
    experiment: Experiment, file: Path, *, prefix: str, launcher: Launcher, connect: Sequence[str]
) -> Process | None:
    """Starts the world of an experiment, for the first time or again; None if no robot asks for one."""
    robots = experiment.robots.values()
    if not any(bodies.WORLD in (robot.body, robot.ranges) for robot in robots):
        return None
    return launcher.start(
        world_name(prefix), "experiments.real_time.processes.world", str(file), *connect, "--lifeline"
    )


def world_name(prefix: str) -> str:
    """What the process of the world is called."""
    return f"{prefix}-world"


def _positioning(
    experiment: Experiment,
    robots: dict[str, Robot],
    *,
    prefix: str,
    launcher: Launcher,
    connect: Sequence[str],
    interrupted: Callable[[], bool],
) -> tuple[list[str], tuple[str, Callable[[], Process]] | None]:
    """Who measures external positions: the names of the processes that were started for it; see `StandIns`."""
    measured = Plan(msgspec.structs.replace(experiment, robots=robots)).externally_measured
    if experiment.positioning is None or not measured:
        return [], None
    started = []
    network = [*connect, "--realm", experiment.network.realm, "--lifeline"]
    host = experiment.positioning.removeprefix(VICON)
    if experiment.positioning == bodies.VICON_TWIN:
        sigma = max(bodies.disturbance(experiment, name).position_sigma or 0.0 for name in measured)
        noise = ["--sigma", str(sigma), "--seed", str(experiment.seed)]
        arguments = ["--listen", "127.0.0.1:0", "--robots", *measured, *noise, *network]
        twin = launcher.start(f"{prefix}-{bodies.VICON_TWIN}", "twins.devices.vicon", *arguments)
        started.append(twin.name)
        host = _said(twin, r"^vicon (ready on) (\S+)$", 1, interrupted)["ready on"]
    maps = [part for name in measured for part in ("--map", f"{name}={name}")]
    bridge = partial(launcher.start, f"{prefix}-vicon", "bridges.vicon.publisher", host, *maps, *network)
    name = bridge().name
    return [*started, name], (name, bridge)


def _said(process: Process, pattern: str, count: int, interrupted: Callable[[], bool]) -> dict[str, str]:
    """Waits until a process has said so many lines of a form; the two groups of each."""
    deadline = time.monotonic() + READY_S
    while True:
        found = dict(re.findall(pattern, process.log.read_text(errors="replace"), re.MULTILINE))
        if len(found) >= count:
            return found
        if interrupted() or not process.alive or time.monotonic() > deadline:
            what = "was interrupted" if interrupted() else f"did not start ({process.exit})"
            raise StandInError(f"{process.name} {what}: {process.tail() or 'it said nothing'}")
        time.sleep(POLL_S)


LINGER_S: Final = 15.0  # the router outlives a killed conductor, so that the landing is recorded
STARTS: Final = 4  # who dies more often is not helped by starting it again


@dataclass
class _Servant:
    """What to start, and what becomes of the robots meanwhile, or when it is given up."""

    start: Callable[[], object]
    meanwhile: str = ": robots hold until then"
    given_up: str = ""
    starts: int = 1


class Servants:
    """Those of one case."""

    def __init__(
        self,
        experiment: Experiment,
        case: str,
        *,
        file: Path,
        endpoints: Sequence[str],
        routers: Sequence[str],
        rights: Path | None,
        launcher: Launcher,
    ) -> None:
        """The router and the world are started by others, for the first time; the centre by `start_centre`.

        Args:
            experiment: The case.
            case: Its name.
            file: The same as a file.
            endpoints: Routers as this machine reaches them.
            routers: Where routers of our own listen, which other machines must find again.
            rights: Who may do what, in a lab; None without one.
            launcher: Starts them.
        """
        connect = [part for endpoint in endpoints for part in ("--connect", endpoint)]
        self._centre = f"{case}-centre" if Plan(experiment).guided else None
        several = experiment.network.routers > 1
        self._known = {
            each.name: _Servant(
                partial(each.start, launcher, rights),
                ": all go on at another meanwhile" if several else "",
                ": no other takes its place" if several else ": the robots hold, and land at the end",
            )
            for each in divided(routers, experiment.network.routers)
        } | {
            world_name(case): _Servant(
                lambda: start_world(experiment, file, prefix=case, launcher=launcher, connect=connect)
            ),
        }
        if self._centre is not None:
            name = self._centre
            self._known[name] = _Servant(
                lambda: launcher.start(
                    name, "experiments.real_time.processes.centre", str(file), *connect, "--lifeline"
                ),
                given_up=": the robots that it guides hold, and land at the end",
            )

    def keep(self, name: str, start: Callable[[], object]) -> None:
        """Starts the process that says where robots are again as well: those who do not know hold, and drones land."""
        hold = ": robots that do not know where they are hold, drones land"
        self._known[name] = _Servant(start, hold, hold)

    def start_centre(self) -> tuple[str, ...]:
        """Starts the centre, if robots are guided by one; the name of its process."""
        if self._centre is None:
            return ()
        self._known[self._centre].start()
        return (self._centre,)

    def again(self, process: Process, case: str) -> tuple[str, str] | None:
        """Starts one again that has died; what kind it is, and what is to be said. None if it is no servant."""
        servant = self._known.get(process.name)
        if servant is None:
            return None
        kind = process.name.removeprefix(f"{case}-")
        more = servant.starts < STARTS
        if more:
            servant.starts += 1
            servant.start()
        what = f"started again{servant.meanwhile}" if more else f"given up{servant.given_up}"
        last = [] if is_router(process.name) else process.tail().strip().splitlines()[-1:]
        return kind, f"the {kind} ended ({process.exit}); {what}" + "".join(f": {line}" for line in last)


@dataclass(frozen=True)
class Router:
    """A router of our own.

    Attributes:
        name: Of its process.
        listen: Where it listens.
        link: The routers before it, which it seeks for as long as it lives, so that any two are linked once.
    """

    name: str
    listen: Sequence[str]
    link: Sequence[str] = ()

    def start(self, launcher: Launcher, rights: Path | None = None) -> None:
        """Starts it; it outlives a killed launcher by as long as robots take to land. In a lab it enforces `rights`."""
        listen = [part for endpoint in self.listen for part in ("--listen", endpoint)]
        link = [part for endpoint in self.link for part in ("--connect", endpoint)]
        enforced = [] if rights is None else ["--rights", str(rights)]
        launcher.start(
            self.name, "agents.runtime.router", *listen, *link, *enforced, "--lifeline", "--linger", str(LINGER_S)
        )


def start_router(launcher: Launcher, endpoints: Sequence[str], rights: Path | None = None) -> None:
    """Starts one router, which listens at all of these."""
    Router(ROUTER, endpoints).start(launcher, rights)


def divided(endpoints: Sequence[str], count: int) -> list[Router]:
    """So many routers, with these endpoints in turn."""
    made: list[Router] = []
    for number in range(count):
        link = [topology.from_here(before.listen[0]) for before in made]
        made.append(Router(f"{ROUTER}{number + 1}" if number else ROUTER, list(endpoints[number::count]), link))
    return made
