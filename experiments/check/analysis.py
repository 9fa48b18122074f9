"""Analysis of one case: network, shape, rigidity, modes, and predicted motion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, cast

import msgspec
import numpy as np

from agents.body.limits import Limits
from agents.formation.link import BY_BEARING
from agents.plugins.laws import Gradient
from agents.plugins.planners import Planner
from experiments.check.findings import FORGIVEN
from experiments.check.ideal_run import Prediction
from experiments.check.realisation import (
    Shape,
    Solids,
    best_shape,
    drawn_bearings,
    find_shapes,
    formation_bend,
    formation_redundancy,
    formation_rigidity,
    targets_of_law,
    unfold_distances,
)
from experiments.check.stability import Modes, modes
from experiments.definition.experiment import LinkTable
from experiments.definition.formation import (
    anchor_errors,
    bearable_factors,
    closed_shares,
    errors_over_time,
    targeted,
)
from experiments.definition.graph import Links, components, edges
from experiments.definition.links import held_height, link_pairs
from experiments.definition.plan import Plan
from experiments.definition.rigidity import Bend, Redundancy, Rigidity
from experiments.file.problems import Path
from experiments.metrics.signals import WINDOW_S, after_last, has_errors, moving_mean
from twins.arrays import Array, Index, Mask, norm

MOST_ROBOTS: Final = 500  # most robots that are asked what can be lost: the time grows with their third power
MOST_BENT: Final = 100  # likewise, robots of which it is asked how far noise bends them
NOISE: Final = 1e-3  # [m] errors of positions that real robots have, where the file gives none
FITTING: Final = 1e-4  # [m] difference of a target and that of the best shape
FAR_OFF: Final = 0.01  # [m] a shape that misses a distance by more is another shape
GUESSES: Final = 400  # random places of robots from which a shape is sought: each costs time with their number


def sampled_loop(plan: Plan, asked: Links, position: Array) -> Modes:
    """Modes of the sampled loop of a gradient law at `position` (N, 3) [m], with what the links ask for."""
    kinds, hz = plan.kinds, plan.experiment.rates.coordination_hz
    return modes(
        cast(Gradient, plan.law), asked, position, closed_shares(kinds, hz), hz,
        bearable=bearable_factors(kinds, hz), anchors=plan.anchors_by_row, within_s=plan.experiment.duration_s,
    )  # fmt: skip


@dataclass(frozen=True)
class Analysis:
    """Figures of one case; each is computed at its first use."""

    plan: Plan  # the case, compiled
    prediction: Prediction  # the motion

    @property
    def law(self) -> Gradient:
        """The law, for callers that know it as a gradient."""
        return cast(Gradient, self.plan.law)

    @property
    def is_gradient(self) -> bool:
        """Whether the law is without memory: what it does follows from where robots stand."""
        return isinstance(self.plan.law, Gradient)

    @cached_property
    def has_targets(self) -> bool:
        """Whether any link has a target; else there is neither shape nor error."""
        return has_errors(self.plan)

    @cached_property
    def placed(self) -> Mask:
        """(N,) robots with incoming links or an anchor."""
        held = [row for row, _ in self.plan.anchors_by_row]
        return np.isin(np.arange(len(self.plan.names)), [*self.plan.links.receiver.tolist(), *held])

    @property
    def without_neighbours(self) -> Index:
        """The other rows."""
        return np.flatnonzero(~self.placed)

    @cached_property
    def parts(self) -> int:
        """Parts of the network."""
        return components(self.plan.links, len(self.plan.names))

    @cached_property
    def start(self) -> Array:
        """(N, 3) on the floor [m]."""
        return np.array(self.plan.start_poses()[0])

    @cached_property
    def height(self) -> Array:
        """(N,) that each robot holds [m]: 0 on wheels."""
        return np.array([held_height(self.plan.experiment, name) for name in self.plan.names])

    @cached_property
    def radius(self) -> Array:
        """(N,) of the robots [m]."""
        return np.array([kind.radius for kind in self.plan.kinds])

    @cached_property
    def limits(self) -> Limits:
        """Limits of every robot, except `hold_s`."""
        return self.plan.limits(self.plan.names[0])

    # ------------------------------------------------------------------ the formation

    @cached_property
    def asked(self) -> Links:
        """Every possible link, with what the law takes it to ask for at the beginning."""
        return targets_of_law(self.plan.law, self.plan.links)

    @cached_property
    def standing(self) -> Mask:
        """(E,) links with a target that exist at the beginning, however far the robots are from each other."""
        return self._standing_at(0.0)

    def _standing_at(self, elapsed: float) -> Mask:
        pattern = self.plan.formation
        return pattern.planned_at(elapsed) & targeted(self.plan.law, pattern)

    @cached_property
    def first_links(self) -> Links:
        """The standing ones of the asked links."""
        return self.asked.take(self.standing)

    @cached_property
    def stages(self) -> list[list[Shape]]:
        """Shapes that were tried for the beginning, and for the time after each change.

        Empty without targets of links, and without anchors.
        """
        plan, pattern = self.plan, self.plan.formation
        if not (self.standing.any() or plan.anchors_by_row):
            return []
        times = (0.0, *(each.at + each.over for each in pattern.changes))
        return [
            self._shapes(targets_of_law(plan.law, wanted), self._standing_at(at))
            for at, wanted in zip(times, pattern.stages(), strict=True)
        ]

    @cached_property
    def shape(self) -> Shape | None:
        """The best for the beginning."""
        return best_shape(self.stages[0]) if self.stages else None

    @property
    def met_shape(self) -> Shape | None:
        """The shape, if it misses no target by more than `FAR_OFF`."""
        return None if self.shape is None or self.shape.worst > FAR_OFF else self.shape

    @cached_property
    def rigidity(self) -> tuple[Rigidity | None, Rigidity | None]:
        """With heights held, and in full space; None without a shape, in space with other targets than distances.

        A shape with robots in one another says nothing of the one that is asked for.
        """
        if self.shape is None or len(self.shape.overlaps):
            return None, None
        anchors = self.plan.anchors_by_row
        return formation_rigidity(self.shape.position, self.first_links, self.without_neighbours, anchors)

    @cached_property
    def sigma(self) -> float:
        """Largest noise of a position [m]."""
        return max(self.plan.disturbance(name).position_sigma or 0.0 for name in self.plan.names) or NOISE

    @cached_property
    def bend(self) -> Bend | None:
        """Bend of a formation by distances under that noise; None of others, and of very many robots."""
        shape, (planar, spatial) = self.met_shape, self.rigidity
        if shape is None or planar is None or spatial is None or planar.needed < 1:
            return None
        if len(self.plan.names) > MOST_BENT:
            return None
        return formation_bend(shape.position, self.first_links, self.without_neighbours, self.sigma)

    @cached_property
    def spare(self) -> Redundancy | None:
        """Pairs that the formation can lose and stay rigid, of the pairs `edges(first_links)`.

        None if it is not rigid, if its links ask for more than distances, or if it has too many robots.
        """
        planar, spatial = self.rigidity
        if self.shape is None or planar is None or spatial is None:
            return None
        if not planar.rigid or len(self.plan.names) > MOST_ROBOTS:
            return None
        return formation_redundancy(self.shape.position, self.first_links, self.without_neighbours)

    @property
    def vital_links(self) -> tuple[str, ...]:
        """Pairs without which the formation is not rigid any more."""
        names = self.plan.names
        pairs = [] if self.spare is None else edges(self.first_links)[~self.spare.pairs].tolist()
        return tuple(f"{names[first]} - {names[second]}" for first, second in pairs)

    @property
    def vital_robots(self) -> tuple[str, ...]:
        """Robots without which the formation is not rigid any more."""
        return () if self.spare is None else tuple(self.plan.names[row] for row in np.flatnonzero(~self.spare.robots))

    def grows_at(self, position: Array) -> bool:
        """Whether an error grows where the robots stand, (N, 3) [m]: a saddle, which the loop leaves when touched.

        Unknown of a law that remembers.
        """
        if not self.is_gradient:
            return False
        kinds, hz = self.plan.kinds, self.plan.experiment.rates.coordination_hz
        loop = modes(
            self.law, self.first_links, position, closed_shares(kinds, hz), hz, anchors=self.plan.anchors_by_row
        )
        return loop.radius > 1.0 + FORGIVEN

    @cached_property
    def modes(self) -> Modes | None:
        """Modes of the sampled loop at the shape; None of a law that remembers."""
        return (
            None
            if self.shape is None or not self.is_gradient
            else sampled_loop(self.plan, self.first_links, self.shape.position)
        )

    def _shapes(self, wanted: Links, present: Mask) -> list[Shape]:
        """Shapes from the ends, the starts, the scaled distances and random places as guesses, until one is exact."""
        experiment, silent = self.plan.experiment, self.without_neighbours
        end = self.prediction.position[-1].copy()
        rows, links = len(end), wanted.take(present)
        moves = self.placed
        aloft = np.column_stack([self.start[:, :2], self.height])
        landed = moves & (end[:, 2] < aloft[:, 2] / 2)  # robots on the floor have no place in the shape
        end[landed, 2] = aloft[landed, 2]
        rng = np.random.default_rng(experiment.seed)

        def places() -> Iterator[Array]:
            yield end
            plane = unfold_distances(links, aloft[:, 2])
            anchor = silent[:1] if len(silent) else np.arange(rows)
            for mirror in (1.0, -1.0):
                flipped = plane * [1.0, mirror, 1.0]
                flipped[:, :2] += (end[anchor] - flipped[anchor]).mean(axis=0)[:2]
                yield flipped
            yield aloft
            if links.wants is not None and (links.wants == BY_BEARING).all():
                drawn, _ = drawn_bearings(links, rows)
                for size in (1.0, 3.0, 0.3):  # robots that are not linked, or rounded bearings
                    place = end[anchor, :2].mean(axis=0) + size * (drawn - drawn[anchor].mean(axis=0))
                    yield np.column_stack([place, aloft[:, 2]])
            for _ in range(min(10, GUESSES // rows)):
                place = rng.uniform(-0.5, 0.5, (rows, 2)) * experiment.arena.size[:2]
                yield np.column_stack([place, aloft[:, 2]])

        guesses = (np.where(moves[:, None], each, end) for each in places())  # leaders are where their plans leave them
        found, solids = [], Solids.of(self.plan.kinds, links, moves)
        for each in find_shapes(links, guesses, moves, self.plan.anchors_by_row, solids=solids):
            error = np.zeros(len(present))
            error[present] = each.error
            found.append(replace(each, error=error))
        return found

    # ------------------------------------------------------------------ the motion

    @cached_property
    def error(self) -> Array:
        """(T, E) of each link along the motion [m]; 0 while it is not there."""
        plan, motion = self.plan, self.prediction
        return np.nan_to_num(errors_over_time(plan.law, plan.formation, motion.time, motion.position))

    @cached_property
    def mean_error(self) -> Array:
        """(T, E) of each link over the last `WINDOW_S` [m]."""
        return moving_mean(self.error, max(1, round(WINDOW_S * self.plan.experiment.rates.coordination_hz)))

    @cached_property
    def anchored(self) -> Array:
        """(T, A) of each anchor along the motion [m]."""
        return anchor_errors(self.plan.anchors_by_row, self.prediction.position)

    @cached_property
    def speed(self) -> Array:
        """(N,) that each robot may drive or fly at [m/s]."""
        return np.minimum([kind.speed for kind in self.plan.kinds], self.limits.top_speed)

    @cached_property
    def pull(self) -> Array:
        """(N,) the speed at which each robot follows its law [m/s]: a velocity, or a goal that is a full clamp away."""
        experiment, hz = self.plan.experiment, self.plan.experiment.rates.coordination_hz
        clamped = np.minimum(self.speed, closed_shares(self.plan.kinds, hz) * experiment.formation.clamp * hz)
        return np.where(self.prediction.velocities or False, self.speed, clamped)

    @cached_property
    def legs(self) -> list[tuple[int, str, Planner]]:
        """Number in the timeline, robot and planner of each leg."""
        built = {name: iter(legs) for name, legs in self.plan.legs_by_robot.items()}
        return [(k, leg.robot, next(built[leg.robot]).planner) for k, leg in enumerate(self.plan.experiment.timeline)]

    def sources(self, time: float, *robots: str) -> str:
        """Places in files that robots follow at a time [s], in brackets; empty if they follow none."""
        timeline = self.plan.experiment.timeline
        found = []
        for name in robots:
            begun = [(timeline[k].at_s, plan) for k, robot, plan in self.legs if robot == name]
            source = next((plan.source(time - at) for at, plan in reversed(begun) if at <= time), "")
            found += [source] if source else []
        return f" ({'; '.join(found)})" if found else ""

    @property
    def fastest(self) -> tuple[int, str, Planner] | None:
        """The leg that asks for most speed."""
        return max(self.legs, key=lambda leg: leg[2].speed(), default=None)

    @property
    def follower(self) -> int | None:
        """The slowest row that follows the formation and no plan."""
        planned = [self.plan.names.index(robot) for _, robot, _ in self.legs]
        rows = np.setdiff1d(self.plan.links.receiver, planned)
        return int(rows[self.pull[rows].argmin()]) if len(rows) else None

    @property
    def departure(self) -> float:
        """Time of the first moving leg or the first change of shape after the start [s]; without either the end."""
        timeline = self.plan.experiment.timeline
        leaves = [timeline[k].at_s for k, _, plan in self.legs if plan.speed() > 0]
        leaves += [each.at for each in self.plan.formation.changes]
        return min([*(at for at in leaves if at > 0), self.prediction.end_s])

    @property
    def spans_end(self) -> tuple[float, ...]:
        """Times until which the formation is to be acquired: before any plan begins, and at the end [s]."""
        return tuple(dict.fromkeys((self.departure, self.prediction.end_s)))

    @cached_property
    def noisy(self) -> Analysis | None:
        """The same with the motion of the flight with noise beside the ideal one, if there was one."""
        beside = self.prediction.noisy
        return None if beside is None or beside.stuck else Analysis(self.plan, beside)

    @cached_property
    def acquired_for_good(self) -> float | None:
        """Time of acquisition [s], if the formation is within the tolerance at the end as well."""
        times = [self.acquired(until) for until in self.spans_end]
        return None if None in times else times[0]

    def acquired(self, until: float) -> float | None:
        """Time from which on the mean of every link over `WINDOW_S` is within the tolerance, up to `until` [s]."""
        if not self.error.shape[1]:
            return None
        time = self.prediction.time
        worst = self.mean_error[time <= until + 1e-9].max(axis=1, initial=0.0)[:, None]
        return after_last(worst > self.plan.experiment.tolerance + FORGIVEN, time)[0] if len(worst) else None

    # ------------------------------------------------------------------ links in words

    def link(self, number: int | np.intp) -> str:
        names, links = self.plan.names, self.plan.links
        return f"{names[links.sender[number]]} - {names[links.receiver[number]]}"

    def link_path(self, number: int) -> Path:
        links, names = self.plan.links, self.plan.names
        ends = names[links.receiver[number]], names[links.sender[number]]
        given = self.plan.experiment.formation.links
        text = next((text for text in given if ends in link_pairs(text)), None)
        return ("formation", "links") if text is None else ("formation", "links", text)

    def fitting_links(self) -> dict[str, LinkTable]:
        """The links of the file with the nearest targets that fit together: those of the best shape, rounded to 0.1 mm.

        Empty where the shape has no links.
        """
        if self.shape is None:
            return {}
        place = dict(zip(self.plan.names, np.round(self.shape.position, 5), strict=True))
        return {
            text: _fitting(
                given if isinstance(given, LinkTable) else LinkTable(distance=given), *link_pairs(text)[0], place
            )
            for text, given in self.plan.experiment.formation.links.items()
        }


def _fitting(given: LinkTable, second: str, first: str, place: Mapping[str, Array]) -> LinkTable:
    """A link with the target that two places have; as it is if they fit it already."""
    offset = place[second] - place[first]
    if given.distance is not None:
        if abs(norm(offset) - given.distance) < FITTING:
            return given
        return msgspec.structs.replace(given, distance=round(float(norm(offset)), 4))
    count = len(given.offset or given.bearing or ())
    if given.offset is not None:
        if np.all(np.abs(offset[:count] - given.offset) < FITTING):
            return given
        return msgspec.structs.replace(given, offset=np.round(offset[:count], 4).tolist())
    return msgspec.structs.replace(given, bearing=np.round(offset[:count] / norm(offset[:count]), 4).tolist())
