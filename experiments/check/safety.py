"""Checks of `[safety]` against itself, the formation and the starts; checks of the architecture."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from math import degrees
from typing import Final

import numpy as np

from agents.body.kinds import KINDS
from agents.errors import join_names
from agents.fields import fields_of
from agents.network.keys import Keys
from agents.plugins import registry
from agents.safety.setpoint_filter import OUTSIDE_M
from experiments.check.analysis import Analysis
from experiments.check.findings import DEVICE, FORGIVEN, Finding
from experiments.definition import bodies
from twins.arrays import norm

BEFORE_START_S: Final = 5.0  # time of the battery that is spent before the common start
LISTED: Final = 12  # names
LOOSE: Final = 10.0  # multiple of the default from which a limit has no effect: its unit was mistaken, say


def safety(analysis: Analysis) -> Iterator[Finding]:
    """Report settings of `[safety]` that contradict each other or the experiment."""
    chosen = analysis.plan.experiment.safety
    if chosen.battery_min < chosen.battery_low:
        message = f"robots take off at {chosen.battery_min:.0%} of charge, and land below {chosen.battery_low:.0%}"
        yield Finding("warning", "battery", message, "raise battery_min above battery_low", ("safety", "battery_min"))
    if chosen.cut_beyond_m <= OUTSIDE_M:
        message = f"motors are cut {chosen.cut_beyond_m:g} m outside the arena, but drones land {OUTSIDE_M:g} m outside"
        yield Finding("warning", "cut-outside", message, f"raise it above {OUTSIDE_M:g}", ("safety", "cut_beyond_m"))
    for each in fields_of(type(chosen)).values():
        value, usual = getattr(chosen, each.name), each.default
        if isinstance(usual, float) and value >= LOOSE * usual:
            message = f"{each.name} is {value:g}, {value / usual:.0f} times the usual {usual:g}: it has no effect"
            yield Finding("warning", "loose-limit", message, "give seconds and metres", ("safety", each.name))
    if chosen.separation is not None:
        yield from _separation(analysis, chosen.separation)


def batteries(analysis: Analysis) -> Iterator[Finding]:
    """Report all robots with a battery that ends before the run, by their kinds."""
    experiment, low = analysis.plan.experiment, analysis.plan.experiment.safety.battery_low
    if low <= 0.0:
        return
    names_of: dict[str, list[str]] = {}
    for name, robot in experiment.robots.items():
        names_of.setdefault(robot.kind, []).append(name)
    for kind in (KINDS[each] for each in names_of):
        lasts = (1.0 - low) * kind.endurance_s - BEFORE_START_S
        if lasts >= experiment.duration_s:
            continue
        names = names_of[kind.name]
        what = "land" if kind.flies else "stop"
        message = (
            f"{join_names(names, LISTED)} {what}{'s' * (len(names) == 1)} after about {lasts:.0f} s of "
            f"{experiment.duration_s:g} s: a full battery of a {kind.name} lasts {kind.endurance_s:g} s, and below "
            f"{low:.0%} it {what}s"
        )
        remedy = "shorten duration_s; battery_low = 0 in [safety] lets twins go on, and is not for real robots"
        yield Finding("warning", "battery-ends", message, remedy, ("duration_s",))


def _separation(analysis: Analysis, limit: float) -> Iterator[Finding]:
    """Check the separation of linked pairs: at the start, at their target, and on their way."""
    names, path = analysis.plan.names, ("safety", "separation")
    track = analysis.prediction.position
    links, poses = analysis.plan.links, analysis.plan.pose_links
    pairs = sorted({tuple(sorted(pair)) for pair in zip(poses.receiver.tolist(), poses.sender.tolist(), strict=True)})
    wanted = {
        tuple(sorted(pair)): distance
        for *pair, distance in zip(links.receiver.tolist(), links.sender.tolist(), links.distance.tolist(), strict=True)
    }
    nearer, quiet = f"nearer than the separation of {limit:g} m", True
    for first, second in pairs:
        both = f"{names[first]} and {names[second]}"
        apart = float(norm(analysis.start[first] - analysis.start[second]))
        least = float(norm(track[:, first] - track[:, second]).min())
        if apart < limit - FORGIVEN:
            message = f"{both} start {apart:.2f} m apart, {nearer}: neither takes off"
            yield Finding("error", "separation-start", message, "start them farther apart, or reduce separation", path)
        elif wanted.get((first, second), np.inf) < limit - FORGIVEN:
            message = f"{both} are to be {wanted[first, second]:.2f} m apart, {nearer}: they hold before they are there"
            yield Finding("warning", "separation-link", message, "reduce separation, or ask for more distance", path)
        elif least < limit - FORGIVEN:
            message = f"{both} come within {least:.2f} m, {nearer}: they hold there"
            yield Finding("warning", "separation-path", message, "start elsewhere, or reduce separation", path)
        else:
            continue
        quiet = False
    if quiet and len(pairs) < len(names) * (len(names) - 1) // 2:
        message = f"only the {len(pairs)} pairs with a link keep the separation of {limit:g} m"
        yield Finding("note", "separation", message, "", path)


def libraries(analysis: Analysis) -> Iterator[Finding]:
    """Report bodies of robots of this machine with a missing library."""
    experiment = analysis.plan.experiment
    elsewhere = {name for host in experiment.hosts.values() for name in host.robots}
    robots = defaultdict(list)
    for name, robot in experiment.robots.items():
        if name not in elsewhere:
            robots[registry.body_name(robot.body)].append(name)
    for body, names in robots.items():
        of_robots, path = f"the body '{body}' of {join_names(names)}", ("robots", names[0], "body")
        if library := bodies.missing_library(body):
            message = f"{of_robots} needs {library}, which is not installed here"
            yield Finding("warning", "library", message, "`./zenpark hardware` adds it", path)
        elif body in registry.names(registry.BODIES) and bodies.body_class(body) is None:
            yield Finding("warning", "library", f"{of_robots} cannot be loaded here", "install what it imports", path)


def devices(analysis: Analysis) -> Iterator[Finding]:
    """Report what bodies say of the devices of their robots, beside the errors of the file."""
    for fault in bodies.body_faults(analysis.plan.experiment):
        if fault.severity != "error" or fault.here:
            path = ("robots", fault.robot, *fault.key)
            yield Finding(fault.severity, DEVICE, f"{fault.robot}: {fault.message}", fault.remedy, path)


def turned(analysis: Analysis) -> Iterator[Finding]:
    """Say which flying robots begin turned: the third number of `start` is no height."""
    experiment = analysis.plan.experiment
    yaws = {name: robot.start[2] for name, robot in experiment.robots.items() if len(robot.start) == 3}
    flying = {name: yaw for name, yaw in yaws.items() if yaw and KINDS[experiment.robots[name].kind].flies}
    if flying:
        words = join_names([f"{name} by {degrees(yaw):.0f}°" for name, yaw in flying.items()])
        message = f"drones that begin turned to the left: {words}; the third number of `start` is the yaw [rad]"
        yield Finding("note", "turned", message, "", ("robots", next(iter(flying)), "start"))


def positioning(analysis: Analysis) -> Iterator[Finding]:
    """Warn of sources and robots that have nothing to do with each other; say which robots need a lab's own program."""
    experiment, measured = analysis.plan.experiment, analysis.plan.externally_measured
    unseen = [name for name in measured if experiment.robots[name].body == "twin"]
    if unseen and experiment.capture is not None:
        twin = KINDS[experiment.robots[unseen[0]].kind].twin
        message = f"{join_names(unseen)}: no motion capture sees a twin in its own process: `run` waits for positions"
        remedy = f'write body = "{twin.body}"' if twin else "leave `position` out"
        yield Finding("warning", "position-unseen", message, remedy, ("robots", unseen[0], "position"))
    if experiment.capture is not None and not measured:
        message = f'no robot has position = "external", so nothing is asked of {experiment.capture.source}'
        yield Finding("warning", "position-unused", message, "add it to each robot that is measured", ("positioning",))
    elif experiment.capture is None and measured:
        key = Keys(experiment.network.realm).position(measured[0])
        message = f"{join_names(measured)}: positions from outside, by a program that publishes {key}"
        remedy = 'or name a system: positioning = "optitrack://HOST"'
        yield Finding("note", "position-published", message, remedy, ("robots", measured[0], "position"))


