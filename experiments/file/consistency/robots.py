"""Consistency of robots: names, kinds, bodies, engines and starts; standby robots and spares."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from agents.body.interface import BodyError
from agents.body.kinds import KINDS, Kind
from agents.errors import did_you_mean
from agents.plugins import files, registry
from experiments.definition.bodies import body_faults, device_struct, driven_kind
from experiments.definition.experiment import MEAN, TWIN, WALL, WORLD, WORST, Experiment, RobotTable
from experiments.file.problems import Fault
from experiments.file.structure import table_faults
from twins.engines.engine import EngineFactory, require_carried
from twins.engines.point_mass import TWINLESS, has_model
from twins.sensing.range_sensors import sensors

_ROLES: Final = ("recorder", "world", "centre")  # processes of a case beside those of its robots and its motion capture
# words of keys, of [disturbance], of events and of tables of results
_RESERVED: Final = ("all", "estop", "run", "conductor", WALL, MEAN, WORST, *_ROLES)  # reserved beside kinds of robots


def robot_faults(experiment: Experiment, engine: EngineFactory) -> Iterator[Fault]:
    """All contradictions in [robots], [spares] and [disturbance]; twins are simulated by the `engine`."""
    yield from _standby(experiment)
    kinds, installed = {kind.name: kind for kind in KINDS.usable()}, list(KINDS)
    for name in experiment.disturbance:
        if name not in (known := ["all", *installed, *experiment.robots]):
            message = f"'{name}' is neither a robot nor a kind of robots"
            yield Fault(("disturbance", name), message, did_you_mean(name, known), on_key=True)
    paths = [(("robots", name), robot) for name, robot in experiment.robots.items()]
    paths += [(("spares", name), robot) for name, robot in experiment.spares.items()]
    for path, robot in paths:
        yield from _names(experiment, path, robot, installed)
        yield from _start(experiment, path, robot)
        kind = kinds.get(robot.kind)
        if kind is None:
            yield _unknown_kind(path, robot.kind)
        else:
            yield from _hover(experiment, path, robot, kind)
        yield from _body(engine, path, robot, kind)


def device_faults(experiment: Experiment) -> Iterator[Fault]:
    """Errors of addresses and `device` tables on any machine, by the classes of bodies."""
    robots = [(("robots", name), robot) for name, robot in experiment.robots.items()]
    spares = [(("spares", name), robot) for name, robot in experiment.spares.items()]
    for path, robot in [*robots, *spares]:
        if (struct := device_struct(robot.body)) is not None:
            yield from table_faults(robot.device, struct, (*path, "device"))
    for fault in body_faults(experiment):
        if fault.severity == "error" and not fault.here:
            table = "robots" if fault.robot in experiment.robots else "spares"
            yield Fault((table, fault.robot, *fault.key), fault.message, fault.remedy)


def positioning_faults(experiment: Experiment) -> Iterator[Fault]:
    """Faults of a source of positions that there is not, of its address, and of names in it."""
    capture = experiment.capture
    if capture is None:
        return
    table = () if isinstance(experiment.positioning, str) else ("source",)
    readers = {name: registry.load(registry.POSITIONING, name) for name in registry.names(registry.POSITIONING)}
    places = {name: "://FILE" if reader.FILE else "://HOST" for name, reader in readers.items()}
    twins = {f"{name}{TWIN}": "://FILE" if reader.FILE else "" for name, reader in readers.items() if reader.TWIN}
    sources = {**places, **twins}
    known = ", ".join(f"{name}{place}" for name, place in sources.items())
    addressed = "://" in capture.source
    if capture.scheme not in sources or addressed != bool(sources[capture.scheme]):
        hint = f"known: {known}; another source publishes the key `position` itself, without `positioning`"
        yield Fault(("positioning", *table), f"no {capture.source!r} among the sources of positions", hint)
    elif addressed:
        try:
            readers[capture.system].parse(capture.address)
        except ValueError as error:
            example = f"{capture.system}.toml" if readers[capture.system].FILE else "192.168.10.1"
            yield Fault(("positioning", *table), str(error), f"such as {capture.scheme}://{example}")
    if capture.unit != "m" and capture.system in readers and readers[capture.system].METRES:
        hint = "leave `unit` out, whatever its windows show"
        yield Fault(("positioning", "unit"), f"positions of {capture.system} arrive in metres", hint)
    measured = [name for name, robot in experiment.robots.items() if robot.position == "external"]
    for name in capture.names:
        if name not in measured:
            message = f"'{name}' is no robot with position = \"external\""
            yield Fault(("positioning", "names", name), message, did_you_mean(name, measured), on_key=True)
    bodies = [capture.names.get(name, name) for name in measured]
    for name in measured:
        if bodies.count(body := capture.names.get(name, name)) > 1:
            path = ("positioning", "names", name) if name in capture.names else ("positioning",)
            yield Fault(path, f"the body '{body}' of {name} is that of another robot", "name each robot's own body")
            break


def _standby(experiment: Experiment) -> Iterator[Fault]:
    """Faults of standby robots and spares."""
    robots = experiment.robots
    for name, robot in robots.items():
        if robot.standby and robot.process is not None:
            message = f"'{name}' is on standby and shares the process '{robot.process}' with robots that may run"
            yield Fault(("robots", name, "process"), message, "give it a process of its own: leave `process` out")
    if all(robot.standby for robot in robots.values()):
        name = next(iter(robots))
        yield Fault(("robots", name, "standby"), "all robots are on standby", "let one or more take part")
    kinds = {robot.kind for robot in robots.values()}
    for name, spare in experiment.spares.items():
        path = ("spares", name)
        if name in robots:
            yield Fault(path, f"'{name}' is the name of a robot already", "rename one of them", on_key=True)
        if spare.kind not in kinds:
            hint = f"spares take over from robots of their kind: {', '.join(sorted(kinds))}"
            yield Fault((*path, "kind"), f"no robot is a {spare.kind}", hint)
        if spare.process is not None:
            yield Fault((*path, "process"), f"'{name}' begins in a process of its own", "leave `process` out")
        if spare.standby:
            yield Fault((*path, "standby"), "a spare always waits", "leave `standby` out")
        if registry.body_name(spare.body) in registry.names(registry.DEVICES):
            message = f"'{name}' is behind a protocol twin ('{spare.body}'), which starts before the run only"
            yield Fault((*path, "body"), message, "give it the body twin, or a real one")
    if experiment.on_loss == "replace" and not experiment.spares:
        message = "lost robots are to be replaced, but there is no spare"
        yield Fault(("on_loss",), message, 'add [spares.NAME], or say on_loss = "restart"')


def _names(experiment: Experiment, path: tuple[str, str], robot: RobotTable, kinds: Sequence[str]) -> Iterator[Fault]:
    """Faults of the name of a robot, and of that of its process."""
    name = path[1]
    systems = registry.names(registry.POSITIONING)
    if name in (*_RESERVED, *systems) or name in kinds:
        message = f"a robot cannot be called '{name}', which has a meaning of its own"
        yield Fault(path, message, "rename it", on_key=True)
    if robot.process in (*_ROLES, *systems):
        yield Fault((*path, "process"), f"'{robot.process}' is a process of every run", "rename it")
    elif robot.process in experiment.robots:
        message = f"'{robot.process}' is the name of a robot, so that its own process would be shared unasked"
        yield Fault((*path, "process"), message, "rename the process, and name it at each robot that shares it")


def _start(experiment: Experiment, path: tuple[str, str], robot: RobotTable) -> Iterator[Fault]:
    for axis, size in enumerate(experiment.arena.size[:2]):
        if abs(robot.start[axis]) > size / 2:
            hint = f"{'xy'[axis]} lies between {-size / 2:g} and {size / 2:g}; or enlarge size in [arena]"
            yield Fault((*path, "start", axis), f"'{path[1]}' starts outside of the arena", hint)
    if len(robot.start) == 3 and abs(robot.start[2]) > 2 * math.pi:
        radians = math.remainder(math.radians(robot.start[2]), 2 * math.pi)
        yield Fault((*path, "start", 2), "the yaw is in radians", f"{robot.start[2]:g} degrees are {radians:.4f}")


def _unknown_kind(path: tuple[str, str], name: str) -> Fault:
    try:
        KINDS[name]
    except registry.PluginError as error:
        return Fault((*path, "kind"), f"the kind '{name}' cannot be used: {error}", "mend or uninstall it")
    except KeyError:
        if files.is_choice(name):
            hint = "a kind cannot be named by its file: install it, and name it (docs/plugins.md#a-kind-of-robot)"
            return Fault((*path, "kind"), f"{name!r} is a file", hint)
        hint = f"{did_you_mean(name, KINDS)}; one of your own is a plug-in to install (docs/plugins.md)"
    return Fault((*path, "kind"), f"no {name!r} among the kinds of robots", hint)


def _hover(experiment: Experiment, path: tuple[str, str], robot: RobotTable, kind: Kind) -> Iterator[Fault]:
    name, top = path[1], experiment.arena.size[2]
    margin = experiment.safety.margin
    if not kind.flies:
        if robot.hover is not None:
            message = f"'{name}' is a {robot.kind}, which does not fly"
            yield Fault((*path, "hover"), message, "leave hover out", on_key=True)
    elif robot.hover is None:
        message = f"'{name}' is a {robot.kind}, which flies: it needs a height to hold"
        yield Fault(path, message, f"add hover = {min(0.8, top / 2):g}, in metres")
    elif robot.hover > top - margin:
        inside = f"the arena is {top:g} m high, less a margin of {margin:g} m"
        hint = f"use a hover of at most {max(0.0, top - margin):g}, or enlarge size in [arena]"
        yield Fault((*path, "hover"), f"'{name}' cannot hover at {robot.hover:g} m: {inside}", hint)


def _body(engine: EngineFactory, path: tuple[str, str], robot: RobotTable, kind: Kind | None) -> Iterator[Fault]:
    """Faults of a body and its sensors; of an unknown `kind` only those of the body itself."""
    body = registry.body_name(robot.body)
    bodies = [*registry.names(registry.BODIES), *registry.names(registry.DEVICES)]
    if body not in bodies:
        hint = f"{did_you_mean(body, bodies)}; one of your own is a plug-in to install (docs/plugins.md)"
        if body.partition(":")[0] == "radio":
            hint = "write channel, rate and address, such as radio://0/80/2M/E7E7E7E701"
        yield Fault((*path, "body"), f"no {body!r} among the bodies", hint)
    driven = driven_kind(body)
    if kind is not None and driven is not None and driven is not kind:
        known = ", ".join(("twin", WORLD, *kind.own_bodies))
        hint = f"write kind = '{driven.name}', or a body of a {kind.name}: {known}"
        yield Fault((*path, "body"), f"'{body}' drives a {driven.name}, and {path[1]} is a {kind.name}", hint)
    elif kind is not None and body in ("twin", WORLD):
        try:
            if has_model(kind):
                require_carried(engine, [kind])
            else:
                yield Fault((*path, "kind"), f"no twin of '{kind.name}'", TWINLESS)
        except BodyError as error:
            message, _, hint = str(error).partition(": ")
            yield Fault((*path, "kind"), message, hint)
    for number, sensor in enumerate(robot.sensors or []):
        if sensor not in sensors():
            message = f"no {sensor!r} among the range sensors"
            yield Fault((*path, "sensors", number), message, did_you_mean(sensor, sensors()))
