"""What theory says of a formation: is it one, can it exist, does it hold its shape, does the sampled loop settle."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from agents.graph import reached
from experiments.analysis import Analysis
from experiments.claim import FORGIVEN, Claim, Severity, listed
from experiments.feasibility import Conflict, conflicts

FAR_OFF: Final = 0.01  # [m] a shape that misses a distance by more is another shape
OFF: Final = 0.001  # [m] more than written digits explain
HUNTS: Final = 2.0  # of the share of an error that one decision corrects
RINGS: Final = 1.2  # beyond 1 an error changes its sign; what is left to 2 is for lag that the model does not have


def network(analysis: Analysis) -> Iterator[Claim]:
    """Does everybody hear of a leader, in one network."""
    names, links, leaders = analysis.names, analysis.assignment.links, analysis.leaders
    path = ("formation", "links")
    if not len(links):
        yield Claim("note", "no-formation", "no links: every robot follows its own plan, or stays where it is")
        return
    rows = len(names)
    sources = np.array([names.index(name) for name in leaders], dtype=np.intp)
    listens = np.isin(np.arange(rows), links.listener)
    problems = []
    if len(sources):
        lost = np.flatnonzero(~reached(links, rows, sources) & listens)
        if len(lost):
            who = listed([names[row] for row in lost])
            message = f"{who} cannot hear of the leader ({listed(leaders)}), neither directly nor through others"
            remedy = f'add a link to one that does, such as "{leaders[0]} > {names[lost[0]]}"'
            problems.append(Claim("error", "leader-unknown", message, remedy, path))
    linked = np.union1d(links.listener, links.speaker)
    parts = analysis.parts - (rows - len(linked))  # robots without links go their own way
    apart = analysis.experiment.avoidance is not None and len(leaders) >= analysis.parts
    if parts > 1 and apart:
        message = f"{parts} formations that know of each other only to keep clear"
        yield Claim("note", "parts", message, "", path)
    elif parts > 1:
        message = f"the network falls into {parts} parts that know nothing of each other"
        problems.append(Claim("error", "parts", message, "join them by links, or make them separate experiments", path))
    deaf = [names[row] for row in analysis.silent if names[row] not in leaders]
    if deaf:
        message = f"{listed(deaf)} hears nobody and is no leader: it takes no part in the formation"
        problems.append(Claim("warning", "hears-nobody", message, f'add "... > {deaf[0]}" to its links', path))
    for name in leaders:
        if names.index(name) not in links.speaker:
            message, remedy = f"nobody listens to the leader {name}", f'add "{name} > ..." for one of the others'
            problems.append(Claim("error" if len(leaders) == 1 else "warning", "leader-unheard", message, remedy, path))
    yield from problems
    if not problems:
        said = f"everybody hears of {listed(leaders)}" if leaders else "no leader: the formation finds its own place"
        whole = "the network is whole; " if analysis.parts == 1 else ""
        yield Claim("note", "connected", f"{whole}{said}")


def realisation(analysis: Analysis) -> Iterator[Claim]:
    """Can the distances be met while heights are held."""
    shape, links = analysis.shape, analysis.assignment.links
    if shape is None:
        return
    if shape.worst <= OFF:
        yield Claim("note", "realisable", f"the distances can be met to {1e3 * shape.worst:.1f} mm")
        return
    off = f"at best, {analysis.link(int(shape.error.argmax()))} is {1e3 * shape.worst:.1f} mm off"
    found = conflicts(links, np.nan_to_num(analysis.assignment.hover))
    heights = [each for each in found if math.isfinite(each.ceiling)]
    for high in list(dict.fromkeys(each.high for each in heights)):
        lowest = min((each for each in heights if each.high == high), key=lambda each: each.ceiling)
        yield _too_high(analysis, lowest, off)
    severity: Severity = "error" if shape.worst > FAR_OFF else "warning"
    for conflict in [each for each in found if not math.isfinite(each.ceiling)]:
        inside = np.isin(links.listener, conflict.rows) & np.isin(links.speaker, conflict.rows)
        longest = int(np.where(inside, links.distance, -np.inf).argmax())
        sides = _sides(analysis, conflict)
        message = f"{sides} make no triangle: the longest is longer than the others together; {off}"
        remedy = f"shorten {analysis.link(longest)}, or lengthen the other two"
        yield Claim(severity, "no-triangle", message, remedy, analysis.link_path(longest))
    if not found:
        worst = [int(k) for k in np.argsort(-shape.error) if shape.error[k] > shape.worst / 2]
        at_fault = listed(list(dict.fromkeys(_pair(analysis, k) for k in worst)))
        message = f"the distances contradict one another around {at_fault}; {off}"
        remedy = "give distances that one drawing has, or fewer of them"
        if len(analysis.silent) > 1:
            remedy += "; the leaders' own places count as well"
        yield Claim(severity, "not-realisable", message, remedy, analysis.link_path(worst[0]))


def _pair(analysis: Analysis, link: int | np.intp) -> str:
    """The same words for both directions of a link."""
    links = analysis.assignment.links
    i, j = sorted((int(links.speaker[link]), int(links.listener[link])))
    return f"{analysis.names[i]} - {analysis.names[j]}"


def _sides(analysis: Analysis, conflict: Conflict) -> str:
    links, rows = analysis.assignment.links, conflict.rows
    inside = np.flatnonzero(np.isin(links.listener, rows) & np.isin(links.speaker, rows))
    said = {_pair(analysis, k): f"{_pair(analysis, k)} ({links.distance[k]:g} m)" for k in inside}
    return ", ".join(said.values())


def _too_high(analysis: Analysis, conflict: Conflict, off: str) -> Claim:
    names = analysis.names
    who = listed([names[row] for row in conflict.high])
    held = max(float(np.nan_to_num(analysis.assignment.hover[row])) for row in conflict.high)
    message = f"{who} is too high at {held:g} m for {_sides(analysis, conflict)}; {off}"
    remedy = f"hover lower than {conflict.ceiling:.3f} m, or lengthen these links"
    return Claim("error", "too-high", message, remedy, ("robots", names[conflict.high[0]], "hover"))


def rigidity(analysis: Analysis) -> Iterator[Claim]:
    """Do the distances leave only one shape nearby, in the motions that the robots have."""
    planar, spatial = analysis.planar, analysis.spatial
    if planar is None or spatial is None or analysis.parts > 1:
        return
    rank = f"rank {planar.rank} of {planar.needed} in the motions that the robots have"
    if not planar.rigid:
        more = planar.needed - planar.rank
        message = f"the formation is not rigid, {rank}: it can change its shape and still meet every distance"
        remedy = f"add {more} link{'s' * (more > 1)} at least, between robots that are not linked yet"
        yield Claim("warning", "not-rigid", message, remedy, ("formation", "links"))
    else:
        flying = (
            "" if spatial.rigid else f"; in space {spatial.rank} of {spatial.needed}, not needed while heights are held"
        )
        yield Claim("note", "rigid", f"the formation is rigid, {rank}{flying}")


def stability(analysis: Analysis) -> Iterator[Claim]:
    """Does the sampled loop settle, near the shape."""
    loop, shape, gain = analysis.modes, analysis.shape, analysis.experiment.formation.gain
    if loop is None or shape is None or shape.worst > FAR_OFF:
        return
    path = ("formation", "gain")
    took = f"one decision takes {loop.gain:.3g} of the stiffest error (h·μ·λ)"
    calm = f"use a gain below {gain * RINGS / max(loop.gain, 1e-12):.2g}"
    if loop.gain >= HUNTS:
        yield Claim("error", "hunts", f"the formation hunts: {took}, and from {HUNTS:g} on it grows", calm, path)
    elif shape.worst <= FORGIVEN and loop.radius > 1.0 + FORGIVEN:
        message = f"the formation drifts away from its shape: an error grows by {loop.radius:.4f} with every decision"
        remedy = "let more links be heard by both ends; a ring of one-way links can turn for ever"
        yield Claim("error", "unstable", message, remedy, ("formation", "links"))
    elif loop.gain > RINGS:
        yield Claim(
            "warning", "rings", f"the formation rings: {took}, and its sign changes before it fades", calm, path
        )
    else:
        yield Claim("note", "stable", f"the loop settles: {took}, less than {RINGS:g}")