def architecture(analysis: Analysis) -> Iterator[Finding]:
    """Describe the architecture; check the age of goals, and that the trigger suits guided robots."""
    experiment, path = analysis.plan.experiment, ("architecture",)
    guided = analysis.plan.guided
    if not guided:
        return
    all_guided, rate = len(guided) == len(experiment.robots), experiment.rates.coordination_hz
    subject = f"all {len(guided)} robots" if all_guided else join_names(guided)
    rest = "" if all_guided else "; the others decide for themselves, and receive their poses as before"
    hold = f"if it is gone, or its goals are older than {experiment.safety.neighbour_timeout_s:g} s, they hold"
    what = "centralised" if all_guided else "hybrid"
    yield Finding(
        "note", what, f"{what}: a centre decides for {subject} {rate:g} times a second{rest}; {hold}", "", path
    )
    if experiment.safety.neighbour_timeout_s <= 1.0 / rate:
        message = (
            f"goals come every {1.0 / rate:g} s, and are too old after {experiment.safety.neighbour_timeout_s:g} s"
        )
        remedy = "give safety.neighbour_timeout_s more than twice that, or decide more often"
        yield Finding("error", "goals-too-old", message, remedy, ("safety", "neighbour_timeout_s"))
    if analysis.plan.trigger.JUDGES_ERRORS:
        kind = analysis.plan.trigger_name
        message = f"the trigger '{kind}' judges by the formation error, which is 0 where the centre guides"
        yield Finding("warning", "error-unknown", message, "take another one, such as send-on-delta", ("trigger",))
