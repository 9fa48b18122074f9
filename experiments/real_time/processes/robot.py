"""A robot's process: `python -m experiments.real_time.processes.robot FILE NAME ...`. Light to start, for an experiment
starts many.

`zenpark agent` is the same for people; launchers start this, which needs neither typer nor what typer needs.
"""

from __future__ import annotations

import sys

if __name__ == "__main__":
    # OpenSSL is 3.5 MB in each robot; without it hashlib has the same functions of its own (numpy.random asks for them)
    sys.modules["_hashlib"] = None  # type: ignore[assignment]

import argparse
import os
import select
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Final

from agents.body.fleet import assemble
from agents.body.interface import BodyError
from agents.body.shadow_twin import shadowed
from agents.clock import Clock
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT, EndpointError
from agents.network.keys import Keys
from agents.network.lab import LabError
from agents.network.name_ownership import NameTaken
from agents.network.session import Unreachable
from agents.network.shutdown import end
from agents.plugins import registry
from agents.runtime import command_line
from agents.runtime.loop import Runtime
from agents.runtime.setup import Ranging, Setup
from experiments.definition import bodies, link_conditions, mesh
from experiments.definition.endpoints import routers
from experiments.definition.experiment import Experiment, Robot
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import chosen_case
from experiments.file.problems import DocumentError, Problem
from experiments.real_time.processes import joining

STDIN: Final = "-"
JOIN: Final = "join"
FAR: Final = ("external", "world")  # bodies that live in another process, their range sensors too


TOLD_S: Final = 15.0  # how long an experiment may take to come over standard input


def fly(
    file: str,
    names: Sequence[str],
    *,
    case: str | None,
    connect: Sequence[str],
    lifeline: bool,
    clock_correction_s: float = 0.0,
    once: bool = False,
    realm: str = "park",
    lab: str | None = None,
) -> int:
    """Runs the robots `names` of an experiment in this process; returns its exit code.

    Args:
        file: The experiment; "-" for the first line of standard input, as JSON; "join" for what is run next.
        names: Of the robots.
        case: Of the file; the first if left out.
        connect: Routers; the file's, or the one of this machine, if left out.
        lifeline: Whether standard input is a lifeline.
        clock_correction_s: What is added to this machine's clock to get that of the experiment [s].
        once: Whether to end when the robots are down after the experiment.
        realm: In which to join.

    Raises:
        DocumentError: If the file is wrong, or has no such robot or case.
        BodyError, UnknownPlugin: If a body cannot be had.
        Unreachable: If no router answers.
    """
    if lifeline:
        command_line.detach()
    with ExitStack() as stack:
        endpoints = list(connect)
        if file == JOIN:
            endpoints = joining.reached(connect or [DEFAULT_ENDPOINT], lab)
            session = stack.enter_context(network.open_session(endpoints, name=f"{names[0]} joins", identity=names[0]))
            read = joining.offered(session, Keys(realm), names)
            stack.callback(joining.ConductorWatch(session, Keys(realm)).close)
        elif file == STDIN:
            print(f"{', '.join(names)}: on {socket.gethostname()}, process {os.getpid()}", flush=True)
            read = document.received(told(), "standard input")
        else:
            read = document.read(file)
        experiment = chosen_case(read, case)
        unknown = [name for name in names if name not in experiment.robots]
        if unknown:
            hint = registry.did_you_mean(unknown[0], experiment.robots)
            raise DocumentError([Problem(file, 0, 0, f"no robot '{unknown[0]}' in this experiment", hint)])
        endpoints = routers(experiment, read.path, endpoints, lab) or [DEFAULT_ENDPOINT]
        return _run(experiment, names, endpoints, lifeline=lifeline, clock=Clock(clock_correction_s), once=once)


def _run(
    experiment: Experiment,
    names: Sequence[str],
    endpoints: Sequence[str],
    *,
    lifeline: bool,
    clock: Clock,
    once: bool,
) -> int:
    """Runs robots of a case until they end."""
    endpoints = mesh.near(experiment, names, endpoints)
    request = replace(bodies.request(experiment, names, [experiment.seed], endpoints), clock=clock)
    body = shadowed(assemble(request), request, bodies.shadows(experiment, names))
    assignment = Plan(experiment).assignment(names)
    setup = Setup(
        keys=Keys(experiment.network.realm),
        endpoints=endpoints,
        encoding=experiment.network.encoding,
        state_hz=experiment.rates.state_hz,
        lifeline=lifeline,
        located=[experiment.robots[name].position == "external" for name in names],
        ranging=[_ranging(experiment.robots[name]) for name in names],
        conditions=link_conditions.at_listeners(experiment, assignment.links, names),
        goal_conditions=link_conditions.from_centre(experiment, names),
        clock=clock,
        once=once,
        rights=mesh.rights(experiment, endpoints),
        loop_silence_s=experiment.safety.loop_silence_s,
    )
    return Runtime(assignment, body, setup).run()


def told(fd: int = 0, limit_s: float = TOLD_S) -> str:
    """The first line that comes in on a descriptor; what follows is the lifeline's.

    Raises:
        DocumentError: If none comes in time.
    """
    deadline = time.monotonic() + limit_s
    waiting = select.poll()
    waiting.register(fd, select.POLLIN)
    text = b""
    while waiting.poll(max(0.0, deadline - time.monotonic()) * 1e3):
        data = os.read(fd, 65536)
        line, end, _ = data.partition(b"\n")
        text += line
        if end:
            return text.decode(errors="replace")
        if not data:
            break
    hint = "whoever starts a robot with FILE - writes the experiment there, as JSON in one line"
    raise DocumentError([Problem("standard input", 0, 0, f"no experiment came within {limit_s:g} s", hint)])


def _ranging(robot: Robot) -> Ranging:
    """Where a robot's range readings come from: bodies in other processes hear them by themselves."""
    if registry.body_name(robot.body) in FAR:
        return "far"
    return robot.ranges


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of the process."""
    parser = argparse.ArgumentParser(prog="zenpark agent", description="Robots of an experiment in one process.")
    parser.add_argument("file", help="experiment file, or name in the catalogue; join: what is run next")
    parser.add_argument("names", nargs="+", metavar="ROBOT")
    parser.add_argument("--case", help="which case of the file; the first if left out")
    parser.add_argument("--connect", action="append", metavar="ENDPOINT", default=[], help="router")
    parser.add_argument("--lab", metavar="FOLDER", help="certificates; the file's if left out")
    parser.add_argument("--lifeline", action="store_true", help="land and end when standard input ends or is silent")
    parser.add_argument("--clock-correction", type=float, default=0.0, metavar="SECONDS", help="added to the clock")
    parser.add_argument("--realm", default="park", help="in which to join")
    parser.add_argument("--once", action="store_true", help="end when down after the experiment")
    chosen = parser.parse_args(arguments)
    try:
        return fly(
            chosen.file,
            chosen.names,
            case=chosen.case,
            connect=chosen.connect,
            lifeline=chosen.lifeline,
            clock_correction_s=chosen.clock_correction,
            once=chosen.once,
            realm=chosen.realm,
            lab=chosen.lab,
        )
    except (DocumentError, BodyError, NameTaken, registry.PluginError, EndpointError, LabError, Unreachable) as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    end(main())
