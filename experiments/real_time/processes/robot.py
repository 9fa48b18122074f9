"""The process of robots: `python -m experiments.real_time.processes.robot FILE NAME ...`; light to start.

`./zenpark agent` is the same for people; launchers start this, which imports no typer.
"""

from __future__ import annotations

import sys

from agents.errors import did_you_mean

if __name__ == "__main__":
    # OpenSSL is 3.5 MB in each robot; without it hashlib has the same functions of its own (numpy.random asks for them)
    sys.modules["_hashlib"] = None  # type: ignore[assignment]

import os
import socket
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Annotated, Final

import msgspec

from agents.body.device_locks import Claims
from agents.body.fleet import assemble
from agents.body.shadow_twin import shadowed
from agents.clock import Clock
from agents.network import session as network
from agents.network.channel_model import Conditions
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.network.lab import secured
from agents.network.shutdown import end
from agents.plugins import registry
from agents.runtime import command_line, lifeline
from agents.runtime.loop import Runtime, Setup
from experiments.definition import bodies, mesh
from experiments.definition.endpoints import router_endpoints
from experiments.definition.link_conditions import FROM_CENTRE, Ends, conditions_of
from experiments.definition.plan import Plan
from experiments.file import document
from experiments.file.document import chosen_case
from experiments.file.problems import refusal
from experiments.real_time.processes import joining
from experiments.real_time.processes.joining import Launch

STDIN: Final = "-"
JOIN: Final = "join"
REMOTE_BODIES: Final = ("external", "world")  # bodies in another process, with their range sensors
EXPERIMENT_S: Final = 15.0  # how long an experiment may take to arrive on standard input


class RobotLaunch(Launch, frozen=True, kw_only=True, rename="kebab"):
    """Robots of an experiment in one process.

    FILE is "-" for the first line of standard input, as JSON, or "join" for the next run.
    """

    names: Annotated[list[str], msgspec.Meta(title="ROBOT")]
    clock_correction: Annotated[float, msgspec.Meta(title="SECONDS", description="added to the clock")] = 0.0
    realm: Annotated[str, msgspec.Meta(description="in which to join")] = "park"
    once: Annotated[bool, msgspec.Meta(description="end when down after the experiment")] = False


def fly(launch: RobotLaunch) -> int:
    """Runs robots of an experiment in this process; returns its exit code."""
    file, names = launch.file, launch.names
    command_line.detach()
    with ExitStack() as stack:
        endpoints: Sequence[str] = launch.connect
        if file == JOIN:
            endpoints = secured(launch.connect, launch.lab) or [DEFAULT_ENDPOINT]
            session = stack.enter_context(network.open_session(endpoints, name=f"{names[0]} joins", identity=names[0]))
            keys = Keys(launch.realm)
            read = joining.wait_for_experiment(session, keys, names)
            stack.callback(joining.ConductorWatch(session, keys).close)
        elif file == STDIN:
            print(f"{', '.join(names)}: on {socket.gethostname()}, process {os.getpid()}", flush=True)
            read = document.received(read_experiment(), "standard input")
        else:
            read = document.read(file)
        plan = chosen_case(read, launch.case)
        strangers = [name for name in names if name not in plan.names]
        if strangers:
            hint = did_you_mean(strangers[0], plan.names)
            raise refusal(file, f"no robot '{strangers[0]}' in this experiment", hint)
        endpoints = router_endpoints(plan, read.path, endpoints, launch.lab) or [DEFAULT_ENDPOINT]
        return _run(plan, launch, endpoints)


def _run(plan: Plan, launch: RobotLaunch, endpoints: Sequence[str]) -> int:
    experiment, names = plan.experiment, launch.names
    clock = Clock(launch.clock_correction)
    endpoints = mesh.neighbour_endpoints(plan, names, endpoints)
    request = replace(bodies.body_request(plan, names, experiment.seed, endpoints), clock=clock)
    body = shadowed(assemble(request), request, bodies.shadow_periods(plan, names))
    assignments, robots = [plan.assignment(name) for name in names], [experiment.robots[name] for name in names]
    setup = Setup(
        keys=Keys(experiment.network.realm),
        endpoints=endpoints,
        encoding=experiment.network.encoding,
        state_hz=experiment.rates.state_hz,
        lifeline=launch.lifeline,
        lifeline_s=lifeline.FAR_SILENCE_S if launch.file == STDIN else lifeline.SILENCE_S,
        externally_measured=[robot.position == "external" for robot in robots],
        exact=[name not in plan.externally_measured for name in names],
        # bodies in other processes receive their range readings by themselves
        ranging=["remote" if registry.body_name(robot.body) in REMOTE_BODIES else robot.ranges for robot in robots],
        conditions=[
            _conditions(plan, [(link.name, name) for link in each.neighbours])
            for name, each in zip(names, assignments, strict=True)
        ],
        goal_conditions=_conditions(plan, [(name, name) for name in names], FROM_CENTRE),
        clock=clock,
        once=launch.once,
        rights=mesh.member_rights(plan, endpoints),
        loop_timeout_s=experiment.safety.loop_timeout_s,
        wake=plan.wakes,
        claims=Claims.of(request),
    )
    return Runtime(assignments, body, setup).run()


def _conditions(plan: Plan, ends: Ends, stream: str = "") -> list[Conditions]:
    """Conditions of links of this process, on a network with a delay of its own."""
    return conditions_of(plan, ends, plan.experiment.seed, stream=stream, real=True)


def read_experiment() -> str:
    """The first line of standard input; the following ones belong to the lifeline."""
    deadline = time.monotonic() + EXPERIMENT_S
    source, text = lifeline.LifelineEnd(), b""
    while source.wait(max(0.0, deadline - time.monotonic())):
        data = source.read()
        line, end, _ = data.partition(b"\n")
        text += line
        if end:
            return text.decode(errors="replace")
        if not data:
            break
    hint = "a robot with FILE - reads the experiment there, as JSON in one line"
    raise refusal("standard input", f"no experiment came within {EXPERIMENT_S:g} s", hint)


def main(arguments: Sequence[str] | None = None) -> int:
    return command_line.run("zenpark agent", RobotLaunch, fly, arguments)


if __name__ == "__main__":
    end(main)
