"""Checks by theory: connectivity, realisation, rigidity, redundancy and stability of a formation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

from agents.decision.goals import GoalComputer
from agents.decision.stepping import Stepping
from agents.errors import did_you_mean, join_names
from agents.formation.link import BY_BEARING, BY_DISTANCE, BY_RELATIVE
from agents.network import messages
from agents.plugins.calls import unknown_reads
from agents.plugins.laws import Gradient
from agents.vectors import ZERO
from experiments.check.analysis import FAR_OFF, Analysis
from experiments.check.findings import FORGIVEN, Finding, Severity
from experiments.check.realisation import OFF, Conflict, Shape, best_shape, conflicts, contradictions, drawn_bearings
from experiments.definition.experiment import Formation
from experiments.definition.formation import law_offsets, unlinked
from experiments.definition.graph import components, edges, reachable
from experiments.definition.links import gain_key
from experiments.definition.plan import Plan
from experiments.file.problems import Path
from twins.arrays import Index, Mask, norm

BENT: Final = 8.0  # times the noise: formations that no straight line or circle weakens move by 1 to 5 times
FEW: Final = 6  # names that are listed
GAIN: Final = {"gain": "the gain", "stiffness": "the stiffness", "by link": "the gain or the stiffness"}  # names
UNSTABLE_GAIN: Final = 2.0  # share of an error that one decision corrects
# of a pose: running number, stamp [s], position [m] and velocity [m/s]
LONG_POSE: Final = (1_000_000, 1.7e9 + 0.123456, (-1.234567,) * 3, (-0.123456,) * 3)
LONG_YAW: Final = -1.234567  # [rad]
LONG_NUMBER: Final = -1.234567e-05  # longest number that is said
MILLIMETRES: Final = 50.0  # [m] a longer link is probably written in millimetres
OSCILLATING_GAIN: Final = 1.2  # limit of the gain: an error changes its sign beyond 1; no model has the lag up to 2


def network(analysis: Analysis) -> Iterator[Finding]:
    """Check that the network is connected, and that every robot is reached by a leader."""
    experiment, names, links = analysis.plan.experiment, analysis.plan.names, analysis.plan.links
    path, rows = ("formation", "links"), len(names)
    problems = list[Finding]()
    if not len(links):
        how = "goes to its anchor" if experiment.formation.anchors else "follows its own plan"
        yield Finding("note", "no-formation", f"no links: every robot {how}, or stays where it is")
        return
    linked = np.union1d(links.receiver, links.sender)
    named = experiment.formation.leader
    leaders = [name for name in analysis.plan.leaders if name == named or names.index(name) in linked]
    anchored = np.array([row for row, _ in analysis.plan.anchors_by_row], dtype=np.intp)
    if leaders:
        sources = np.union1d([names.index(name) for name in leaders], anchored)  # an anchored robot is led by its place
        lost = np.setdiff1d(links.receiver, np.flatnonzero(reachable(links, rows, sources)))
        if len(lost):
            subject = join_names([names[row] for row in lost])
            message = f"{subject} cannot be reached by the leader ({join_names(leaders)}), directly or through others"
            remedy = f'add a link to one that does, such as "{leaders[0]} > {names[lost[0]]}"'
            problems.append(Finding("error", "leader-unknown", message, remedy, path))
    parts = analysis.parts - (rows - len(linked))  # robots without links go their own way
    if parts > 1 and len(anchored) and reachable(links, rows, anchored)[linked].all():
        yield Finding("note", "parts", f"{parts} formations, each of which is anchored", "", path)
    elif parts > 1 and experiment.avoidance is not None and len(leaders) >= analysis.parts:
        yield Finding("note", "parts", f"{parts} formations that know of each other only to keep clear", "", path)
    elif parts > 1:
        message = f"the network falls into {parts} parts that know nothing of each other"
        remedy = "join them by links, or make them separate experiments"
        problems.append(Finding("error", "parts", message, remedy, path))
    isolated = [names[row] for row in analysis.without_neighbours if names[row] not in leaders]
    if isolated:
        message = f"{join_names(isolated)} has no links: it takes no part in the formation"
        remedy = f'add "... > {isolated[0]}" to its links'
        problems.append(Finding("warning", "no-incoming-links", message, remedy, path))
    severity: Severity = "error" if len(leaders) == 1 else "warning"
    for name in leaders:
        if names.index(name) not in links.sender:
            message, remedy = f"no robot receives from the leader {name}", f'add "{name} > ..." for one of the others'
            problems.append(Finding(severity, "leader-not-received", message, remedy, path))
    yield from problems
    if not problems:
        whole = "the network is whole; " if analysis.parts == 1 else ""
        reached = f"every robot is reached by {join_names(leaders)}"
        led = reached if leaders else "no leader: the formation finds its own place"
        yield Finding("note", "connected", whole + led)


def lengths(analysis: Analysis) -> Iterator[Finding]:
    """Check that distances are no millimetres: most of them longer than the arena."""
    distance, size = analysis.asked.distance[_measured(analysis)], np.array(analysis.plan.experiment.arena.size)
    if not analysis.has_targets or not len(distance) or np.median(distance) <= norm(size):
        return
    longest = int(np.flatnonzero(_measured(analysis))[distance.argmax()])
    asked, whole = float(distance.max()), " × ".join(f"{length:g}" for length in size)
    message = f"{analysis.link(longest)} asks for {asked:g} m in an arena of {whole} m"
    remedy = "lengths are in metres; enlarge size in [arena] if it is meant"
    if asked >= MILLIMETRES:
        message, remedy = f"{message}: millimetres?", f"lengths are in metres: write {asked / 1e3:g}"
    yield Finding("error", "too-long", message, remedy, analysis.link_path(longest))


def realisation(analysis: Analysis) -> Iterator[Finding]:
    """Check that the targets of links and anchors can be met with held heights, at the start and after changes."""
    shape = analysis.shape
    if shape is None:
        return
    if shape.worst <= OFF and len(shape.overlaps):
        yield _in_one_place(analysis, shape)
    elif shape.worst <= OFF:
        yield Finding("note", "realisable", f"{_asked(analysis)} can be met to {1e3 * shape.worst:.1f} mm")
    else:
        yield from _unrealisable(analysis, shape)
    given = analysis.plan.experiment.formation.changes
    in_order = sorted(range(len(given)), key=lambda k: given[k].at_s)  # their numbers in the file
    for number, later in zip(in_order, map(best_shape, analysis.stages[1:]), strict=True):
        if later.worst > OFF and shape.worst <= OFF:
            severity: Severity = "error" if later.worst > FAR_OFF else "warning"
            worst = analysis.link(int(later.error.argmax()))
            message = f"the shape after this change cannot be met: at best, {worst} is {1e3 * later.worst:.1f} mm off"
            remedy = "change the other links with it, or by less; heights are held"
            yield Finding(severity, "change-not-realisable", message, remedy, ("formation", "changes", number))


def _asked(analysis: Analysis) -> str:
    """Kinds of targets of the links, in words."""
    wants = analysis.asked.wants
    found = set() if not analysis.standing.any() else {BY_DISTANCE}
    found = found if wants is None else set(wants[analysis.standing].tolist())
    words = {BY_DISTANCE: "distances", BY_RELATIVE: "offsets", BY_BEARING: "bearings"}
    return "the " + " and ".join([word for want, word in words.items() if want in found] or ["anchors"])


def _in_one_place(analysis: Analysis, shape: Shape) -> Finding:
    """Finding on targets that are met only where robots stand in one another."""
    links = analysis.asked
    wants = np.zeros(len(links)) if links.wants is None else links.wants
    directed = np.flatnonzero(analysis.standing & (wants == BY_BEARING))
    # robots in one point meet any direction
    if len(directed) and not drawn_bearings(links.take(directed), len(shape.position))[1]:
        away = norm(shape.position[links.receiver] - shape.position[links.sender])
        at_fault = [k for k in directed if away[k] < OFF] or [*directed]
        pairs = join_names(list(dict.fromkeys(_pair(analysis, k) for k in at_fault)))
        message = f"the directions of {pairs} contradict one another: only robots in one point meet them"
        severity: Severity = "error" if analysis.is_gradient else "warning"
        remedy = "give directions that one drawing has, or fewer of them"
        return Finding(severity, "not-realisable", message, remedy, analysis.link_path(int(at_fault[0])))
    names, (first, second) = analysis.plan.names, shape.overlaps[0].tolist()
    apart = float(norm((shape.position[first] - shape.position[second])[:2]))
    more = f", and {len(shape.overlaps) - 1} more like this" if len(shape.overlaps) > 1 else ""
    message = (
        f"no shape was found that meets {_asked(analysis)} and keeps robots out of one another: {names[first]} and "
        f"{names[second]} would stand {apart:.2f} m apart{more}"
    )
    wanted = _measured(analysis)[analysis.standing].all()  # vectors leave no choice, so that this was meant, perhaps
    remedy = "hold other heights, change the targets, or link these robots"
    return Finding("error" if wanted else "warning", "in-one-place", message, remedy, ("formation", "links"))


def _contradictions(analysis: Analysis, severity: Severity, more: str = "") -> Iterator[Finding]:
    """Finding on the shortest ring of links with offsets that do not add up."""
    for ring in contradictions(analysis.first_links)[:1]:
        names = [analysis.plan.names[row] for row in ring.rows]
        way = f"around {join_names([*names, names[0]], 8)}" if len(names) > 2 else f"between {names[0]} and {names[1]}"
        message = f"the offsets {way} do not add up: their ends are {1e3 * ring.gap:.1f} mm apart{more}"
        link = int(np.flatnonzero(analysis.standing)[ring.link])
        remedy = "give offsets of one drawing: those around a ring add up to zero"
        yield Finding(severity, "offsets-contradict", message, remedy, analysis.link_path(link))


def _unrealisable(analysis: Analysis, shape: Shape) -> Iterator[Finding]:
    severity: Severity = "error" if shape.worst > FAR_OFF and analysis.is_gradient else "warning"
    anchors = analysis.plan.anchors_by_row
    if anchors and shape.anchored.max(initial=0.0) >= shape.error.max(initial=0.0):
        name = analysis.plan.names[anchors[int(shape.anchored.argmax())][0]]
        message = f"{name} cannot keep the distance of its anchor: at best, it is {1e3 * shape.worst:.1f} mm off"
        remedy = "change it, or the links of this robot; it holds its height, and distances are in space"
        yield Finding(severity, "anchor-not-realisable", message, remedy, ("formation", "anchors", name))
        return
    off = f"at best, {analysis.link(int(shape.error.argmax()))} is {1e3 * shape.worst:.1f} mm off"
    rings = list(_contradictions(analysis, severity, f"; {off}"))
    yield from rings
    found = conflicts(analysis.asked.take(_measured(analysis)), analysis.height)
    heights = [each for each in found if math.isfinite(each.ceiling)]
    for high in list(dict.fromkeys(each.high for each in heights)):
        lowest = min((each for each in heights if each.high == high), key=lambda each: each.ceiling)
        yield _too_high(analysis, lowest, off)
    for conflict in [each for each in found if not math.isfinite(each.ceiling)]:
        inside = _inside(analysis, conflict)
        longest = int(inside[analysis.asked.distance[inside].argmax()])
        sides = _sides(analysis, conflict)
        message = f"{sides} make no triangle: the longest is longer than the others together; {off}"
        remedy = f"shorten {analysis.link(longest)}, or lengthen the other two"
        yield Finding(severity, "no-triangle", message, remedy, analysis.link_path(longest))
    if not found and not rings:
        worst = [int(k) for k in np.argsort(-shape.error) if shape.error[k] > shape.worst / 2]
        at_fault = join_names(list(dict.fromkeys(_pair(analysis, k) for k in worst)))
        message = f"{_asked(analysis)} contradict one another around {at_fault}; {off}"
        remedy = f"give {_asked(analysis)[4:]} that one drawing has, or fewer of them"
        if len(analysis.without_neighbours) > 1:
            remedy += "; the leaders' own places count as well"
        yield Finding(severity, "not-realisable", message, remedy, analysis.link_path(worst[0]))


def _measured(analysis: Analysis) -> Mask:
    """Mask (E,) of the links that stand at the start and ask for a distance."""
    wants = analysis.asked.wants
    return analysis.standing if wants is None else analysis.standing & (wants == BY_DISTANCE)


def _inside(analysis: Analysis, conflict: Conflict) -> Index:
    """The links by distance among the robots of a conflict."""
    links, rows = analysis.asked, conflict.rows
    return np.flatnonzero(_measured(analysis) & np.isin(links.receiver, rows) & np.isin(links.sender, rows))


def _pair(analysis: Analysis, link: int | np.intp) -> str:
    """Name of a link, the same for both directions."""
    links = analysis.plan.links
    i, j = sorted((int(links.sender[link]), int(links.receiver[link])))
    return f"{analysis.plan.names[i]} - {analysis.plan.names[j]}"


def _sides(analysis: Analysis, conflict: Conflict) -> str:
    distance = analysis.asked.distance
    sides = {_pair(analysis, k): f"{_pair(analysis, k)} ({distance[k]:g} m)" for k in _inside(analysis, conflict)}
    return ", ".join(sides.values())


def _too_high(analysis: Analysis, conflict: Conflict, off: str) -> Finding:
    names = analysis.plan.names
    subject = join_names([names[row] for row in conflict.high])
    held = max(float(analysis.height[row]) for row in conflict.high)
    message = f"{subject} is too high at {held:g} m for {_sides(analysis, conflict)}; {off}"
    remedy = f"hover lower than {conflict.ceiling:.3f} m, or lengthen these links"
    return Finding("error", "too-high", message, remedy, ("robots", names[conflict.high[0]], "hover"))


def rigidity(analysis: Analysis) -> Iterator[Finding]:
    """Check rigidity in the motions that the robots have, and how far noise bends the formation."""
    planar, spatial = analysis.rigidity
    if planar is None or not analysis.standing.any() or analysis.parts > 1:
        return
    rank, path = f"rank {planar.rank} of {planar.needed} in the motions that the robots have", ("formation", "links")
    bent = analysis.bend
    if bent is not None and BENT * analysis.sigma < bent.way < math.inf:
        first = "to first order no link resists" if not planar.rigid else "hardly a link resists"
        message = (
            f"the formation bends, {rank}: {first}; noise of {1e3 * analysis.sigma:g} mm moves "
            f"{analysis.plan.names[bent.row]} by some {1e3 * bent.way:.0f} mm"
        )
        yield Finding("warning", "bends", message, _stiffer(analysis, planar.needed - planar.rank), path)
    elif not planar.rigid:
        asked = {"the distances": "every distance"}.get(_asked(analysis), _asked(analysis))
        message = f"the formation is not rigid, {rank}: it can change its shape and still meet {asked}"
        yield Finding("warning", "not-rigid", message, _stiffer(analysis, planar.needed - planar.rank), path)
    else:
        if spatial is not None and not spatial.rigid:
            rank += f"; in space {spatial.rank} of {spatial.needed}, not needed while heights are held"
        yield Finding("note", "rigid", f"the formation is rigid, {rank}")


def _stiffer(analysis: Analysis, missing: int) -> str:
    """Remedy for a formation that bends."""
    count = len(analysis.plan.names)
    if len(edges(analysis.first_links)) == count * (count - 1) // 2:
        return "all robots are linked: change targets that put them in one line or on one circle"
    more = max(missing, 1)
    return f"add {more} link{'s' * (more > 1)} at least, between robots that are not linked yet"


def presence(analysis: Analysis) -> Iterator[Finding]:
    """Check that the network stays connected along the predicted motion while links come and go."""
    plan, time = analysis.plan, analysis.prediction.time
    present = plan.formation.present(time, analysis.prediction.position)
    if present is None or analysis.parts > 1:
        return
    begins = np.concatenate([[0], 1 + np.flatnonzero((present[1:] != present[:-1]).any(axis=1))])
    apart = np.array([components(plan.links.take(mask), len(plan.names)) for mask in present[begins]])
    if (apart == 1).all():
        count = present.sum(axis=1)
        message = f"links come and go, {count.min()} to {count.max()} at a time, and the network is always whole"
        yield Finding("note", "whole", message)
        return
    first = int((apart > 1).argmax())
    begin, end = [*time[begins], plan.experiment.duration_s][first : first + 2]
    message = (
        f"the network falls into {apart[first]} parts from {begin:.1f} s to {end:.1f} s, because links come and go"
    )
    path: Path = ("formation", "links")
    remedy = "let links overlap in time"
    if plan.experiment.formation.proximity is not None:
        path, remedy = ("formation", "proximity", "range"), "start nearer to each other, or give a longer range"
    yield Finding("warning", "comes-apart", message, remedy, path)


def redundancy(analysis: Analysis) -> Iterator[Finding]:
    """Report the single links and robots that the formation can lose and stay rigid."""
    if analysis.spare is not None and analysis.parts == 1:
        links = _lost("link", len(analysis.spare.pairs), analysis.vital_links)
        robots = _lost("robot", len(analysis.spare.robots), analysis.vital_robots)
        yield Finding("note", "redundancy", f"{links}; {robots}")


def _lost(what: str, count: int, needed: Sequence[str]) -> str:
    """Sentence on what can be lost."""
    if not needed:
        return f"it stays rigid without any one {what}"
    if len(needed) == count:
        return f"it stays rigid only with every {what}"
    if len(needed) > FEW:
        return f"{count - len(needed)} of its {count} {what}s can be lost, one at a time"
    return f"it stays rigid without any one {what} but {join_names(needed)}"


def law(analysis: Analysis) -> Iterator[Finding]:
    """Theory of a law that remembers, as the law knows it, and words that must not be lost."""
    plan, path = analysis.plan, ("formation", "law")
    channel = plan.experiment.channel
    losses = [channel.loss, *(each.loss or 0.0 for each in channel.links.values())]
    if channel.loss >= 1.0 and len(plan.links):
        message, remedy = "no message ever arrives: all of them are lost", "give a loss below 1, such as 0.2"
        yield Finding("error", "all-lost", message, remedy, ("channel", "loss"))
    if plan.law.SAYS and max(losses) > 0.0 and math.isinf(plan.trigger.maximum_silence_s) and not plan.trigger.TIMED:
        message = "messages are lost, and the trigger may stay silent for ever: what was said last is not repeated"
        remedy = "give the trigger maximum_silence_s, such as 1.0"
        yield Finding("warning", "lost-words", message, remedy, ("trigger",))
    if reads := "" if analysis.is_gradient or analysis.prediction.stuck else _unknown_reads(analysis):
        message = f"the law '{plan.law_name}' gives a number in spite of an unknown one{reads}"
        yield Finding("warning", "reads-unknown", message, "a comparison with an unknown number is false", path)
    for severity, message, remedy in plan.law.analyse(plan):
        yield Finding(severity, "law", message, remedy, path)


def unused_gains(plans: Sequence[Plan]) -> Iterator[Finding]:
    """Warn of a gain of [formation] that is set, while the laws of all cases pull by the other one."""
    for key, other in (("gain", "stiffness"), ("stiffness", "gain")):
        default = getattr(Formation(), key)
        given = [plan.experiment.formation for plan in plans]
        if any(each.anchors for each in given) or not any(getattr(each, key) != default for each in given):
            continue
        if all(isinstance(plan.law, Gradient) and other == plan.law.PULLS_BY for plan in plans):
            laws = join_names(sorted({f"'{plan.law_name}'" for plan in plans}))
            message = f"{key} is not used by the law {laws}, which pulls by {other}"
            yield Finding("warning", "unused-gain", message, f"write {other} instead", ("formation", key))


def unknown_robots(plans: Sequence[Plan]) -> Iterator[Finding]:
    """Warn of a table of a law with values by robot, in which a name is that of no robot of any case."""
    robots = {name for plan in plans for name in plan.experiment.robots}
    found: dict[tuple[str, str], str] = {}
    for plan in plans:
        for key, table in msgspec.structs.asdict(plan.law).items():
            if isinstance(table, Mapping) and robots & table.keys():
                found |= {(key, name): plan.law_name for name in table if name not in robots}
    for (key, name), law_name in found.items():
        message = f"{key} of the law '{law_name}' has a value for '{name}', and no robot is called so"
        remedy = did_you_mean(name, robots)
        yield Finding("warning", "unknown-robot", message, remedy, ("formation", "law", key, name))


def _unknown_reads(analysis: Analysis) -> str:
    """Words on what the law of the first robot with neighbours reads at the start although it is unknown."""
    plan, starts = analysis.plan, analysis.start.tolist()
    if not len(analysis.plan.links):
        return ""
    row = int(analysis.plan.links.receiver[0])
    goals = GoalComputer(plan.assignment(plan.names[row], centrally=plan.names[row] in plan.guided))
    for number, sender in enumerate(goals.neighbours.all):
        goals.neighbours.mark_alive(number)
        goals.neighbours.receive(number, tuple(starts[sender.sender]), ZERO, 0.0, 0.0)
    goals.update_links(0.0)
    return goals.unknown_reads(0.0, tuple(starts[row]))


def load(analysis: Analysis) -> tuple[int, int, float]:
    """Payload of a pose with its numbers at their longest, and of what is said [bytes]; its largest rate [kbit/s]."""
    plan, experiment = analysis.plan, analysis.plan.experiment
    name = max(analysis.plan.names, key=len)
    said = Stepping(plan.assignment(name)).says if plan.law.SAYS else {}
    bare, whole = (
        len(messages.encode(messages.pose(name, *LONG_POSE, yaw=LONG_YAW, words=words), experiment.network.encoding))
        for words in ((), [(variable, (LONG_NUMBER,) * size) for variable, size in said.items()])
    )
    rate = experiment.rates.pose_hz
    if plan.trigger.TIMED:
        rate = min(rate, analysis.prediction.messages_hz / len(analysis.plan.names))
    return whole, whole - bare, 8e-3 * whole * rate


def strength(analysis: Analysis, wants: int = BY_DISTANCE) -> tuple[str, Path]:
    """Parameters that make the law ask for more or less, in words and by their place in the file.

    The gain of [formation] for links with such a target, or the law's own parameters if it goes by these alone.
    """
    law, links = analysis.law, analysis.asked
    alone = f"the law's own parameters ({', '.join(law.__struct_fields__) or 'it has none yet'})", ("formation", "law")
    if not analysis.is_gradient:
        return alone
    place = analysis.start + 0.1 * np.random.default_rng(0).normal(size=analysis.start.shape)
    single = law_offsets(law, place, place[links.sender], links)
    stronger = msgspec.structs.replace(links, gain=2.0 * links.gain)
    double = law_offsets(law, place, place[links.sender], stronger)
    if analysis.plan.anchors_by_row or not np.array_equal(single, double, equal_nan=True):
        return GAIN[law.PULLS_BY], ("formation", gain_key(law, wants))
    return alone


def stability(analysis: Analysis) -> Iterator[Finding]:
    """Check that the sampled loop is stable near the shape."""
    loop, shape = analysis.modes, analysis.met_shape
    formation = analysis.plan.experiment.formation
    if loop is None or shape is None or next(lengths(analysis), None) is not None:
        return
    law, choice = analysis.law, analysis.plan.law_name
    if not math.isfinite(loop.gain):
        place, links = shape.position, analysis.asked
        offset = law_offsets(law, place, place[links.sender], links)
        bad = join_names([analysis.plan.names[row] for row in np.flatnonzero(~np.isfinite(offset).all(axis=1))])
        what = f"for {bad} no number" if bad else "numbers that jump between neighbouring places"
        message = f"the law '{choice}' gives {what} where the formation is met"
        apart = [tuple(each) for each in (place[links.receiver] - place[links.sender]).tolist()]
        message += unknown_reads(
            law,
            lambda watched: [law.pull(each, watched(link)) for each, link in zip(apart, unlinked(links), strict=True)],
        )
        remedy = "look for a length of 0 and for fields of `links` that are NaN (docs/plugins.md)"
        yield Finding("error", "not-finite", message, remedy, ("formation", "law"))
        return
    wants = BY_DISTANCE if _measured(analysis).any() or not analysis.standing.any() else BY_RELATIVE
    own, path = strength(analysis, wants)
    took = f"gain {loop.gain:.3g}"
    calm = f"the law '{choice}' does not use `links.gain`: let it ask for less by {own}"
    if path[-1] == (name := gain_key(law, wants)):
        took += f" (h·{'μ' if name == 'gain' else 'k'}·λ)"
        calm = f"use a {name} below {getattr(formation, name) * OSCILLATING_GAIN / max(loop.gain, 1e-12):.2g}"
    if loop.gain >= UNSTABLE_GAIN:
        yield Finding("error", "unstable", f"the sampled loop is unstable: {took}, limit {UNSTABLE_GAIN:g}", calm, path)
    elif shape.worst <= FORGIVEN and loop.radius > 1.0 + FORGIVEN:
        message = f"the formation drifts away from its shape: an error grows by {loop.radius:.4f} with every decision"
        remedy = "give more links both ways; a ring of one-way links can turn for ever"
        yield Finding("error", "diverges", message, remedy, ("formation", "links"))
    elif loop.gain > OSCILLATING_GAIN:
        message = f"the sampled loop oscillates before it settles: {took}, at most {OSCILLATING_GAIN:g} is calm"
        yield Finding("warning", "oscillates", message, calm, path)
    else:
        yield Finding("note", "stable", f"the sampled loop is stable: {took}, less than {OSCILLATING_GAIN:g}")
