"""The process of protocol twins: `python -m experiments.real_time.processes.protocol_twins FILE NAME ...`.

It replaces the hardware: of the experiment it uses only starts and disturbances. It prints the address of each robot,
and publishes true poses for recorder and simulated motion capture, never for robots.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Annotated

import msgspec
import zenoh

from agents.body.kinds import KINDS
from agents.clock import Clock, uptime
from agents.errors import did_you_mean
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import DEFAULT_ENDPOINT
from agents.network.keys import Keys
from agents.network.shutdown import Farewell, closing_cleanly, end
from agents.plugins import registry
from agents.runtime import command_line
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import Lifeline
from agents.ticks import Ticks
from experiments.definition import bodies
from experiments.definition.experiment import RobotTable
from experiments.definition.plan import Plan
from experiments.file import structure
from experiments.file.problems import refusal
from experiments.real_time.processes.joining import Launch
from twins.device import Device, DeviceRequest, Faults, serve_until_next


class TwinLaunch(Launch, frozen=True, kw_only=True):
    """Protocol twins of some robots."""

    names: Annotated[list[str], msgspec.Meta(title="ROBOT")]


def stand_in(launch: TwinLaunch) -> int:
    """Runs the protocol twins of robots with the same `body`; returns the exit code."""
    plan, endpoints = launch.read()
    experiment, names = plan.experiment, launch.names
    words = {experiment.robots[name].body if name in experiment.robots else "" for name in names}
    known = registry.names(registry.DEVICES)
    if len(words) != 1 or not words <= set(known):
        hint = f"their `body` must be one of {', '.join(known)}"
        raise refusal(launch.file, f"{', '.join(names)} cannot share a protocol twin", hint)
    request = DeviceRequest(bodies.body_request(plan, names, experiment.seed, endpoints), Faults())
    return _serve(words.pop(), request, plan, endpoints, lifeline=launch.lifeline)


def by_hand(
    kind: str,
    count: int,
    *,
    faults: str,
    device: str,
    connect: Sequence[str],
    tables: Sequence[str] = (),
    identity: str = "twin",
) -> int:
    """Runs `count` protocol twins of a kind of robot, in a row on the floor, without an experiment: `./zenpark twin`.

    `faults` and the settings of the `device` are JSON. `connect` are routers for true poses, and for twins that are
    reached by Zenoh; may be none. `tables` are the setting of this name, `identity` is the name in the certificate, in
    a lab.
    """
    settings = structure.parse_object("--device", device)
    if tables:
        settings["tables"] = list(tables)
    word = f"{kind}-twin"
    if word not in (known := registry.names(registry.DEVICES)):
        hint = did_you_mean(kind, [name.removesuffix("-twin") for name in known])
        raise refusal(f"zenpark twin {kind}", "there is no such protocol twin", hint)
    hover = 0.8 if KINDS[kind].flies else None
    robots = {
        f"{KINDS[kind].prefix}{k + 1:02}": RobotTable(
            kind=kind, start=[0.5 * k, 0.0], body=word, hover=hover, device=settings
        )
        for k in range(count)
    }
    plan = Plan.made(title=word, robots=robots, duration_s=1.0)
    endpoints = list(connect) or [DEFAULT_ENDPOINT]
    injected = msgspec.convert(structure.parse_object("--faults", faults, Faults), Faults)
    body = bodies.body_request(plan, plan.names, plan.experiment.seed, endpoints)
    request = DeviceRequest(body, injected, by_hand=True)
    return _serve(word, request, plan, connect, identity=identity)


def _serve(
    word: str,
    request: DeviceRequest,
    plan: Plan,
    connect: Sequence[str],
    *,
    lifeline: bool = False,
    identity: str = "twin",
) -> int:
    """Runs a device until a signal, or until its lifeline is lost and the robots are gone."""
    names, keys = request.body.names, Keys(plan.experiment.network.realm)
    over, lost = threading.Event(), threading.Event()
    if lifeline:
        Lifeline(lost).start()
    with on_termination(over.set), ExitStack() as stack:
        truths, ended = list[zenoh.Publisher](), lost.is_set
        if connect:
            opened = network.open_session(connect, name=word, stop=over, identity=identity)
            session, declared = stack.enter_context(closing_cleanly(opened))
            truths = [pubsub.publisher(session, keys.truth(name), messages.JSON) for name in names]
            farewell = Farewell(session, keys, names, lost)
            declared += [truths, farewell]
            ended = farewell.over
        device: Device = registry.load(registry.DEVICES, word)(request)
        stack.callback(device.close)
        for name, address in zip(names, device.addresses, strict=True):
            print(f"address {name} {address}", flush=True)
        ticks, clock = Ticks(plan.experiment.rates.body_hz, clock=uptime), Clock()
        while not (over.is_set() or ended()):
            now = serve_until_next(device, ticks)
            device.advance(now)
            position, yaw = (values.tolist() for values in device.truth())
            for name, publisher, where, toward in zip(names, truths, position, yaw, strict=False):
                truth = messages.position(name, clock.at(ticks.zero + now), where, toward)
                publisher.put(messages.encode(truth))
    return 0


if __name__ == "__main__":
    end(lambda: command_line.run("zenpark twin", TwinLaunch, stand_in, more=(OSError,)))
