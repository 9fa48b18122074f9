"""Consistency of an experiment: faults that no single field shows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from agents.body.interface import BodyError
from agents.body.kinds import KINDS, Kind
from agents.formation.link import BY_BEARING
from agents.plugins import files, registry
from agents.plugins.laws import Gradient
from agents.plugins.predictors import HOLD
from agents.plugins.registry import did_you_mean
from experiments.definition.bodies import driven_kind, own_bodies
from experiments.definition.experiment import (
    JUDGED,
    MEAN,
    WORLD,
    WORST,
    Arena,
    ChangeTable,
    Experiment,
    Hybrid,
    LinkTable,
    RobotTable,
    TargetTable,
)
from experiments.definition.links import FORM, NO_TARGET, held_height, link_pairs
from experiments.definition.plan import Plan
from experiments.file import consistency_network
from experiments.file.problems import Fault, Path, after_the_end, unknown_robot
from experiments.file.structure import struct_of
from twins import scene as outlines
from twins.engines.engine import require_carried
from twins.engines.point_mass import TWINLESS, has_model
from twins.scene import Scene
from twins.sensing.range_sensors import sensors


def standby_faults(experiment: Experiment) -> Iterator[Fault]:
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


_ROLES: Final = ("recorder", "world", "centre", "vicon")  # processes of a case beside those of its robots
# words of keys, of [disturbance], of events and of tables of results
_RESERVED: Final = ("all", "estop", "run", "conductor", MEAN, WORST, *_ROLES)  # and the kinds of robots
ROUNDED: Final = 1e-3  # [m] heights written with three decimals
_WALL: Final = "wall"  # name of the border of the arena in contacts


def faults(plan: Plan) -> Iterator[Fault]:
    """All contradictions between fields, with their paths in the file."""
    experiment = plan.experiment
    yield from _rates(experiment)
    yield from _case_names(experiment.cases)
    yield from arena_faults(experiment.arena)
    for name, robot in experiment.robots.items():
        yield from _robot(plan, ("robots", name), robot)
    for name, robot in experiment.spares.items():
        yield from _robot(plan, ("spares", name), robot)
    yield from standby_faults(experiment)
    yield from _start_conflicts(experiment)
    yield from _formation(plan)
    yield from consistency_network.channel_faults(plan)
    yield from consistency_network.host_faults(experiment)
    yield from _timeline(experiment)
    yield from _architecture(experiment)
    yield from _triggers(plan)
    yield from _remembering(plan)
    for name in experiment.disturbance:
        known = ("all", *KINDS, *experiment.robots)
        if name not in known:
            message = f"'{name}' is neither a robot nor a kind of robots"
            yield Fault(("disturbance", name), message, did_you_mean(name, known), on_key=True)


def judged_metrics() -> list[str]:
    """Metrics that a criterion can name."""
    return [*JUDGED, *registry.names(registry.METRICS)]


def criteria_faults(plan: Plan, cases: Iterable[str]) -> Iterator[Fault]:
    """Faults of the criteria of a file with these cases."""
    cases = list(cases)
    for number, each in enumerate(plan.experiment.criteria):
        path = ("criteria", number)
        if each.metric is not None and files.is_choice(each.metric):
            try:
                struct_of(registry.METRICS, each.metric)
            except registry.PluginError as error:
                yield Fault((*path, "metric"), str(error), "mend that file (docs/metrics.md)")
        elif each.metric is not None and each.metric not in (known := judged_metrics()):
            yield Fault((*path, "metric"), f"no {each.metric!r} among the metrics", did_you_mean(each.metric, known))
        if each.of not in (known := [MEAN, WORST, *plan.names]):
            yield Fault((*path, "of"), f"no robot is called '{each.of}'", did_you_mean(each.of, known))
        for key in ("case", "relative_to"):
            name = getattr(each, key)
            if name is not None and name not in cases:
                yield Fault((*path, key), f"no case '{name}' in this experiment", did_you_mean(name, cases))


def _case_names(names: Iterable[str]) -> Iterator[Fault]:
    """Faults of cases with the same file name on systems that ignore capitals."""
    former: dict[str, str] = {}
    for name in names:
        other = former.setdefault(name.lower(), name)
        if other != name:
            message = f"'{name}' and '{other}' differ by capitals only, and so would their recordings"
            yield Fault(("cases", name), message, "rename one of them", on_key=True)


def arena_faults(arena: Arena) -> Iterator[Fault]:
    """Faults of an arena by itself; paths begin at the top of a document."""
    scene = Scene.furnished(arena.size, arena.obstacles, {}, walled=arena.walls)
    x, y, z = arena.size
    for number, (name, obstacle) in enumerate(arena.obstacles.items()):
        path = ("arena", "obstacles", name)
        if name == _WALL:
            message = f"an obstacle cannot be called '{_WALL}', which means the border of the arena"
            yield Fault(path, message, "rename it", on_key=True)
        if outlines.outside(scene, number):
            message = f"'{name}' stands outside of the arena, of which the middle is 0, 0"
            hint = f"x lies between {-x / 2:g} and {x / 2:g}, y between {-y / 2:g} and {y / 2:g}; or enlarge size"
            yield Fault((*path, "at"), message, hint)
        if obstacle.bottom >= z:
            message = f"'{name}' begins at {obstacle.bottom:g} m: the arena is {z:g} m high"
            yield Fault((*path, "bottom"), message, f"give it a bottom below {z:g}, or enlarge size")
    for name, box in arena.starts.items():
        for axis in (0, 1):
            beyond = abs(box.at[axis]) + box.size[axis] / 2 - arena.size[axis] / 2
            if beyond > 1e-9:
                message = f"the start box '{name}' reaches {beyond:.2g} m beyond the arena along {'xy'[axis]}"
                yield Fault(("arena", "starts", name, "at"), message, "move it, make it smaller, or enlarge size")


def _start_conflicts(experiment: Experiment) -> Iterator[Fault]:
    """Faults between robots, obstacles and start boxes at the start."""
    arena, robots = experiment.arena, experiment.robots
    scene = Scene.furnished(arena.size, arena.obstacles, {}, walled=arena.walls)
    for number, name in enumerate(arena.obstacles):
        path = ("arena", "obstacles", name)
        if name in robots:
            yield Fault(path, f"'{name}' is the name of a robot already", "rename one of them", on_key=True)
        for robot, each in robots.items():
            kind, place = _known(each.kind), np.array(each.start[:2])
            if kind is None:
                continue
            if not outlines.at_height(scene, number, 0.0, kind.height):  # a flying robot stands on the floor before
                continue
            missing = kind.radius - float(outlines.distance(scene, number, scene.pose[number], place))
            if missing > 1e-9:
                message = f"'{robot}' starts in the obstacle '{name}'"
                hint = f"move one of them by {missing + 0.01:.2f} m or more: all start on the floor, flying ones too"
                yield Fault(("robots", robot, "start"), message, hint)
    boxes = arena.starts
    for robot, each in robots.items():
        x, y = each.start[:2]
        inside = [
            max(abs(x - box.at[0]) - box.size[0] / 2, abs(y - box.at[1]) - box.size[1] / 2) <= 1e-9
            for box in boxes.values()
        ]
        if boxes and not any(inside):
            where = ", ".join(f"'{name}' around ({box.at[0]:g}, {box.at[1]:g})" for name, box in boxes.items())
            message = f"'{robot}' starts outside of the boxes where robots may start"
            yield Fault(("robots", robot, "start"), message, f"start it in {where}; or change [arena.starts]")


def _rates(experiment: Experiment) -> Iterator[Fault]:
    body = experiment.rates.body_hz
    for name in ("pose_hz", "coordination_hz", "state_hz"):
        ratio = body / getattr(experiment.rates, name)
        if abs(ratio - max(1, round(ratio))) > 1e-9 * ratio:
            hint = f"the nearest that does: {name} = {divisor(body, body / ratio):g}"
            yield Fault(("rates", name), f"{name} = {body / ratio:g} does not divide body_hz = {body:g}", hint)

    samples = experiment.duration_s * experiment.rates.state_hz
    if samples < 1.0 - 1e-9:
        message = f"duration_s = {experiment.duration_s:g} holds less than two samples of telemetry"
        hint = f"give it {1.0 / experiment.rates.state_hz:g} s or more, or raise rates.state_hz"
        yield Fault(("duration_s",), message, hint)


def divisor(body: float, wanted: float) -> float:
    """The nearest rate that divides `body` and can be written in a few digits."""
    written = (float(f"{body / times:g}") for times in range(1, 1001))
    exact = [rate for times, rate in enumerate(written, 1) if rate * times == body]
    return min(exact, key=lambda rate: abs(rate - wanted), default=body)


def _robot(plan: Plan, path: tuple[str, str], robot: RobotTable) -> Iterator[Fault]:
    experiment, name = plan.experiment, path[1]
    yield from _names(experiment, path, robot)
    body = registry.body_name(robot.body)
    bodies = [*registry.names(registry.BODIES), *registry.names(registry.DEVICES)]
    if body not in bodies:
        hint = f"{did_you_mean(body, bodies)}; one of your own is a plug-in to install (docs/plugins.md)"
        if body.partition(":")[0] == "radio":
            hint = "write channel, rate and address, such as radio://0/80/2M/E7E7E7E701"
        yield Fault((*path, "body"), f"no {body!r} among the bodies", hint)
    kind = _known(robot.kind)
    if kind is None:
        yield _unknown(path, robot.kind)
    else:
        driven = driven_kind(body)
        if driven is not None and driven is not kind:
            known = ", ".join(("twin", WORLD, *own_bodies(kind)))
            hint = f"write kind = '{driven.name}', or a body of a {kind.name}: {known}"
            yield Fault((*path, "body"), f"'{body}' drives a {driven.name}, and {name} is a {kind.name}", hint)
        elif body in ("twin", WORLD) and not has_model(kind):
            yield Fault((*path, "kind"), f"no twin of '{kind.name}'", TWINLESS)
        elif body in ("twin", WORLD):
            yield from _engine(plan, path, kind)
        yield from _hover(experiment, path, robot, kind)
    for number, sensor in enumerate(robot.sensors or []):
        if sensor not in sensors():
            message = f"no {sensor!r} among the range sensors"
            yield Fault((*path, "sensors", number), message, did_you_mean(sensor, sensors()))
    for axis, size in enumerate(experiment.arena.size[:2]):
        if abs(robot.start[axis]) > size / 2:
            hint = f"{'xy'[axis]} lies between {-size / 2:g} and {size / 2:g}; or enlarge size in [arena]"
            yield Fault((*path, "start", axis), f"'{name}' starts outside of the arena", hint)
    if len(robot.start) == 3 and abs(robot.start[2]) > 2 * math.pi:
        radians = math.remainder(math.radians(robot.start[2]), 2 * math.pi)
        yield Fault((*path, "start", 2), "the yaw is in radians", f"{robot.start[2]:g} degrees are {radians:.4f}")


def _engine(plan: Plan, path: tuple[str, str], kind: Kind) -> Iterator[Fault]:
    try:
        require_carried(plan.engine, [kind])
    except BodyError as error:
        message, _, hint = str(error).partition(": ")
        yield Fault((*path, "kind"), message, hint)


def _known(name: str) -> Kind | None:
    """A kind; None if it is not installed, or cannot be used."""
    try:
        return KINDS.get(name)
    except registry.PluginError:
        return None


def _unknown(path: tuple[str, str], name: str) -> Fault:
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


def _names(experiment: Experiment, path: tuple[str, str], robot: RobotTable) -> Iterator[Fault]:
    """Faults of the name of a robot, and of that of its process."""
    name = path[1]
    if name in _RESERVED or name in KINDS:
        message = f"a robot cannot be called '{name}', which has a meaning of its own"
        yield Fault(path, message, "rename it", on_key=True)
    if robot.process in _ROLES:
        yield Fault((*path, "process"), f"'{robot.process}' is a process of every run", "rename it")
    elif robot.process in experiment.robots:
        message = f"'{robot.process}' is the name of a robot, so that its own process would be shared unasked"
        yield Fault((*path, "process"), message, "rename the process, and name it at each robot that shares it")


def _hover(experiment: Experiment, path: tuple[str, str], robot: RobotTable, kind: Kind) -> Iterator[Fault]:
    name, top, margin = path[1], experiment.arena.size[2], experiment.safety.margin
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


def _triggers(plan: Plan) -> Iterator[Fault]:
    """Triggers in the wrong place, or without the prediction that they need."""
    kind, prediction, update = plan.trigger_name, plan.experiment.prediction, plan.update
    if "communication" not in plan.trigger.PLACES:
        message = f"'{kind}' decides when the law is recomputed, not when a robot transmits"
        yield Fault(("trigger",), message, f"put it into [formation] as update = '{kind}', and another trigger here")
    if prediction is not None and plan.needs_prediction and plan.predictor is HOLD:
        message = f"'{kind}' counts on neighbours that extrapolate, but prediction = 'hold' says that they do not"
        hint = f"leave prediction out, which means '{plan.trigger.PREDICTION}', or take the trigger send-on-delta"
        yield Fault(("prediction",), message, hint)
    if update is None:
        return
    if "control" not in update.PLACES:
        message = f"'{plan.update_name}' decides when a robot transmits, not when the law is recomputed"
        yield Fault(("formation", "update"), message, "take another one, such as send-on-delta or relative-control")
    if update.smoothing_s:
        message = "smoothing_s is for transmissions, and there are none where the law is computed"
        yield Fault(("formation", "update", "smoothing_s"), message, "leave it out", on_key=True)


def _remembering(plan: Plan) -> Iterator[Fault]:
    """Settings that exclude a law that is no gradient: such a law has no errors, and its memory is the robot's own."""
    experiment, name, kind = plan.experiment, plan.law_name, plan.trigger_name
    if isinstance(plan.law, Gradient):
        return
    if experiment.formation.update is not None:
        message = f"the law '{name}' is no function of its input alone: a step that is left out would be lost"
        yield Fault(("formation", "update"), message, "leave update out", on_key=True)
    if isinstance(experiment.architecture, Hybrid) and plan.law.SAYS:
        message = (
            f"guided robots transmit no variables, and '{name}' needs them: their free neighbours would receive nothing"
        )
        hint = 'write architecture = "centralised" or "distributed", or take another law'
        yield Fault(("architecture",), message, hint, on_key=True)
    if experiment.formation.anchors:
        message = f"anchors pull robots of laws that pull along links; '{name}' does not know them"
        yield Fault(("formation", "anchors"), message, "leave anchors out", on_key=True)
    if plan.trigger.JUDGES_ERRORS:
        message = f"'{kind}' judges errors of links, and the law '{name}' has none"
        yield Fault(("trigger",), message, "take another trigger, such as send-on-delta")
    elif plan.trigger.JUDGES_DRIFT and plan.law.SAYS:
        message = f"'{kind}' waits by how the pose drifts; it does not see the variables that '{name}' says"
        yield Fault(("trigger",), message, "take another trigger, such as send-on-delta")


