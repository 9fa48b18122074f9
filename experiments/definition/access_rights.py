"""Access rights in an experiment: the table from which the routers of a lab get their access control.

A robot publishes below its own name and receives the poses of its neighbours, those included that only avoidance needs.
Robots that share a process share one session, so that each of their certificates holds for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import reduce
from typing import Final

from agents.body.interface import settings
from agents.network.access_control import ADMIN, Grant, Rights
from agents.network.keys import Keys
from agents.plugins import registry
from agents.protocols import turtlebot3
from experiments.definition import bodies
from experiments.definition.bodies import VICON_TWIN
from experiments.definition.experiment import Experiment, Robot
from experiments.definition.plan import Plan

FAR: Final = ("external", bodies.WORLD)  # bodies whose poses come from the process that carries them
MANY: Final = (
    16  # from so many senders on, if they are all robots, the right is "*": a router reads N² keys for minutes
)
ROS: Final = ("ros2dds", "rmw")
ROS_TWIN: Final = "turtlebot3-twin"


def rights(cases: Iterable[Experiment]) -> Rights:
    """Rights of all processes in the cases of an experiment, which share a router.

    Raises:
        LabError: If the cases are in different realms.
    """
    return reduce(Rights.joined, map(_rights, cases))


def needed_identities(experiment: Experiment, operator: str = "operator") -> list[str]:
    """Identities whose certificates a run needs on the machine that starts it."""
    robots = experiment.robots.values()
    abroad = {robot for host in experiment.hosts.values() for robot in host.robots}
    found = ["router", operator, "recorder", *(name for name in experiment.robots if name not in abroad)]
    if any(bodies.WORLD in (robot.body, robot.ranges) for robot in robots):
        found.append("world")
    if any(robot.body in registry.names(registry.DEVICES) for robot in robots) or experiment.positioning == VICON_TWIN:
        found.append("twin")
    if experiment.positioning is not None:
        found.append("positioning")
    if Plan(experiment).guided:
        found.append("centre")
    return found


def _rights(experiment: Experiment) -> Rights:
    keys = Keys(experiment.network.realm)
    hears, steered = senders_by_receiver(experiment), Plan(experiment).guided
    robots: dict[str, Grant] = {}
    for group in process_groups(experiment):
        others = sorted({speaker for name in group for speaker in hears[name]})
        if len(others) >= MANY and {*others, *group} == set(experiment.robots):
            others = ["*"]
        led = [name for name in group if name in steered]
        told = [*_each(group, keys.position, keys.ranges), *map(keys.goal, led)]
        own = [keys.below(name) for name in group]
        foreign = [key for name in group for key in _foreign(name, experiment.robots[name])]
        tokens = [key for name in group for key in _foreign_tokens(name, experiment.robots[name])]
        grant = Grant(
            say=[*own, *foreign],
            hear=[*told, *map(keys.pose, others), keys.estop, keys.experiment, *foreign],
            answer=own,
            reached=[keys.pose("*"), keys.order("*")],
            be=[*own, *tokens],
            watch=[
                *own,
                *(keys.lives(keys.alive(other)) for other in others),
                keys.conductor,
                *([keys.lives(keys.centre_alive)] if led else []),
                *tokens,
            ],
        )
        robots |= dict.fromkeys(group, grant)
    network = experiment.network
    linked = network.routers > 1 or len(network.connect or ()) > 1
    return Rights(keys.realm, robots, _roles(experiment, keys), linked)


def _roles(experiment: Experiment, keys: Keys) -> dict[str, Grant]:
    names, plan = experiment.robots, Plan(experiment)
    far = [name for name, robot in names.items() if robot.body in FAR]
    ranged = [name for name, robot in names.items() if robot.body in FAR or robot.ranges == bodies.WORLD]
    located = plan.externally_measured
    twins = [name for name, robot in names.items() if robot.body in registry.names(registry.DEVICES)]
    measured = sorted({*located, *twins})
    goals = _each(plan.guided, keys.goal)
    foreign = sorted({key for name, robot in names.items() for key in _foreign(name, robot)})
    tokens = sorted({key for name, robot in names.items() for key in _foreign_tokens(name, robot)})
    everything = [keys.everything]
    look = Grant(hear=everything, ask=[keys.pose("*"), ADMIN], watch=everything)
    return {
        "observer": look,
        "recorder": Grant(hear=everything, watch=everything, be=[keys.recorder]),
        "operator": Grant(
            say=[keys.estop, keys.below("run")],
            hear=everything,
            ask=[keys.order("*"), keys.world_order, keys.run_order, *look.ask],
            answer=[keys.run_order],
            be=[keys.below("run")],
            watch=everything,
        ),
        "world": Grant(
            say=[keys.below("world"), keys.event, *_each(far, keys.position, keys.truth), *_each(ranged, keys.ranges)],
            hear=[keys.setpoint("*"), keys.status("*"), keys.state("*"), keys.estop],
            answer=[keys.world_order],
            be=[keys.below("world")],
            watch=[keys.lives(keys.alive("*")), keys.below("world")],
        ),
        "positioning": Grant(say=_each(located, keys.position), watch=_each(measured, keys.alive)),
        "twin": Grant(
            say=[*_each(twins, keys.truth), *foreign],
            hear=[*_each(measured, keys.truth), *foreign],
            be=tokens,
            watch=[*_each(measured, keys.alive), *tokens],
        ),
        "centre": Grant(
            say=[keys.centre, *goals],
            hear=[keys.pose("*"), keys.status("*")],
            be=[keys.lives(keys.centre_alive)],
            watch=[keys.lives(keys.alive("*")), keys.lives(keys.centre_alive)],
        ),
        "ros2": Grant(
            say=[*goals, *foreign],
            hear=[keys.state("*"), keys.status("*"), *foreign],
            be=tokens,
            watch=[keys.alive("*"), keys.centre_alive, *tokens],
        ),
    }


def _each(names: Iterable[str], *of: Callable[[str], str]) -> list[str]:
    return [key(name) for name in names for key in of]


def process_groups(experiment: Experiment) -> list[list[str]]:
    """Robots by process."""
    groups: dict[str, list[str]] = {}
    for name, robot in experiment.robots.items():
        groups.setdefault(f"process {robot.process}" if robot.process else name, []).append(name)
    return list(groups.values())


def senders_by_receiver(experiment: Experiment) -> dict[str, set[str]]:
    """Senders of each robot: the poses to which its process subscribes."""
    plan = Plan(experiment)
    links = plan.pose_links
    found: dict[str, set[str]] = {name: set() for name in plan.names}
    for listener, speaker in zip(links.receiver.tolist(), links.sender.tolist(), strict=True):
        found[plan.names[listener]].add(plan.names[speaker])
    return found


def _ros(name: str, robot: Robot) -> turtlebot3.Address | None:
    """Address of a robot in ROS 2 on the experiment's own routers; None if it is not there."""
    body = registry.body_name(robot.body)
    if body not in (*ROS, ROS_TWIN):
        return None
    chosen = settings(turtlebot3.Settings, name, robot.device)
    if chosen.endpoint is not None:
        return None
    return turtlebot3.twin(name, chosen) if body == ROS_TWIN else turtlebot3.address(name, robot.body, chosen)


def _foreign(name: str, robot: Robot) -> list[str]:
    """Keys outside the realm on which a robot of ROS 2 sends and receives."""
    where = _ros(name, robot)
    if where is None:
        return []
    below = f"{where.namespace}/**" if where.namespace else "*"
    return [f"{where.domain}/{below}" if where.style == "rmw" else below]


def _foreign_tokens(name: str, robot: Robot) -> list[str]:
    where = _ros(name, robot)
    if where is None:
        return []
    return [f"@ros2_lv/{where.domain}/**" if where.style == "rmw" else "@/*/@ros2_lv/**"]
