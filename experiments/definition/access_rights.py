"""Access rights in an experiment: the table from which the routers of a lab get their access control.

A robot publishes below its own name and receives the poses of its neighbours, those included that only avoidance needs.
Robots that share a process share one session, so that each of their certificates holds for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import reduce
from typing import Any, Final

from agents.body.kinds import KINDS
from agents.network.access_control import Grant, Rights
from agents.network.keys import Keys
from agents.plugins import registry
from experiments.definition.experiment import WORLD, RobotTable
from experiments.definition.plan import Plan

REMOTE_BODIES: Final = ("external", WORLD)  # bodies with poses from the process that carries them
# senders from which on the right is "*", if they are all robots: a router reads N² keys for minutes
MANY_SENDERS: Final = 16


def rights(cases: Iterable[Plan]) -> Rights:
    """Rights of all processes in the cases of an experiment, which share a router.

    Raises LabError if the cases are in different realms.
    """
    return reduce(Rights.joined, map(_rights, cases))


def needed_identities(plan: Plan, operator: str = "operator") -> list[str]:
    """Identities with certificates that a run needs on the machine that starts it."""
    experiment = plan.experiment
    robots = experiment.robots.values()
    abroad = {robot for host in experiment.hosts.values() for robot in host.robots}
    twins = any(robot.body in registry.names(registry.DEVICES) for robot in robots)
    services = {
        "world": has_world(plan),
        "twin": twins or bool(experiment.capture and experiment.capture.simulated),
        "positioning": experiment.positioning is not None,
        "centre": bool(plan.guided),
    }
    here = [name for name in experiment.robots if name not in abroad]
    return ["router", operator, "recorder", *here, *(name for name, needed in services.items() if needed)]


def has_world(plan: Plan) -> bool:
    """Whether a run in real time needs the process of the world."""
    return any(WORLD in (robot.body, robot.ranges) for robot in plan.experiment.robots.values())


def _rights(plan: Plan) -> Rights:
    experiment, senders = plan.experiment, senders_by_receiver(plan)
    guided = plan.guided
    keys = Keys(experiment.network.realm)
    robots: dict[str, Grant] = {}
    for group in experiment.processes.values():
        others = sorted({sender for name in group for sender in senders[name]})
        if len(others) >= MANY_SENDERS and {*others, *group} == set(experiment.robots):
            others = ["*"]
        led = [name for name in group if name in guided]
        centre = [keys.lives(keys.centre_alive)] if led else []
        inputs = [*_key_per_name(group, keys.position, keys.ranges), *map(keys.goal, led)]
        own = [keys.below(name) for name in group]
        foreign, tokens = _ros_keys(group, plan)
        grant = Grant(
            publish=[*own, *foreign],
            subscribe=[*inputs, *map(keys.pose, others), keys.estop, keys.experiment, *foreign],
            answer=own,
            queried=[keys.pose("*"), keys.order("*")],
            tokens=[*(key for name in group for key in keys.owner_tokens(keys.alive(name))), *tokens],
            watch=[*own, *(keys.lives(keys.alive(other)) for other in others), keys.conductor, *centre, *tokens],
        )
        robots |= dict.fromkeys(group, grant)
    network = experiment.network
    linked = network.routers > 1 or len(network.connect or ()) > 1
    return Rights(keys.realm, robots, _roles(plan, keys), linked)


def _roles(plan: Plan, keys: Keys) -> dict[str, Grant]:
    names = plan.experiment.robots
    far = [name for name, robot in names.items() if robot.body in REMOTE_BODIES]
    ranged = [name for name, robot in names.items() if robot.body in REMOTE_BODIES or robot.ranges == WORLD]
    ranges = _key_per_name(ranged, keys.ranges)
    located = plan.externally_measured
    twins = [name for name, robot in names.items() if robot.body in registry.names(registry.DEVICES)]
    measured = sorted({*located, *twins})
    goals = _key_per_name(plan.guided, keys.goal)
    foreign, tokens = _ros_keys(names, plan)
    everything = [keys.everything]
    observer = Grant(subscribe=everything, query=[keys.pose("*")], watch=everything)
    return {
        "observer": observer,
        "recorder": Grant(publish=[keys.scene], subscribe=everything, watch=everything, tokens=[keys.recorder]),
        "operator": Grant(
            publish=[keys.estop, keys.below("run")],
            subscribe=everything,
            query=[keys.order("*"), keys.world_order, keys.run_order, *observer.query],
            answer=[keys.run_order],
            tokens=[keys.below("run")],
            watch=everything,
        ),
        "world": Grant(
            publish=[keys.below("world"), *_key_per_name(far, keys.position, keys.truth), *ranges],
            subscribe=[keys.setpoint("*"), keys.status("*"), keys.state("*"), keys.estop],
            answer=[keys.world_order],
            tokens=[keys.below("world")],
            watch=[keys.lives(keys.alive("*")), keys.below("world")],
        ),
        "positioning": Grant(publish=_key_per_name(located, keys.position), watch=_key_per_name(measured, keys.alive)),
        "twin": Grant(
            publish=[*_key_per_name(twins, keys.truth), *foreign],
            subscribe=[*_key_per_name(measured, keys.truth), *foreign],
            tokens=tokens,
            watch=[*_key_per_name(measured, keys.alive), *tokens],
        ),
        "centre": Grant(
            publish=[keys.centre, *goals, *_key_per_name(plan.guided, keys.memory)],
            subscribe=[keys.pose("*"), keys.status("*")],
            tokens=[keys.lives(keys.centre_alive)],
            watch=[keys.lives(keys.alive("*")), keys.lives(keys.centre_alive)],
        ),
        "ros2": Grant(
            publish=[*goals, *foreign],
            subscribe=[keys.state("*"), keys.ranges("*"), keys.status("*"), keys.scene, *foreign],
            tokens=tokens,
            watch=[keys.alive("*"), keys.centre_alive, *tokens],
        ),
    }


def _key_per_name(names: Iterable[str], *of: Callable[[str], str]) -> list[str]:
    return [key(name) for name in names for key in of]


def senders_by_receiver(plan: Plan) -> dict[str, set[str]]:
    """Senders of each robot: the poses to which its process subscribes."""
    links = plan.pose_links
    found: dict[str, set[str]] = {name: set() for name in plan.names}
    for receiver, sender in zip(links.receiver.tolist(), links.sender.tolist(), strict=True):
        found[plan.names[receiver]].add(plan.names[sender])
    return found


def _ros(name: str, robot: RobotTable) -> Any:  # noqa: ANN401 - of the protocol of its kind
    """Address of a robot in ROS 2 on the experiment's own routers; None if it is not there."""
    kind, body = KINDS[robot.kind], registry.body_name(robot.body)
    twin = "" if kind.twin is None else kind.twin.body
    if not kind.ros_address or body not in (*kind.bodies, twin):
        return None
    address = registry.find(kind.ros_address, f"ROS 2 of the kind {kind.name}")
    return address(name, robot.body, robot.device, of_twin=body == twin)


def _ros_keys(names: Iterable[str], plan: Plan) -> tuple[list[str], list[str]]:
    """Keys outside the realm on which robots of ROS 2 send and receive, and their liveliness tokens."""
    addresses = [_ros(name, plan.experiment.robots[name]) for name in names]
    keys, tokens = set(), set()
    for address in filter(None, addresses):
        below, rmw = f"{address.namespace}/**" if address.namespace else "*", address.style == "rmw"
        keys.add(f"{address.domain}/{below}" if rmw else below)
        tokens.add(f"@ros2_lv/{address.domain}/**" if rmw else "@/*/@ros2_lv/**")
    return sorted(keys), sorted(tokens)