def _architecture(experiment: Experiment) -> Iterator[Fault]:
    """A hybrid architecture must name some of the robots, and not all."""
    hybrid, path = experiment.architecture, ("architecture", "robots")
    if not isinstance(hybrid, Hybrid):
        return
    for number, name in enumerate(hybrid.robots):
        yield from unknown_robot((*path, number), name, experiment.robots)
        if name in hybrid.robots[:number]:
            yield Fault((*path, number), f"'{name}' is named twice", "name it once")
    if set(experiment.robots) <= set(hybrid.robots):
        message = "a hybrid architecture in which the centre guides every robot is a centralised one"
        yield Fault(path, message, 'write architecture = "centralised", or leave some robots out')


def _timeline(experiment: Experiment) -> Iterator[Fault]:
    before: dict[str, float] = {}
    for number, leg in enumerate(experiment.timeline):
        path = ("timeline", number)
        yield from unknown_robot((*path, "robot"), leg.robot, experiment.robots)
        yield from after_the_end((*path, "at_s"), "leg", leg.at_s, experiment.duration_s)
        if leg.at_s <= before.get(leg.robot, -1.0):
            message = f"this leg of '{leg.robot}' begins at {leg.at_s:g} s, not after the one before it"
            hint = f"sort its legs by time; the one before begins at {before[leg.robot]:g} s"
            yield Fault((*path, "at_s"), message, hint)
        before[leg.robot] = max(leg.at_s, before.get(leg.robot, -1.0))


