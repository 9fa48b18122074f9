"""World of one drone, and central controller of two wheeled robots, joined to an in-process network."""

from __future__ import annotations

import threading
from collections.abc import Callable
from math import inf

from agents.clock import uptime
from agents.network.keys import Keys
from agents.network.name_ownership import OwnershipCheck
from experiments.definition.experiment import Formation, RobotTable
from experiments.definition.plan import Plan
from experiments.real_time.processes.centre import CentreProcess
from experiments.real_time.processes.joining import Network
from experiments.real_time.processes.world import WorldProcess
from experiments.real_time.processes.world_population import WorldBodies
from tests.network import Net
from tests.small import pair

KEYS = Keys()
DRONE = RobotTable(kind="crazyflie", start=[0.1, 0.2], hover=0.5, body="world")


def joint(net: Net, ownership: OwnershipCheck | None = None) -> Network:
    """The `net` for a process; without an `ownership` a standstill of the machine asks for no check."""
    return Network(net.session, KEYS, [], [], ownership or OwnershipCheck([], lease_s=inf))


def world_plan(name: str = "F") -> Plan:
    return Plan(pair(robots={name: DRONE}, formation=Formation()))


def joined_world(
    net: Net, bodies: WorldBodies | None = None, ownership: OwnershipCheck | None = None,
    clock: Callable[[], float] = uptime, name: str = "F",
) -> WorldProcess:  # fmt: skip
    plan = world_plan(name)
    return WorldProcess(plan, bodies or WorldBodies(plan), joint(net, ownership), threading.Event(), clock)


def centre(net: Net, ownership: OwnershipCheck | None = None, clock: Callable[[], float] = uptime) -> CentreProcess:
    return CentreProcess(Plan(pair(architecture="centralised")), joint(net, ownership), clock=clock)
