"""Formation as arrays: links with their targets, anchors, changes, and the link errors of a motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask, norm
from agents.formation.anchors import Anchors
from agents.formation.changes import Change, NewTargets, Presence, Reshaping, changed_targets
from agents.formation.graph import BY_DISTANCE, Links
from agents.plugins.laws import Distance, Law
from experiments.definition.experiment import Anchor, Experiment
from experiments.definition.experiment import Change as Described
from experiments.definition.links import UNKNOWN, OneWay, held_height, link_pairs, link_target

AT_ONCE: Final = 200_000  # errors of links that are held in memory at once


@dataclass(frozen=True)
class FormationArrays:
    """Every possible link with its first target, the changes of the targets, and the times of presence."""

    links: Links  # (E), sorted by receiver, then sender
    changes: tuple[Change, ...]  # of their targets, in order of time
    presence: Presence | None  # when they are there; None if always

    @classmethod
    def compiled(cls, experiment: Experiment, there: Sequence[OneWay]) -> FormationArrays:
        """Arrays of these links; rows are the robots of the file."""
        row = {name: number for number, name in enumerate(experiment.robots)}
        wants = np.array([link.wanted.wants for link in there], dtype=np.intp)
        plain = bool((wants == BY_DISTANCE).all())
        links = Links(
            np.array([row[link.receiver] for link in there], dtype=np.intp),
            np.array([row[link.sender] for link in there], dtype=np.intp),
            np.array([link.wanted.distance for link in there], dtype=float),
            np.array([link.gain for link in there], dtype=float),
            None if plain else _vectors([link.wanted.relative for link in there]),
            None if plain else _vectors([link.wanted.bearing for link in there]),
            None if plain else wants,
        )
        return cls(links, _changes_of(experiment, there), _presence_of(there))

    def select(self, which: Index) -> FormationArrays:
        """Some of the links, or the same in another order."""
        changes = tuple(replace(change, to=change.to.take(which)) for change in self.changes)
        return FormationArrays(
            self.links.take(which), changes, None if self.presence is None else self.presence.take(which)
        )

    def to_receivers(self, rows: Index) -> FormationArrays:
        """Links on which these rows receive, as `Links.of` gives them."""
        at, receiver = self.links.indices_to_receivers(rows)
        mine = self.select(at)
        return replace(mine, links=msgspec.structs.replace(mine.links, receiver=receiver))

    def without_receivers(self, rows: Index) -> FormationArrays:
        """Links on which other rows than these receive."""
        return self.select(np.flatnonzero(~np.isin(self.links.receiver, rows))) if len(rows) else self

    def append(self, others: Links) -> FormationArrays:
        """Append links that do not change and are always present."""
        same = NewTargets.unchanged(len(others))
        changes = tuple(replace(change, to=NewTargets.joined([change.to, same])) for change in self.changes)
        presence = None if self.presence is None else self.presence.padded(len(others))
        return FormationArrays(self.links.append(others), changes, presence)

    def repeated(self, times: int, rows: int) -> FormationArrays:
        """The same in `times` copies of an experiment of `rows` robots, one copy behind the other."""
        many = self.select(np.tile(np.arange(len(self.links)), times))
        return replace(many, links=self.links.repeated(times, rows))

    def stages(self) -> list[Links]:
        """The links with their targets at the beginning, and after each change."""
        count, ends = len(self.links), [change.at + change.over + 1.0 for change in self.changes]
        later = (changed_targets(self.links, self.changes[: k + 1], np.full(count, end)) for k, end in enumerate(ends))
        return [self.links, *later]

    def present(self, time: Array, position: Array) -> Mask | None:
        """Presence of links (T, E) along true positions (T, N, 3) at times (T,); None if all are always present."""
        if self.presence is None:
            return None
        reshaping = Reshaping(self.links, (), self.presence)
        there = np.empty((len(time), len(self.links)), dtype=bool)
        for k, t in enumerate(time.tolist()):
            reshaping.advance(np.full(position.shape[1], t), position[k], position[k, self.links.sender])
            there[k] = reshaping.present
        return there


def errors_over_time(law: Law, pattern: FormationArrays, time: Array, position: Array) -> Array:
    """Error of each link (T, E) as the law measures it; NaN where the link is not there or an end is unknown.

    Args:
        law: Its `error` is asked for all times at once.
        time: (T,) since the common start [s].
        position: (T, N, 3) true [m].
    """
    links = pattern.links
    if isinstance(law, Distance) and not pattern.changes:
        error = np.abs(norm(position[:, links.receiver] - position[:, links.sender]) - links.distance)
    else:
        step = max(1, AT_ONCE // max(1, len(links)))
        begins = range(0, len(time), step)
        parts = [_errors(law, pattern, time[k : k + step], position[k : k + step]) for k in begins]
        error = np.concatenate([np.zeros((0, len(links))), *parts])
    there = pattern.present(time, position)
    return error if there is None else np.where(there, error, np.nan)


def _errors(law: Law, pattern: FormationArrays, time: Array, position: Array) -> Array:
    links, (count, rows) = pattern.links, position.shape[:2]
    many = links.repeated(count, rows)
    if pattern.changes:
        all_of_them = np.tile(np.arange(len(links)), count)
        changes = [replace(change, to=change.to.take(all_of_them)) for change in pattern.changes]
        many = changed_targets(many, changes, np.repeat(time, len(links)))
    flat = position.reshape(-1, 3)
    return law.error(flat, flat[many.sender], many).reshape(count, len(links))


def compile_anchors(experiment: Experiment, names: Sequence[str], only: Sequence[str] | None = None) -> Anchors | None:
    """Anchors of these robots, or of some `only`, each once; None if there are none."""
    formation = experiment.formation
    anchored = formation.anchors if only is None else [name for name in formation.anchors if name in only]
    there = [(row, formation.anchors[name]) for row, name in enumerate(names) if name in anchored]
    if not there:
        return None
    anchors = [each if isinstance(each, Anchor) else Anchor(distance=each) for _, each in there]
    to_origin = 2.0 * formation.gain  # twice that of a link: as the authors' controllers pull to the origin
    return Anchors(
        row=np.array([row for row, _ in there], dtype=np.intp),
        point=_vectors([_spatial(each.to) for each in anchors]),
        axis=_vectors([_unit(each.along or each.across) for each in anchors]),
        whole=np.array([0.0 if each.across is not None else 1.0 for each in anchors]),
        along=np.array([float(each.across is not None) - float(each.along is not None) for each in anchors]),
        distance=np.array([each.distance for each in anchors]),
        gain=np.array([each.gain or (to_origin if each.distance > 0.0 else formation.stiffness) for each in anchors]),
    )


def _presence_of(one_way: Sequence[OneWay]) -> Presence | None:
    columns = [(link.since, link.until, link.reach, link.release) for link in one_way]
    table = np.array(columns, dtype=float).reshape(-1, 4)
    if (table[:, 0] <= 0.0).all() and np.isinf(table[:, 1:]).all():
        return None
    return Presence(*table.T)


def _changes_of(experiment: Experiment, one_way: Sequence[OneWay]) -> tuple[Change, ...]:
    rise = np.array([held_height(experiment, link.receiver) - held_height(experiment, link.sender) for link in one_way])
    in_order = sorted(experiment.formation.changes, key=lambda each: each.at_s)
    return tuple(_change(experiment, each, one_way, rise) for each in in_order)


def _change(experiment: Experiment, described: Described, one_way: Sequence[OneWay], rise: Array) -> Change:
    new = {
        pair: link_target(experiment, text, given, pair[0])
        for text, given in described.links.items()
        for pair in link_pairs(text)
    }
    then = [new.get((link.receiver, link.sender)) for link in one_way]
    to = NewTargets(
        np.array([math.nan if each is None else each.distance for each in then]),
        _vectors([UNKNOWN if each is None else each.relative for each in then]),
        _vectors([UNKNOWN if each is None else each.bearing for each in then]),
        rise,
    )
    return Change(described.at_s, described.over_s, to, described.scale, described.rotate)


def _spatial(vector: Sequence[float] | None) -> tuple[float, float, float]:
    x, y, z = (*(vector or (0.0, 0.0)), 0.0)[:3]
    return x, y, z


def _unit(direction: Sequence[float] | None) -> tuple[float, float, float]:
    x, y, z = _spatial(direction)
    length = math.hypot(x, y, z) or 1.0
    return x / length, y / length, z / length


def _vectors(rows: Sequence[Sequence[float]]) -> Array:
    return np.array(rows, dtype=float).reshape(-1, len(UNKNOWN))
