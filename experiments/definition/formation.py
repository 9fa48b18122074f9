"""Formation of an experiment: links with their targets, anchors, changes, and the link errors of a motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agents.body.kinds import KINDS, Flight, Kind
from agents.formation import anchors
from agents.formation.changes import Change, Target, change_target, exists, planned_at
from agents.formation.link import BY_DISTANCE, BY_NOTHING, BY_RELATIVE, Link
from agents.plugins.law import WANTS, Law
from agents.plugins.laws import Displacement, Distance, Gradient
from agents.ticks import ROUNDING_S
from experiments.definition.experiment import AnchorTable, ChangeTable, Experiment
from experiments.definition.graph import Links
from experiments.definition.links import OneWay, held_height, link_pairs, link_target
from twins.arrays import Array, Index, Mask, norm

Anchored = Sequence[tuple[int, anchors.Anchor]]  # anchors, each with the row of its robot

STEPS_HZ: Final = 100.0  # steps of a drone's model between two decisions
ROUNDED: Final = 1e-9  # rounding of eigenvalues
TURNING: Final = 0.05  # share of |λ|
CALM: Final = 1.15  # gain of the sampled loop, which rings from 1.2 on and is unstable from 2
BRACED: Final = 1.4  # bound by lengths of links of a braced formation, as a multiple of the gain that directions leave
TO_ORIGIN: Final = 2.0  # gain of an anchor, of that of a link: as the authors' controllers pull to the origin
MOST_ROBOTS: Final = 300  # eigenvalues of more take longer than the run
TINY: Final = 1e-9
BY_TARGET: Final = (Law.error, Displacement.error, Distance.error)  # errors by the target that a law needs
AT_ONCE: Final = 10_000  # distances of links that are computed at once: they stay in the processor's cache


@dataclass(frozen=True)
class Pattern:
    """Every possible link with its first target, the changes of the targets, and the times of presence."""

    links: Links  # (E), sorted by receiver, then sender
    one_way: tuple[OneWay, ...]  # (E)
    changes: tuple[Change, ...]  # changes of the targets, in order of time
    targets: tuple[tuple[Target, ...], ...]  # (E) after each change

    @classmethod
    def compiled(cls, experiment: Experiment, one_way: Sequence[OneWay]) -> Pattern:
        """Pattern of these links; rows are the robots of the file."""
        row = {name: number for number, name in enumerate(experiment.robots)}
        in_order = sorted(experiment.formation.changes, key=lambda each: each.at_s)
        after = [_targets(experiment, each, one_way) for each in in_order]
        return cls(
            linked([each.target for each in one_way], [(row[each.receiver], row[each.sender]) for each in one_way]),
            tuple(one_way),
            tuple(Change(each.at_s, each.over_s, each.scale, each.rotate) for each in in_order),
            tuple(zip(*after, strict=True)) if after else ((),) * len(one_way),
        )

    @cached_property
    def bounded(self) -> bool:
        """Whether a link comes or goes."""
        return any(link.since > 0.0 or min(link.until, link.reach, link.release) < math.inf for link in self.one_way)

    def targets_at(self, elapsed: float) -> list[Link]:
        """Targets of the links `elapsed` [s] after the common start."""
        given = [each.target for each in self.one_way]
        if not self.changes:
            return given
        found = [Link(to.distance, to.gain, to.relative, to.bearing, to.wants) for to in given]
        for link, begin, targets in zip(found, given, self.targets, strict=True):
            change_target(link, begin, self.changes, targets, elapsed)
        return found

    def at(self, elapsed: float) -> Links:
        """The links with their targets `elapsed` [s] after the common start."""
        ends = zip(self.links.receiver.tolist(), self.links.sender.tolist(), strict=True)
        return linked(self.targets_at(elapsed), list(ends))

    def stages(self) -> list[Links]:
        """The links with their targets at the beginning, and after each change."""
        found = [self.links]
        for count, change in enumerate(self.changes, 1):
            so_far = replace(self, changes=self.changes[:count], targets=tuple(each[:count] for each in self.targets))
            found.append(so_far.at(change.at + change.over + 1.0))
        return found

    def planned_at(self, elapsed: float) -> Mask:
        """Links (E,) that exist at a time [s] whatever the distance of the robots."""
        return np.array([planned_at(each.since, each.until, each.reach, elapsed) for each in self.one_way], dtype=bool)

    def present(self, time: Array, position: Array) -> Mask | None:
        """Presence of links (T, E) along true positions (T, N, 3) at times (T,); None if all are always present."""
        if not self.bounded:
            return None
        apart = norm(_apart(position, self.links.receiver, self.links.sender))
        since, until, reach, release = np.array(
            [(each.since, each.until, each.reach, each.release) for each in self.one_way]
        ).T
        within = (since - ROUNDING_S <= time[:, None]) & (time[:, None] < until - ROUNDING_S)
        begins, stays = (within & ((limit == math.inf) | (apart <= limit)) for limit in (reach, release))
        # a link that would neither begin nor end is as it was: `release` is not nearer than `reach`
        decided = np.where(begins | ~stays, np.arange(len(apart))[:, None], -1)
        last = np.maximum.accumulate(decided, axis=0)
        return np.where(last < 0, self.planned_at(0.0), np.take_along_axis(begins, np.maximum(last, 0), axis=0))

    def exists(self, number: int, elapsed: float, apart: float, *, was: bool) -> bool:
        """Whether a link between robots `apart` [m] exists `elapsed` [s] after the start; `was`: it did before."""
        link = self.one_way[number]
        return exists(link.since, link.until, link.release if was else link.reach, elapsed, apart)


def linked(targets: Sequence[Link], ends: Sequence[tuple[int, int]]) -> Links:
    """Links as arrays from their targets and (receiver, sender) rows."""
    both = np.array(ends, dtype=np.intp).reshape(-1, 2)
    wants = np.array([link.wants for link in targets], dtype=np.intp)
    plain = bool((wants == BY_DISTANCE).all())
    return Links(
        both[:, 0],
        both[:, 1],
        np.array([link.distance for link in targets], dtype=float),
        np.array([link.gain for link in targets], dtype=float),
        None if plain else vectors([link.relative for link in targets]),
        None if plain else vectors([link.bearing for link in targets]),
        None if plain else wants,
    )


def unlinked(links: Links) -> list[Link]:
    """Targets of links, one by one."""
    count = len(links)
    blank = [(math.nan,) * 3] * count
    relative = blank if links.relative is None else [tuple(each) for each in links.relative.tolist()]
    bearing = blank if links.bearing is None else [tuple(each) for each in links.bearing.tolist()]
    wants = [BY_DISTANCE] * count if links.wants is None else links.wants.tolist()
    columns = links.distance.tolist(), links.gain.tolist(), relative, bearing, wants
    return [Link(*each) for each in zip(*columns, strict=True)]


def law_offsets(law: Gradient, position: Array, received: Array, links: Links) -> Array:
    """Offset u (N, 3) [m] of robots at `position` (N, 3) with the `received` positions of the senders (E, 3) [m]."""
    offset = np.zeros_like(position)
    apart = (position[links.receiver] - received).tolist()
    for row, link, away in zip(links.receiver.tolist(), unlinked(links), apart, strict=True):
        offset[row] += law.pull(tuple(away), link)
    return offset


def law_errors(law: Gradient, position: Array, received: Array, links: Links) -> Array:
    """Error of each link (E,) [m], of robots at `position` (N, 3) that received senders at `received` (E, 3) [m]."""
    apart = (position[links.receiver] - received).tolist()
    return np.abs([law.error(tuple(away), link) for away, link in zip(apart, unlinked(links), strict=True)])


def anchor_offsets(held: Anchored, position: Array) -> Array:
    """Offset (N, 3) [m] by which anchors pull robots at `position` (N, 3) [m]."""
    offset = np.zeros_like(position)
    for row, anchor in held:
        offset[row] += anchor.pull(tuple(position[row].tolist()))
    return offset


def anchor_errors(held: Anchored, position: Array) -> Array:
    """Error of each anchor (T, A) [m] along positions (T, N, 3) [m]."""
    found = [[anchor.error(tuple(place)) for place in position[:, row].tolist()] for row, anchor in held]
    return np.array(found, dtype=float).reshape(len(held), len(position)).T


def targeted(law: Law, pattern: Pattern) -> Mask:
    """Links (E,) with an error: their target stands at the link, or the law needs that of robots that are near."""
    needed = law.NEEDS != "nothing"
    given = [link.target.wants != BY_NOTHING and bool(needed or link.text) for link in pattern.one_way]
    return np.array(given, dtype=bool)


def counted_links(law: Law, pattern: Pattern, rows: int) -> Array:
    """(E, N) 1 where a link with a target counts for a robot: it receives on it, or sends, if it receives on none."""
    counts, links = targeted(law, pattern)[:, None], pattern.links
    as_receiver, as_sender = (np.eye(rows)[ends] * counts for ends in (links.receiver, links.sender))
    return np.where(as_receiver.any(axis=0), as_receiver, as_sender)


def robot_sums(error: Array, own: Array) -> Array:
    """Σ of the known errors (T, E) over the links that count for each robot, `own` (E, N); NaN where none is known."""
    known = np.isfinite(error)
    total = np.where(known, error, 0.0) @ own
    total[known.astype(float) @ own == 0.0] = np.nan
    return np.asarray(total)


def errors_over_time(law: Law, pattern: Pattern, time: Array, position: Array) -> Array:
    """Error of each link (T, E) by its target; NaN where the link is not there, has no target, or an end is unknown.

    Args:
        time: (T,) since the common start [s].
        position: (T, N, 3) true [m].
    """
    links, wants = pattern.links, WANTS.get(law.NEEDS)
    given = targeted(law, pattern)
    error = np.full((len(time), len(links)), np.nan)
    if wants in (BY_DISTANCE, BY_RELATIVE) and type(law).error in BY_TARGET and not pattern.changes:
        targets = [link.target for link in pattern.one_way]
        distance = np.where(given, [to.distance for to in targets], np.nan)
        relative = np.array([to.relative for to in targets]).reshape(-1, 3).T
        step = max(1, AT_ONCE // max(1, len(links)))
        for part in (slice(k, k + step) for k in range(0, len(time), step)):
            apart = [_apart(axis, links.receiver, links.sender) for axis in np.moveaxis(position[part], 2, 0)]
            if wants == BY_RELATIVE:
                apart = [each - wanted for each, wanted in zip(apart, relative, strict=True)]
            x, y, z = apart
            length = np.sqrt(x * x + y * y + z * z)  # sums as `agents.vectors.norm` has them
            error[part] = np.abs(distance - length) if wants == BY_DISTANCE else np.where(given, length, np.nan)
    elif given.any():
        columns = given.nonzero()[0]
        rows = _apart(position, links.receiver[columns], links.sender[columns]).tolist()
        for k, (t, row) in enumerate(zip(time.tolist(), rows, strict=True)):
            if k == 0 or pattern.changes:
                every = pattern.targets_at(t)
                targets = [every[each] for each in columns.tolist()]
            error[k, columns] = [abs(law.error(tuple(away), to)) for away, to in zip(row, targets, strict=True)]
    present = pattern.present(time, position)
    return error if present is None else np.where(present, error, np.nan)


def _apart(position: Array, receiver: Index, sender: Index) -> Array:
    """Differences (T, E, ...) from senders to receivers of `position` (T, N, ...)."""
    return np.asarray(position.take(receiver, axis=1) - position.take(sender, axis=1))  # a sixth of the time of indices


def compile_anchors(experiment: Experiment) -> dict[str, tuple[anchors.Anchor, ...]]:
    """Anchors of each robot that has one."""
    formation = experiment.formation
    to_origin = TO_ORIGIN * formation.gain
    found: dict[str, tuple[anchors.Anchor, ...]] = {}
    for name, given in formation.anchors.items():
        each = given if isinstance(given, AnchorTable) else AnchorTable(distance=given)
        gain = each.gain or (to_origin if each.distance > 0.0 else formation.stiffness)
        found[name] = (anchors.Anchor(
            point=_spatial(each.to),
            axis=_unit(each.along or each.across),
            whole=0.0 if each.across is not None else 1.0,
            along=float(each.across is not None) - float(each.along is not None),
            distance=each.distance,
            gain=gain,
        ),)  # fmt: skip
    return found


def _targets(experiment: Experiment, described: ChangeTable, one_way: Sequence[OneWay]) -> list[Target]:
    """Target of each link after a change."""
    new = {
        pair: link_target(experiment, text, given, pair[0])
        for text, given in described.links.items()
        for pair in link_pairs(text)
    }
    found = []
    for link in one_way:
        rise = held_height(experiment, link.receiver) - held_height(experiment, link.sender)
        then = new.get((link.receiver, link.sender), Link())
        found.append(Target(then.distance, then.relative, then.bearing, rise))
    return found


def _spatial(vector: Sequence[float] | None) -> tuple[float, float, float]:
    x, y, z = (*(vector or (0.0, 0.0)), 0.0)[:3]
    return x, y, z


def _unit(direction: Sequence[float] | None) -> tuple[float, float, float]:
    x, y, z = _spatial(direction)
    length = math.hypot(x, y, z) or 1.0
    return x / length, y / length, z / length


def vectors(rows: Sequence[Sequence[float]]) -> Array:
    return np.array(rows, dtype=float).reshape(-1, 3)


def closed_shares(kinds: Sequence[Kind], hz: float) -> Array:
    """h (N,): the share of a position error that each robot closes between two decisions."""
    return 1.0 - np.exp(-np.array([kind.response for kind in kinds]) / hz)


def bearable_factors(kinds: Sequence[Kind], hz: float) -> Array:
    """λ (N,): the largest factor with which goals g = p − λ p, decided at `hz`, leave a robot's loop stable.

    On wheels a robot closes its share h of the error, and is unstable from 2/h; a drone overshoots its goal, because
    it must tilt first, and bears less.
    """
    factor = 2.0 / closed_shares(kinds, hz)
    drones = {kind.name: kind.motion for kind in kinds if isinstance(kind.motion, Flight)}
    for name, flight in drones.items():
        factor[[kind.name == name for kind in kinds]] = _bearable_factor(flight, hz)
    return factor


def linear_step(response: Flight, axis: int, dt: float) -> Array:
    """Step (4, 4) of a `Quadrotor` within its limits, of position [m], velocity [m/s], its change in a step, goal."""
    tilt, gain = min(dt * response.tilt[axis], 1.0), dt * response.velocity[axis]
    pull = tilt * gain * response.position[axis]
    place, speed, _, goal = np.eye(4)
    change = np.array([-pull, -tilt * gain, 1.0 - tilt, pull])
    velocity = speed + change
    return np.stack([place + dt * velocity, velocity, change, goal])


@cache
def _bearable_factor(response: Flight, hz: float) -> float:
    steps = max(round(STEPS_HZ / hz), 1)
    period = np.linalg.matrix_power(linear_step(response, 0, 1.0 / (hz * steps)), steps)

    def stable(factor: float) -> bool:
        loop = period[:3, :3] + np.outer(period[:3, 3], [1.0 - factor, 0.0, 0.0])
        return bool(np.abs(np.linalg.eigvals(loop)).max() <= 1.0 + ROUNDED)

    low, high = 0.0, 1.0
    while stable(high):
        low, high = high, 2.0 * high
    while high - low > ROUNDED * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def calm_gain(experiment: Experiment) -> float:
    """Gain μ for a file that gives none: the default, or less where long links would make the loop ring.

    The loop takes H M from an error with M at most the Laplacian of the links, each with the weight μ d² of its length
    from above. Its `loop_gain` is brought down to `CALM`; in a braced formation links pull in many directions.
    """
    formation, row = experiment.formation, {name: k for k, name in enumerate(experiment.robots)}
    weight = np.zeros((len(row), len(row)))
    for text, given in formation.link_tables.items():
        if given.distance is not None and given.gain is None:
            for receiver, sender in link_pairs(text):
                rise = held_height(experiment, receiver) - held_height(experiment, sender)
                weight[row[receiver], row[sender]] = max(given.distance**2 - rise**2, 0.0)
    alone = np.zeros(len(row))
    for name, each in formation.anchors.items():
        given_gain = each.gain if isinstance(each, AnchorTable) else None
        length = each.distance if isinstance(each, AnchorTable) else each
        alone[row[name]] = 0.0 if given_gain else TO_ORIGIN * length**2
    kinds = [KINDS[robot.kind] for robot in experiment.robots.values()]
    share = 2.0 / bearable_factors(kinds, experiment.rates.coordination_hz)
    taken = share[:, None] * (np.diag(weight.sum(axis=1) + alone) - weight)
    calm = CALM * (BRACED if int((weight + weight.T > 0.0).sum()) >= 2 * len(row) else 1.0)
    if len(row) > MOST_ROBOTS or not np.isfinite(taken).all():  # rows, without eigenvalues: at most twice as much
        return min(formation.gain, calm / max(2.0 * float(np.nan_to_num(np.diag(taken)).max()), TINY))
    return min(formation.gain, calm / max(loop_gain(np.linalg.eigvals(taken).astype(complex)), TINY))


def loop_gain(eigenvalues: NDArray[np.complex128]) -> float:
    """Largest |λ|²/Re λ of the sampled loop p⁺ = (1 − M) p, λ itself where it is real: it is unstable from 2.

    There |1 − λ| is 1. Modes with a real part below `TURNING` turn for ever, and do not count.
    """
    settling = eigenvalues[eigenvalues.real > TURNING * np.abs(eigenvalues)]
    return float((np.abs(settling) ** 2 / settling.real).max(initial=0.0))
