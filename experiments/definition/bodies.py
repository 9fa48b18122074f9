"""Bodies of the robots: which drive which kind, their requests, start poses, and the world that they share."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from math import hypot, inf, nan
from typing import Any, Final

import msgspec
import numpy as np

from agents.body.interface import Body, BodyEntry, BodyError, BodyFault, BodyRequest, shared_devices
from agents.body.kinds import KINDS, Kind
from agents.network.keys import Keys
from agents.plugins import registry
from agents.vectors import Vector, clamp
from experiments.definition.experiment import TWIN, VICON_TWIN, WORLD, Experiment, Positioning, RobotTable
from experiments.definition.plan import Plan
from twins import scene as outlines
from twins.engines.engine import World
from twins.scene import Scene

BODIES: Final = ("twin", "world", "protocol")  # what `--bodies` takes
TRIES: Final = 200  # places that are drawn for a robot before it stays where the file puts it
CLEAR: Final = 0.02  # [m] distance of robots that are scattered


def missing_library(body: str) -> str:
    """Name of the library that a body needs and that is not installed here; empty if there is none."""
    kind = driven_kind(body)
    return kind.library if kind and kind.library and importlib.util.find_spec(kind.library) is None else ""


def driven_kind(body: str) -> Kind | None:
    """The kind that a body drives; None of those that drive any, as simulators do."""
    return next((kind for kind in KINDS.usable() if body in kind.own_bodies), None)


def body_class(address: str) -> type[Body] | None:
    """Class of the body at an address; None if it is not installed or cannot be loaded here."""
    name = registry.body_name(address)
    if name not in registry.names(registry.BODIES):
        return None
    try:
        body: type[Body] = registry.load(registry.BODIES, name)
    except registry.PluginError:
        return None
    return body


def device_struct(address: str) -> type[msgspec.Struct] | None:
    """Struct of the `device` table of robots with a body; a protocol twin has that of the body behind which it stands.

    None where any table is right, as for twins.
    """
    name = registry.body_name(address)
    if name in registry.names(registry.DEVICES):
        kind = driven_kind(name)
        address = next(iter(kind.bodies), "") if kind is not None else ""
    body = body_class(address)
    return None if body is None else body.SETTINGS


def body_faults(experiment: Experiment) -> Iterator[BodyFault]:
    """Faults of an experiment by the classes of its bodies; robots with a wrong `device` table are left out."""
    hosts = {name: host for host, table in experiment.hosts.items() for name in table.robots}
    kinds = {kind.name: kind for kind in KINDS.usable()}
    entries: dict[type[Body], list[BodyEntry]] = {}
    for name, robot in {**experiment.robots, **experiment.spares}.items():
        body, kind = body_class(robot.body), kinds.get(robot.kind)
        if body is None or kind is None or not _fits(robot.device, body.SETTINGS):
            continue
        external, process = robot.position == "external", robot.process or name
        entry = BodyEntry(name, kind, robot.body, robot.device, external, process, hosts.get(name, ""))
        entries.setdefault(body, []).append(entry)
    yield from shared_devices((each, body) for body, group in entries.items() for each in group)
    for body, group in entries.items():
        yield from body.faults(group)


def _fits(device: Mapping[str, Any], struct: type[msgspec.Struct] | None) -> bool:
    try:
        return struct is None or bool(msgspec.convert(dict(device), struct) is not None)
    except msgspec.ValidationError:
        return False


def scattered_poses(plan: Plan, names: Sequence[str], seed: int) -> tuple[list[Vector], list[float]]:
    """Start poses as `Plan.start_poses`, scattered by the seed, clear of other robots and of obstacles.

    Places are drawn for all robots of the experiment in the order of the file, so that all processes agree.
    """
    experiment, robots = plan.experiment, plan.kinds
    begin = plan.experiment.start
    positions, yaws = plan.start_poses()
    if begin.scatter > 0.0 or begin.scatter_yaw > 0.0:
        rng = np.random.default_rng([seed, 0x73746172])
        stands = plan.scene
        half_x, half_y = (0.5 * side - experiment.safety.margin for side in experiment.arena.size[:2])
        for row, (kind, (x, y, _)) in enumerate(zip(robots, tuple(positions), strict=True)):
            yaws[row] += begin.scatter_yaw * rng.uniform(-1.0, 1.0)
            for _ in range(TRIES):
                dx, dy = (begin.scatter * rng.uniform(-1.0, 1.0, 2)).tolist()
                place = (
                    clamp(x + dx, kind.radius - half_x, half_x - kind.radius),
                    clamp(y + dy, kind.radius - half_y, half_y - kind.radius),
                )
                apart = all(
                    hypot(other[0] - place[0], other[1] - place[1]) - robots[k].radius - kind.radius > CLEAR
                    for k, other in enumerate(positions)
                    if k != row
                )
                if apart and _is_clear(stands, place, kind):
                    positions[row] = (*place, 0.0)
                    break
    rows = [plan.names.index(name) for name in names]
    return [positions[row] for row in rows], [yaws[row] for row in rows]


def _is_clear(stands: Scene, place: tuple[float, float], kind: Kind) -> bool:
    """Whether a robot that stands at `place` [m] keeps clear of all obstacles."""
    return all(
        outlines.distance(stands, k, stands.pose[k], np.array(place)) > kind.radius + CLEAR
        for k in range(len(stands.names))
        if outlines.at_height(stands, k, 0.0, kind.height)
    )


def sensors_of(robot: RobotTable) -> tuple[str, ...]:
    """Names of the range sensors of a robot."""
    own = tuple(each.name for each in KINDS[robot.kind].sensors)
    return own if robot.sensors is None else tuple(robot.sensors)


def shared_world(plan: Plan, names: Sequence[str], *, sensing: bool | None = None) -> World:
    """World that `names` share; with range sensors where avoidance uses them, or as `sensing` says."""
    experiment = plan.experiment
    used = experiment.avoidance is not None if sensing is None else sensing
    robots = [experiment.robots[name] for name in names]
    return World(
        scene=plan.scene,
        engine=plan.engine,
        sensors=tuple(sensors_of(robot) if used or robot.sensors else () for robot in robots),
        sensor_noise=experiment.world.sensor_noise,
        mirrored=(False,) * len(names),
    )


def shadow_periods(plan: Plan, names: Sequence[str]) -> list[float]:
    """Period at which each shadow twin is reset to its robot [s]: infinite for once, NaN without a shadow."""
    shadows = [plan.experiment.robots[name].shadow for name in names]
    return [nan if shadow is None else shadow.restart_s or inf for shadow in shadows]


def body_request(
    plan: Plan, names: Sequence[str], seed: int, endpoints: Sequence[str] = (), *, quiet: bool = False
) -> BodyRequest:
    """Request for the bodies of `names`, without noise if `quiet`; `endpoints` are the routers.

    Twins start where `scattered_poses` puts them; hardware is where it is.
    """
    experiment, robots = plan.experiment, [plan.experiment.robots[name] for name in names]
    given = [plan.disturbance(name) for name in names]
    positions, yaws = scattered_poses(plan, names, seed)
    return BodyRequest(
        names=tuple(names),
        kinds=tuple(KINDS[robot.kind] for robot in robots),
        addresses=tuple(robot.body for robot in robots),
        start=tuple(positions),
        yaw=tuple(yaws),
        rate_hz=experiment.rates.body_hz,
        seeds=(seed,) * len(names),
        disturbance=tuple(each.without_noise() for each in given) if quiet else tuple(given),
        external=tuple(robot.position == "external" for robot in robots),
        device=tuple(robot.device for robot in robots),
        endpoints=tuple(endpoints),
        keys=Keys(experiment.network.realm),
    )


def choose_bodies(plan: Plan, bodies: str | None) -> Plan:
    """Replace the body of every robot by that of `--bodies`; without it, change nothing."""
    if bodies is None:
        return plan
    if bodies == "protocol":
        return behind_protocols(plan)
    experiment = plan.experiment
    captured = bodies == WORLD and experiment.capture is not None and experiment.capture.simulated
    robots = {
        name: msgspec.structs.replace(
            robot,
            body=bodies,
            position=robot.position if captured else "body",
            ranges="body",
            device={name: value for name, value in robot.device.items() if name == "watchdog_s"},
        )
        for name, robot in experiment.robots.items()
    }
    return plan.changed(robots=robots)


def behind_protocols(plan: Plan) -> Plan:
    """Put every robot behind its real bridge and a protocol twin, with simulated motion capture and radio.

    Raises BodyError if the kind of a robot has no protocol twin.
    """
    given = plan.experiment.robots
    twins = {name: twin for name, robot in given.items() if (twin := KINDS[robot.kind].twin) is not None}
    if strangers := sorted({repr(robot.kind) for name, robot in given.items() if name not in twins}):
        known = ", ".join(kind.name for kind in KINDS.usable() if kind.twin is not None)
        message = f"no protocol twin of {', '.join(strangers)}, only of {known}"
        raise BodyError(f"--bodies protocol: {message}; choose --bodies twin or world")
    robots = {}
    for name, twin in twins.items():
        device = {**given[name].device, **twin.device}
        where = {"body": twin.body, "process": twin.process, "position": twin.position, "device": device}
        robots[name] = msgspec.structs.replace(given[name], **where)
    return plan.changed(robots=robots, positioning=simulated_capture(plan.experiment.capture))


def simulated_capture(capture: Positioning | None) -> str | Positioning:
    """The protocol twin of a motion capture system, with its names and coordinates; a Vicon's where there is none."""
    if capture is None:
        return VICON_TWIN
    reader = registry.load(registry.POSITIONING, capture.system)
    if not reader.TWIN:
        return VICON_TWIN
    file = f"://{capture.address}" if reader.FILE else ""
    return msgspec.structs.replace(capture, source=f"{capture.system}{TWIN}{file}")