def _formation(plan: Plan) -> Iterator[Fault]:
    """All contradictions in [formation]."""
    experiment, formation = plan.experiment, plan.experiment.formation
    found = list(_links(experiment))
    yield from found
    places = [("anchors", name) for name in formation.anchors] + [("shape", name) for name in formation.shape]
    for table, name in places:
        yield from unknown_robot(("formation", table, name), name, experiment.robots, on_key=True)
    if found:
        return  # what follows looks links up
    for text, link in experiment.formation.links.items():
        path = ("formation", "links", text)
        yield from _asked(plan, text, link, path)
        if isinstance(link, LinkTable):
            yield from after_the_end((*path, "from_s"), "link", link.from_s, experiment.duration_s)
    for number, change in enumerate(experiment.formation.changes):
        yield from _change(plan, number, change)
    near = experiment.formation.proximity
    if near is not None and near.distance is None and not experiment.formation.links:
        message = "there are no links that could come and go by range"
        hint = "add distance = 0.5, which any two robots keep while they are near each other, or [formation.links]"
        yield Fault(("formation", "proximity"), message, hint)


def _links(experiment: Experiment) -> Iterator[Fault]:
    robots = experiment.robots
    if experiment.formation.leader is not None:
        yield from unknown_robot(("formation", "leader"), experiment.formation.leader, robots)
    given: dict[tuple[str, str], str] = {}
    for text in experiment.formation.links:
        path = ("formation", "links", text)
        try:
            both = link_pairs(text)
        except ValueError as error:
            hint = str(error)
            yield Fault(path, f"{text!r} is no link", hint if hint == FORM else f"{hint}; {FORM}", on_key=True)
            continue
        for name in dict.fromkeys(reversed(both[0])):
            yield from unknown_robot(path, name, robots, on_key=True)
        if both[0][0] == both[0][1]:
            yield Fault(path, f"'{both[0][0]}' cannot receive from itself", "name two robots", on_key=True)
            continue
        again = [pair for pair in both if pair in given]
        if again:
            receiver, sender = again[0]
            first = given[again[0]]
            what = f"stands twice, as '{first}' and" if f"{sender} > {receiver}" != first else "stands again in"
            message = f"the link from {sender} to {receiver} {what} '{text}'"
            yield Fault(path, message, "remove one of the two: 'A - B' is 'A > B' and 'B > A'", on_key=True)
        given.update(dict.fromkeys(both, text))


