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

from agents import plugins
from experiments import assign
from experiments.experiment import Experiment, Robot
from experiments.launcher import Launcher, Process

READY_S: Final = 15.0
POLL_S: Final = 0.02
VICON: Final = "vicon://"

# what `--bodies protocol` makes of each kind: its protocol twin, the process that its robots share (several Crazyflies
# hang on one radio, all Tellos of a computer on one port), and who knows where it is
PROTOCOL: Final[dict[str, tuple[str, str | None, str]]] = {
    "crazyflie": ("crazyflie-twin", "radio0", "body"),
    "tello": ("tello-twin", "tellos", "external"),
    "khepera4": ("khepera4-twin", None, "external"),
    "turtlebot3": ("turtlebot3-twin", None, "external"),
}

BODIES: Final = ("twin", "world", "protocol")  # what `--bodies` takes


class StandInError(RuntimeError):
    """A protocol twin or a positioning system that did not start, with what it said."""


def choose_bodies(experiment: Experiment, bodies: str | None) -> Experiment:
    """The experiment with every robot in the body that `--bodies` names; as it is without.

    Args:
        experiment: A case.
        bodies: One of `BODIES`, or None.
    """
    if bodies is None:
        return experiment
    if bodies == "protocol":
        return behind_protocols(experiment)
    seen = bodies == assign.WORLD and experiment.positioning == assign.VICON_TWIN
    robots = {
        name: msgspec.structs.replace(
            robot, body=bodies, position=robot.position if seen else "body", ranges="body", device={}
        )
        for name, robot in experiment.robots.items()
    }
    return msgspec.structs.replace(experiment, robots=robots)


def behind_protocols(experiment: Experiment) -> Experiment:
    """The experiment with every robot behind its real bridge and a protocol twin, and simulated motion capture."""
    robots = {}
    for name, robot in experiment.robots.items():
        body, process, position = PROTOCOL[robot.kind]
        robots[name] = msgspec.structs.replace(robot, body=body, process=process, position=position)
    return msgspec.structs.replace(experiment, robots=robots, positioning=assign.VICON_TWIN)


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
    words = plugins.names(plugins.DEVICES)
    groups: dict[str, list[str]] = {}
    for name, robot in experiment.robots.items():
        if robot.body in words:
            groups.setdefault(robot.body, []).append(name)
    processes = {
        word: launcher.start(f"{prefix}-{word}", "experiments.device", str(file), *names, *connect, "--lifeline")
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
    if not any(assign.WORLD in (robot.body, robot.ranges) for robot in robots):
        return None
    return launcher.start(world_name(prefix), "experiments.world", str(file), *connect, "--lifeline")


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
    measured = assign.measured(msgspec.structs.replace(experiment, robots=robots))
    if experiment.positioning is None or not measured:
        return [], None
    started = []
    network = [*connect, "--realm", experiment.network.realm, "--lifeline"]
    host = experiment.positioning.removeprefix(VICON)
    if experiment.positioning == assign.VICON_TWIN:
        sigma = max(assign.disturbance(experiment, name).position_sigma or 0.0 for name in measured)
        noise = ["--sigma", str(sigma), "--seed", str(experiment.seed)]
        arguments = ["--listen", "127.0.0.1:0", "--robots", *measured, *noise, *network]
        twin = launcher.start(f"{prefix}-{assign.VICON_TWIN}", "twins.vicon", *arguments)
        started.append(twin.name)
        host = _said(twin, r"^vicon (ready on) (\S+)$", 1, interrupted)["ready on"]
    maps = [part for name in measured for part in ("--map", f"{name}={name}")]
    bridge = partial(launcher.start, f"{prefix}-vicon", "bridges.vicon", host, *maps, *network)
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
