"""Checks of the predicted motion: starts, acquisition, collisions, speeds and rates."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from agents.body.kinds import Kind
from agents.decision.position_control import REACHED
from agents.errors import join_names
from agents.formation.link import BY_DISTANCE, BY_RELATIVE
from agents.plugins.planners import Planner
from agents.safety.hazards import Cause
from experiments.check import noise
from experiments.check.analysis import Analysis
from experiments.check.findings import FORGIVEN, Finding
from experiments.check.ideal_run import approaches
from experiments.check.realisation import OFF, mirrored_robots
from experiments.check.theory import strength
from experiments.definition.formation import anchor_offsets, law_offsets
from experiments.definition.graph import adjacency
from experiments.definition.links import gain_key
from experiments.definition.plan import Plan
from experiments.file.problems import Path
from experiments.metrics.signals import WINDOW_S
from twins.arrays import Array, Index, Mask, norm
from twins.models.quadrotor import GRAVITY

CLEARANCE: Final = 0.1  # [m] distance of one robot's top and another's bottom
NEARLY: Final = 0.9  # share of its speed: the rest is needed to catch up
LATE: Final = 0.25  # share of a run, at its end, in which a formation must be at rest
SWINGS: Final = 6.0  # ways of an error there, as multiples of its range, that make it an oscillation
WIDE: Final = 0.01  # [m] smaller swings of a law that has no tolerance are its trigger's
PROBED_S: Final = 0.02  # [s] time between the looked-at moments of a plan from a file
ACCELERATES_S: Final = 0.2  # [s] window of a mean acceleration
BEGINS_M: Final = 0.15  # [m] distance of a robot from the begin of its recording: less than a goal may be away
TILT: Final = math.radians(20.0)  # [rad] limit of tilt in the position controllers of small drones
SETTLED: Final = 1e-3  # [m] travel per decision below which robots are at rest, and in `WINDOW_S` one on wheels stands


def starts(analysis: Analysis) -> Iterator[Finding]:
    """Check that robots start inside the arena and clear of one another; flying ones too start on the floor."""
    names, limits = analysis.plan.names, analysis.limits
    start = analysis.start[:, :2]
    inside = np.minimum(start - limits.low[:2], np.array(limits.high[:2]) - start).min(axis=1) - analysis.radius
    problems = []
    for row in np.flatnonzero(inside < limits.margin - FORGIVEN):
        wall = f"{inside[row]:.2f} m from a wall" if inside[row] >= 0.0 else "in a wall"
        message = f"{names[row]} starts {wall}, inside the margin of {limits.margin:g} m"
        remedy = "start it farther inside, or reduce margin in [safety]"
        problems.append(Finding("warning", "start-margin", message, remedy, ("robots", names[row], "start")))
    for i, j in zip(*np.nonzero(np.triu(_overlap_at_start(analysis))), strict=True):
        first, second = names[i], names[j]
        apart = norm(start[i] - start[j])
        needed = analysis.plan.kinds[i].radius + analysis.plan.kinds[j].radius
        message = f"{first} and {second} start {apart:.2f} m apart, but need {needed:.2f} m to stand side by side"
        remedy = "all start on the floor, flying ones too: move one of them"
        problems.append(Finding("error", "start-overlap", message, remedy, ("robots", second, "start")))
    yield from problems
    if not problems:
        yield Finding("note", "starts", "every robot starts inside the arena, clear of the others")


def _overlap_at_start(analysis: Analysis) -> Mask:
    """(N, N) whether two robots are too near to stand side by side at the start."""
    start, radius = analysis.start, analysis.radius
    near: Mask = norm(start[:, None] - start) < radius[:, None] + radius - FORGIVEN
    return near & ~np.eye(len(start), dtype=bool)


def flight(analysis: Analysis) -> Iterator[Finding]:
    """Report disturbances or the stop of the ideal run, and the share of it that was flown."""
    prediction = analysis.prediction
    if prediction.stuck:
        message = f"the run does not begin, even undisturbed: {prediction.stuck}"
        yield Finding("error", "not-begun", message, "see what its robots wait for", ("robots",))
        return
    if _cut(analysis):
        message = f"flown for the first {prediction.end_s:g} s of {analysis.plan.experiment.duration_s:g} s only"
        yield Finding("note", "predicted-in-part", message, "", ("duration_s",))
    for row, each in prediction.incidents:
        if each.cause == Cause.BATTERY:  # a finding of its own, of all robots
            continue
        name = analysis.plan.names[row]
        message = f"{name} at {each.time:.1f} s, though nothing disturbs it: {each.text}"
        yield Finding("warning", "hazard", message, "see docs/safety.md for what this means", ("robots", name))


def _cut(analysis: Analysis) -> bool:
    """Whether only the first part of the run was flown."""
    experiment = analysis.plan.experiment
    return analysis.prediction.end_s < experiment.duration_s - 1.0 / experiment.rates.coordination_hz


def formation(analysis: Analysis) -> Iterator[Finding]:
    """Check that the formation is acquired, and kept at the end, without noise or with it."""
    swings = [] if analysis.is_gradient else [*_swings(analysis)]
    for finding in swings or _formation(analysis):
        yield noise.with_noise(analysis, finding)


def _formation(analysis: Analysis) -> Iterator[Finding]:
    experiment, prediction = analysis.plan.experiment, analysis.prediction
    last = analysis.error[-1]
    undecided = _cut(analysis) and last.max(initial=0.0) > experiment.tolerance
    if analysis.met_shape is None or prediction.stuck or not len(last) or undecided:
        return
    if (finding := _oscillation(analysis)) is not None:
        yield finding
        return
    end, worst = prediction.end_s, int(last.argmax())
    left = f"{analysis.link(worst)} is {1e3 * last[worst]:.0f} mm off after {end:g} s"
    allowed = f"(tolerance {1e3 * experiment.tolerance:g} mm)"
    if last[worst] <= experiment.tolerance:
        departure = analysis.departure
        formed = analysis.acquired(departure)
        if formed is not None:
            yield noise.acquired_note(analysis, formed, left)
            return
        at = int(np.searchsorted(prediction.time, departure + 1e-9)) - 1
        then = analysis.error[at]
        early = f"{analysis.link(int(then.argmax()))} is still {1e3 * then.max():.0f} mm off {allowed}"
        if (stopped := _stopped(analysis, at, early)) is not None:
            yield stopped
            return
        changes = any(each.at == departure for each in analysis.plan.formation.changes)
        what, path = ("shape changes", ("formation", "changes")) if changes else ("plans begin", ("timeline",))
        message = f"the formation is not acquired when the {what} at {departure:g} s: {early}"
        remedy = f"begin later, start nearer to the shape, or raise {strength(analysis)[0]}"
        if not analysis.is_gradient and (formed := analysis.acquired(end)) is not None:  # it may know how leaders move
            yield Finding("note", "acquired", f"{message}; it is after {formed:.1f} s, and at the end {left}")
            return
        yield Finding("warning", "acquired-late", message, remedy, path)
    elif not prediction.transmissions and experiment.architecture == "distributed":
        moved = float(norm(prediction.position - prediction.position[0]).max())
        message = (
            f"no robot transmits after its first pose: the trigger '{analysis.plan.trigger_name}' fires at nothing, "
            f"though robots move by up to {moved:.2g} m, so neighbours are believed at their starts; {left} {allowed}"
        )
        remedy = "look at the trigger's parameters: thresholds are in metres; maximum_silence_s bounds the silence"
        yield Finding("error", "silent", message, remedy, ("trigger",))
    elif (stopped := _stopped(analysis, -1, f"{left} {allowed}")) is not None:
        yield stopped
    elif analysis.stages[-1][0].worst > OFF:
        yield _another_shape(analysis, f"{left} {allowed}")
    elif np.ptp(prediction.position[-2:, analysis.without_neighbours], axis=0).max(initial=0.0) > SETTLED:
        message = f"the formation lags behind its leader: {left} {allowed}"
        remedy = f"lead more slowly, or raise {strength(analysis)[0]} or the clamp"
        yield Finding("warning", "lags", message, remedy, ("timeline",))
    else:
        formed = analysis.acquired(analysis.departure)
        before, late, other = "", "in time", "start nearer to the shape"
        if formed is not None:
            before, late = f", acquired after {formed:.1f} s,", f"again after {analysis.departure:g} s"
            other = "change or lead more slowly"
        message = f"the formation{before} is not acquired {late}: {left} {allowed}"
        remedy = f"give a longer duration_s, {other}, or raise {strength(analysis)[0]}"
        yield Finding("warning", "not-acquired", message, remedy, ("duration_s",))


def _another_shape(analysis: Analysis, left: str) -> Finding:
    """Finding that the robots end in a shape that does not meet their targets, stable or not."""
    message = f"from these starts the robots end in another shape, a local minimum: {left}"
    remedy = "start them nearer to the shape, in the order in which they stand in it"
    if analysis.grows_at(analysis.prediction.position[-1]):
        message = f"from these starts the robots balance in another shape, which a touch ends: {left}"
        remedy = "move the start of one of them off the line on which they stand; noise does it in time"
    elif turned := _on_the_wrong_side(analysis):
        message, remedy = f"{message}; {turned[0]}", turned[1]
    return Finding("warning", "local-minimum", message, remedy, ("formation", "links"))


def _swings(analysis: Analysis) -> Iterator[Finding]:
    """Check that no law that remembers, or gives velocities, swings to the end, whatever its links ask for."""
    links, position = analysis.plan.links, analysis.prediction.position
    if analysis.prediction.stuck or not len(links):
        return
    begin, swinging, ranges = _late_swings(analysis, norm(position[:, links.receiver] - position[:, links.sender]))
    swinging &= ranges > WIDE
    if swinging.any():
        time, link = analysis.prediction.time, int(np.where(swinging, ranges, 0.0).argmax())
        message = (
            f"the robots oscillate to the end: from {time[begin]:.0f} to {time[-1]:.0f} s the distance of "
            f"{analysis.link(link)} swings by {1e3 * ranges[link]:.0f} mm"
        )
        remedy = f"let the law '{analysis.plan.law_name}' ask for less, decide more often, or let bodies lag less"
        yield Finding("warning", "keeps-oscillating", message, remedy, ("formation", "law"))


def _late_swings(analysis: Analysis, lengths: Array) -> tuple[int, Mask, Array]:
    """First of the last samples, mask of the lengths (T, E) that change to and fro from there on, and ranges (E,) [m].

    None of them while leaders move.
    """
    time = analysis.prediction.time
    begin = int(np.argmax(time >= (1.0 - LATE) * time[-1]))
    late, led = lengths[begin:], analysis.prediction.position[begin:, analysis.without_neighbours]
    ways, ranges = np.abs(np.diff(late, axis=0)).sum(axis=0), np.ptp(late, axis=0)
    still = np.ptp(led, axis=0).max(initial=0.0) <= SETTLED
    return begin, (ways > SWINGS * ranges) & still, ranges


def _oscillation(analysis: Analysis) -> Finding | None:
    """Finding that a link is longer and shorter in turn to the end, by more than the tolerance; leaders stand then."""
    time, tolerance = analysis.prediction.time, analysis.plan.experiment.tolerance
    begin, swinging, ranges = _late_swings(analysis, analysis.error)
    late = analysis.error[begin:]
    swinging &= (ranges > tolerance / 2) & (late.max(axis=0) > tolerance)
    if not swinging.any():
        return None
    link = int(np.where(swinging, ranges, 0.0).argmax())
    message = (
        f"the formation oscillates to the end: from {time[begin]:.0f} to {time[-1]:.0f} s the error of "
        f"{analysis.link(link)} swings between {1e3 * late[:, link].min():.0f} and {1e3 * late[:, link].max():.0f} mm "
        f"(tolerance {1e3 * tolerance:g} mm)"
    )
    own, path = strength(analysis, BY_DISTANCE if analysis.asked.wants is None else BY_RELATIVE)
    remedy = f"the loop, not the starts, is at fault: lower {own}, or let bodies and messages lag less"
    return Finding("warning", "keeps-oscillating", message, remedy, path)


def anchors(analysis: Analysis) -> Iterator[Finding]:
    """Check that anchored robots reach their places."""
    plan, last = analysis.plan, analysis.anchored[-1]
    if analysis.met_shape is None or not len(last) or analysis.prediction.stuck or _cut(analysis):
        return
    name, worst = plan.names[plan.anchors_by_row[int(last.argmax())][0]], 1e3 * float(last.max())
    if worst <= 1e3 * plan.experiment.tolerance:
        message = f"anchored robots reach their places: {name} is {worst:.0f} mm off at the end"
        yield Finding("note", "anchored", message)
        return
    message = f"{name} is {worst:.0f} mm off its anchor after {analysis.prediction.end_s:g} s"
    remedy = "raise the gain of the anchor, start nearer to it, or give a longer duration_s"
    yield Finding("warning", "anchor-missed", message, remedy, ("formation", "anchors", name))


def _on_the_wrong_side(analysis: Analysis) -> tuple[str, str] | None:
    """Robots that end at the mirror image of their place in the shape, and the remedy; None if it does not help."""
    names, end = analysis.plan.names, analysis.prediction.position[-1]
    flips = mirrored_robots(analysis.first_links, end, analysis.placed, analysis.plan.anchors_by_row)
    if not flips:
        return None
    sides = [
        f"{names[each.row]} is on the wrong side of {names[each.ends[0]]} - {names[each.ends[1]]}" for each in flips
    ]
    place = ", ".join(f"{names[each.row]} near ({each.place[0]:.2f}, {each.place[1]:.2f})" for each in flips)
    return join_names(sides, 3), f"start it on the other side of that line: {place} in the room, as the others end"


def _stopped(analysis: Analysis, at: int, left: str) -> Finding | None:
    """Finding that wheeled robots which stand still at sample `at` prevent acquisition."""
    experiment, links = analysis.plan.experiment, analysis.plan.links
    if not analysis.is_gradient:
        return None
    off = np.flatnonzero(analysis.error[at] > experiment.tolerance)
    ends = np.union1d(links.receiver[off], links.sender[off])
    stopped = np.intersect1d(_standing_wheels(analysis, at), ends)
    if not len(stopped) or np.setdiff1d(ends, np.union1d(stopped, analysis.without_neighbours)).size:
        return None
    near = f"{1e3 * REACHED:g} mm"
    wants = BY_DISTANCE if links.wants is None or (links.wants[off] == BY_DISTANCE).any() else BY_RELATIVE
    own, path = strength(analysis, wants)
    name = gain_key(analysis.law, wants)
    message = (
        f"the formation is not acquired, because robots on wheels stop {near} before their goals: links may stay "
        f"e = {near}/{'(μ d²)' if name == 'gain' else 'k'} off; {left}"
    )
    if path[-1] == name:
        enough = 1.1 * getattr(experiment.formation, name) * float(analysis.error[at].max()) / experiment.tolerance
        own = f"{name} to {enough:.2g} or more"
    return Finding("warning", "wheels-stop", message, f"raise {own}, or allow a larger tolerance", path)


def _standing_wheels(analysis: Analysis, at: int) -> Index:
    """Rows on wheels that stand at sample `at`, because their goals are too near to drive to."""
    plan = analysis.plan
    time, position = analysis.prediction.time, analysis.prediction.position
    at %= len(time)
    here, before = position[at], position[max(0, at - round(WINDOW_S * plan.experiment.rates.coordination_hz))]
    links = plan.formation.at(float(time[at]))
    present = plan.formation.present(time[at : at + 1], position[at : at + 1])
    links = links if present is None else links.take(present[0])
    offset = law_offsets(analysis.law, here, here[links.sender], links) + anchor_offsets(plan.anchors_by_row, here)
    length, wheels = norm(offset[:, :2]), np.array([not kind.flies for kind in plan.kinds])
    return np.flatnonzero(
        wheels & (norm(here - before) < SETTLED) & (length > 0.1 * REACHED) & (length < 2.0 * REACHED)
    )


def encounters(analysis: Analysis) -> Iterator[Finding]:
    """Check that no robots collide or land on each other; pairs too near at the start are not repeated."""
    names, kinds, experiment = analysis.plan.names, analysis.plan.kinds, analysis.plan.experiment
    overlap = _overlap_at_start(analysis)
    near = [each for each in approaches(analysis.prediction, kinds, CLEARANCE) if not overlap[each.first, each.second]]
    for each in sorted(near, key=lambda each: (each.gap >= 0.0, each.distance)):
        first, second = names[each.first], names[each.second]
        path: Path = ("robots", second, "start")
        how, remedy = f"they touch at {each.touch:.2f} m", "move the start of one of them"
        if each.gap >= 0.0:
            how = f"one is above the other then, with {each.gap:.2f} m between them, less than {CLEARANCE:g} m"
            remedy = "hold heights that are farther apart"
        elif begun := [start for start in _manoeuvres(analysis.plan) if start[0] < each.time]:
            _, path = max(begun, key=lambda start: start[0])
            remedy = (
                "give robots other ways or places from here on, or add an avoidance (`./zenpark explain avoidance`)"
            )
        message = f"{first} and {second} come within {each.distance:.2f} m at {each.time:.1f} s; {how}"
        message += analysis.sources(each.time, first, second)
        if experiment.avoidance is None or not (experiment.robots[first].avoids or experiment.robots[second].avoids):
            yield Finding("warning", "too-close", message, remedy, path)
        else:
            yield Finding("note", "avoidance-acts", f"{message}: avoidance will have to act", "", path)
    if _cut(analysis) or analysis.prediction.stuck:
        return
    final, radius = analysis.prediction.position[-1], analysis.radius
    heard = adjacency(analysis.plan.links, len(names)) > 0
    for row in np.flatnonzero([kind.flies for kind in kinds]):
        below = (final[:, 2] < final[row, 2] - FORGIVEN) & (norm(final[:, :2] - final[row, :2]) < radius + radius[row])
        for under in np.flatnonzero(below):
            ends, targets = f"{names[row]} ends above {names[under]}", ("formation", "links")
            if heard[row, under]:
                yield Finding("note", "lands-beside", f"{ends}, and goes aside before it lands", "", targets)
                continue
            message = f"{ends}, from which it receives no poses, and would land on it"
            remedy = "change their distances, link them, or end the timeline elsewhere"
            yield Finding("warning", "lands-on", message, remedy, targets)


def _manoeuvres(plan: Plan) -> list[tuple[float, Path]]:
    """Begin [s] and place of every leg and every change of the shape."""
    legs: list[tuple[float, Path]] = [(each.at_s, ("timeline", k)) for k, each in enumerate(plan.experiment.timeline)]
    changes = enumerate(plan.experiment.formation.changes)
    return [*legs, *((each.at_s, ("formation", "changes", k)) for k, each in changes)]


def speeds(analysis: Analysis) -> Iterator[Finding]:
    """Check that plans ask for no more speed than the robots have."""
    names, experiment = analysis.plan.names, analysis.plan.experiment
    problems = []
    for number, robot, plan in analysis.legs:
        row, asked = names.index(robot), plan.speed()
        path = ("timeline", number, "plan")
        leads = row in analysis.without_neighbours
        has = float((analysis.speed if leads else analysis.pull)[row])
        what = f"the leg at {experiment.timeline[number].at_s:g} s asks {robot} for {asked:.3g} m/s"
        remedy = f"plan for less than {NEARLY * has:.2g} m/s"
        if plan.source(0.0):
            elapsed, places = _probed(plan, np.zeros(3), experiment.duration_s)
            what = f"{plan.source(elapsed[int(norm(np.diff(places, axis=0)).argmax())])}: {what}"
            slower = getattr(plan, "stretch", 1.0) * asked / (NEARLY * has)
            remedy = f"write stretch = {math.ceil(10.0 * slower) / 10.0:g}, which makes it slower"
        if leads and asked > has * (1.0 + 1e-9):
            problems.append(Finding("error", "leader-too-fast", f"{what}; it has {has:.3g} m/s", remedy, path))
        elif asked > NEARLY * has:
            message = f"{what} of the {has:.3g} m/s at which it can follow a plan: it cannot catch up"
            problems.append(Finding("warning", "leader-near-limit", message, remedy, path))
    fastest = analysis.fastest
    if fastest is not None and analysis.follower is not None:
        number, robot, plan = fastest
        has, asked = float(analysis.pull[analysis.follower]), plan.speed()
        if has < asked:
            rates = f"follows at {has:.2g} m/s at most, {robot} leads at {asked:.2g} m/s"
            message = f"{names[analysis.follower]} {rates}: it lags, and catches up afterwards"
            remedy = "lead more slowly"
            if asked <= analysis.speed[analysis.follower]:
                clamp = math.ceil(110.0 * experiment.formation.clamp * asked / has) / 100.0
                remedy += f", or raise clamp in [formation] to {clamp:g}"
            problems.append(Finding("warning", "followers-lag", message, remedy, ("timeline", number, "plan")))
    yield from problems
    if not problems and fastest is not None:
        most = f"{fastest[2].speed():.2g} m/s at most"
        yield Finding("note", "speeds", f"no plan asks for more than the robots have ({most})")


def recordings(analysis: Analysis) -> Iterator[Finding]:
    """Check that plans from files begin at their robots, stay in the arena and accelerate no faster than these can."""
    timeline, limits = analysis.plan.experiment.timeline, analysis.limits
    track, rate = analysis.prediction.position, analysis.plan.experiment.rates.coordination_hz
    for number, robot, plan in analysis.legs:
        if not plan.source(0.0):
            continue
        row, at = analysis.plan.names.index(robot), timeline[number].at_s
        where: Path = ("timeline", number, "plan")
        later = [leg.at_s for leg in timeline[number + 1 :] if leg.robot == robot]
        place = track[min(round(at * rate), len(track) - 1), row]
        elapsed, path = _probed(plan, place, min([analysis.plan.experiment.duration_s, *later]) - at)
        found = [*_begins_elsewhere(robot, plan, path[0], place, where)]
        beyond = np.maximum(path - limits.high, limits.low - path).max(axis=1)
        leaves = np.maximum(track[:, row] - limits.high, limits.low - track[:, row]).max() > FORGIVEN
        if (beyond > FORGIVEN).any() and not leaves:  # else it is a finding of `walls`
            k = int((beyond > FORGIVEN).argmax())
            x, y, z = path[k]
            message = f"{plan.source(elapsed[k])}: it leads {robot} out of the arena, to ({x:.2f}, {y:.2f}, {z:.2f})"
            remedy = "enlarge size in [arena] if the room is larger, write relative = true, or shorten it with until_s"
            found.append(Finding("error", "recording-outside", message, remedy, where))
        k, most = _largest_acceleration(path)
        limit = _acceleration_limit(analysis.plan.kinds[row])
        if most > limit:
            stretch = math.ceil(10.0 * getattr(plan, "stretch", 1.0) * math.sqrt(most / limit)) / 10.0
            message = f"{plan.source(elapsed[k])}: it asks {robot} for {most:.2g} m/s², which has {limit:.2g} m/s²"
            remedy = f"write stretch = {stretch:g}, which makes it slower"
            found.append(Finding("warning", "recording-too-sharp", message, remedy, where))
        yield from found
        if not found:
            message = f"{robot} follows {plan.source(0.0).partition(',')[0]}: {plan.speed():.2g} m/s, {most:.2g} m/s²"
            yield Finding("note", "recordings", f"{message} at most", "", where)


def _probed(plan: Planner, anchor: Array, lasts_s: float) -> tuple[list[float], Array]:
    """Times since the leg began [s] (K), two or more, and the targets there (K, 3) [m]."""
    lasts_s = min(lasts_s, getattr(plan, "duration", lasts_s) + 1.0)
    elapsed = [PROBED_S * k for k in range(max(math.ceil(lasts_s / PROBED_S), 2))]
    return elapsed, np.array([plan.target(t, tuple(anchor.tolist()), 0.0)[:3] for t in elapsed])


def _begins_elsewhere(robot: str, plan: Planner, first: Array, place: Array, where: Path) -> Iterator[Finding]:
    """Finding that a plan begins where its robot is not."""
    away = float(norm(first - place))
    if away > BEGINS_M:
        (x, y, z), (at_x, at_y, at_z) = first, place
        message = (
            f"{plan.source(0.0)}: it begins at ({x:.2f}, {y:.2f}, {z:.2f}), {away:.2f} m from {robot}, "
            f"which is at ({at_x:.2f}, {at_y:.2f}, {at_z:.2f}) then"
        )
        remedy = (
            "write relative = true, change start or hover, begin later in the file (from_s), or lead it there before"
        )
        yield Finding("error", "recording-begins-elsewhere", message, remedy, where)


def _largest_acceleration(path: Array) -> tuple[int, float]:
    """Sample at which the mean acceleration over two windows is largest, and that [m/s²].

    Over windows, because noise and corners of a recording have any acceleration in a moment.
    """
    step = round(ACCELERATES_S / PROBED_S)
    if len(path) <= 2 * step:
        return 0, 0.0
    bend = norm(path[2 * step :] - 2.0 * path[step:-step] + path[: -2 * step]) / ACCELERATES_S**2
    at = int(bend.argmax())
    return at + step, float(bend[at])


def _acceleration_limit(kind: Kind) -> float:
    """Largest acceleration of a kind in its plane of motion [m/s²]."""
    return GRAVITY * math.tan(TILT) if kind.flies else float(getattr(kind.motion, "acceleration", math.inf))


def turning_circle(analysis: Analysis) -> Iterator[Finding]:
    """Report robots that cannot turn on the spot and follow goals that a gradient law moves a little at a time."""
    plan = analysis.plan
    wide = [row for row in np.unique(plan.links.receiver) if plan.kinds[row].turn_radius > 0.0]
    if analysis.is_gradient and wide:
        names, radius = [plan.names[row] for row in wide], max(plan.kinds[row].turn_radius for row in wide)
        reason = f"cannot turn on the spot (radius up to {radius:g} m), and the goals of a gradient law are nearer"
        message = f"{join_names(names)} {reason}: shuffling"
        remedy = "lead by a plan, or choose a law that gives velocities, or another kind"
        yield Finding("warning", "turning-circle", message, remedy, ("robots", names[0], "kind"))


def rates(analysis: Analysis) -> Iterator[Finding]:
    """Check the rates: trigger period against pose_hz, pose_hz against coordination_hz."""
    rates, trigger = analysis.plan.experiment.rates, analysis.plan.trigger
    asked = 1.0 / rates.pose_hz
    for field in ("period_s", "maximum_silence_s"):
        period = getattr(trigger, field, math.inf)
        if not 0.0 < period < math.inf:
            continue
        times, path = period / asked, ("trigger", field)
        message = f"the trigger asks for a transmission every {period:g} s, but is asked every {asked:g} s"
        if times < 1.0 - FORGIVEN:
            remedy = f"raise pose_hz in [rates] to {1.0 / period:g}, or {field} to {asked:g}"
            yield Finding("warning", "trigger-too-fast", message, remedy, path)
        elif field == "period_s" and abs(times - round(times)) > FORGIVEN * times:
            message += f": it transmits every {math.ceil(times) * asked:g} s"
            yield Finding("warning", "trigger-uneven", message, f"use a multiple of {asked:g}", path)
    if rates.pose_hz < rates.coordination_hz:
        message = f"decisions at {rates.coordination_hz:g} Hz see poses that come at {rates.pose_hz:g} Hz at most"
        remedy = "raise pose_hz, or lower coordination_hz"
        yield Finding("warning", "decides-unheard", message, remedy, ("rates", "pose_hz"))


def ends(analysis: Analysis) -> Iterator[Finding]:
    """Check that the last leg of each robot ends before the run."""
    experiment, duration = analysis.plan.experiment, analysis.plan.experiment.duration_s
    last = {robot: (number, plan) for number, robot, plan in analysis.legs}
    for robot, (number, plan) in last.items():
        at, row = experiment.timeline[number].at_s, analysis.plan.names.index(robot)
        when = min(round(at * experiment.rates.coordination_hz), len(analysis.prediction.time) - 1)
        lasts = _plan_duration(plan, analysis.prediction.position[when, row], experiment.robots[robot].start)
        if lasts is not None and at + lasts > duration * (1.0 + 1e-9) + 0.1:
            message = f"the leg of {robot} at {at:g} s lasts {lasts:.3g} s, but the run ends at {duration:g} s"
            remedy = f"give a duration_s of {math.ceil(at + lasts):g} or more, or a faster or shorter plan"
            yield Finding("warning", "leg-cut", message, remedy, ("timeline", number, "plan"))


def _plan_duration(plan: Planner, anchor: Array, start: Sequence[float]) -> float | None:
    """Duration for which a plan moves its robot [s], to within 1 %; None: for ever."""
    elapsed, (_, _, heading) = np.geomspace(0.01, 1e6, 2000), (*start, 0.0)[:3]
    target = np.array([plan.target(t, tuple(anchor.tolist()), heading)[:3] for t in elapsed.tolist()])
    away = np.flatnonzero(norm(target - target[-1]) > OFF)
    if not len(away):
        return 0.0
    return float(elapsed[away[-1] + 1]) if away[-1] < len(elapsed) - 50 else None