def _kind_of(given: TargetTable | float) -> str:
    """Name of the target of a link."""
    if not isinstance(given, TargetTable):
        return "distance"
    return next((name for name in ("distance", "offset", "bearing") if getattr(given, name) is not None), NO_TARGET)


def _asked(plan: Plan, text: str, given: TargetTable | float, path: Path) -> Iterator[Fault]:
    """Targets that the law does not take, or that robots with held heights cannot meet."""
    experiment, name, needs, kind = plan.experiment, plan.law_name, plan.target_kind, _kind_of(given)
    if kind not in needs.fields and kind == NO_TARGET:
        message = f"the law '{name}' needs a target of every link, and {text!r} has none"
        yield Fault(path, message, f"give {needs.words}")
        return
    if kind not in needs.fields:
        message = f"the law '{name}' needs {needs.words} of every link; this one asks for a {kind}"
        hint = (
            f'draw all in [formation.shape] and write "{text}" = "shape", or write such as "{text}" = {needs.example}'
        )
        yield Fault(path, message, f'{hint}, or take law = "mixed", which goes by each link')
        return
    if not isinstance(given, TargetTable):
        return
    second, first = link_pairs(text)[0]
    rise = held_height(experiment, second) - held_height(experiment, first)
    if given.offset is not None:
        if needs.wants == BY_BEARING and not any(given.offset) and rise == 0.0:
            yield Fault((*path, "offset"), "an offset of zeros has no direction", "give x, y other than 0")
        if len(given.offset) == 3 and abs(given.offset[2] - rise) > ROUNDED:
            message = f"'{second}' is held {rise:g} m above '{first}', not {given.offset[2]:g} m"
            yield Fault((*path, "offset", 2), message, "leave the third number out, or change hover")
    slope = given.bearing[2] if given.bearing is not None and len(given.bearing) == 3 else None
    if slope is not None and slope * rise <= 0.0 and not slope == rise == 0.0:
        message = f"'{second}' is held {rise:g} m above '{first}': this direction is never met"
        yield Fault((*path, "bearing", 2), message, "leave the third number out: a direction seen from above")


def _change(plan: Plan, number: int, change: ChangeTable) -> Iterator[Fault]:
    experiment, path = plan.experiment, ("formation", "changes", number)
    yield from after_the_end((*path, "at_s"), "change", change.at_s, experiment.duration_s)
    before = {pair: given for text, given in experiment.formation.links.items() for pair in link_pairs(text)}
    kinds = {_kind_of(given) for given in before.values()}
    for text, given in change.links.items():
        where = (*path, "links", text)
        try:
            both = link_pairs(text)
        except ValueError as error:
            yield Fault(where, f"{text!r} is no link", str(error), on_key=True)
            continue
        if not set(both) <= set(before):
            hint = did_you_mean(text, experiment.formation.links)
            yield Fault(where, f"{text!r} is none of the formation's links", hint, on_key=True)
            continue
        old, new = _kind_of(before[both[0]]), _kind_of(given)
        if old != new:
            message = f"{text!r} asks for a {old} before, and for a {new} then: there is no way between them"
            yield Fault(where, message, f"give a {old}")
        else:
            yield from _asked(plan, text, given, where)
    if change.rotate and kinds == {"distance"}:
        message = "nothing here knows a direction: distances are met whichever way the formation faces"
        yield Fault((*path, "rotate"), message, "give links an offset or a bearing, and law a law that goes by them")
    if change.scale != 1.0:
        for text, given in experiment.formation.links.items():
            if (
                isinstance(given, TargetTable)
                and given.bearing is not None
                and len(given.bearing) == 3
                and given.bearing[2]
            ):
                message = f"the slope of {text!r} changes when the formation grows and heights are held"
                yield Fault((*path, "scale"), message, "give that bearing as seen from above, without the third number")
