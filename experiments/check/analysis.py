"""Analysis of one case: network, shape, rigidity, modes, and predicted motion."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, cast

import msgspec
import numpy as np

from agents.body.kinds import Kind
from agents.body.limits import Limits
from agents.decision.position_control import REACHED
from agents.plugins.law import Law
from agents.plugins.laws import Gradient
from agents.plugins.planners import Planner
from experiments.check.findings import FORGIVEN
from experiments.check.ideal_run import Prediction, bearable_factors, closed_shares
from experiments.check.realisation import (
    Shape,
    Solids,
    best_shape,
    find_shapes,
    formation_redundancy,
    formation_rigidity,
    targets_of_law,
    unfold_distances,
)
from experiments.check.stability import Modes, modes
from experiments.definition.experiment import LinkTable
from experiments.definition.formation import (
    Anchored,
    Pattern,
    anchor_errors,
    anchor_offsets,
    errors_over_time,
    law_offsets,
)
from experiments.definition.graph import Links, components, edges
from experiments.definition.links import held_height, link_pairs
from experiments.definition.plan import Plan
from experiments.definition.rigidity import Redundancy, Rigidity
from experiments.file.problems import Path
from experiments.metrics.signals import WINDOW_S, after_last, moving_mean
from twins.arrays import Array, Index, Mask, norm
from twins.scene import Scene

MANY_ROBOTS: Final = (
    500  # robots of which it is not asked any more what can be lost: the time grows with their third power
)
FITTING: Final = 1e-4  # [m] between a target and that of the best shape
STANDS: Final = 0.001  # [m] moved by less in `WINDOW_S`
GUESSES: Final = 400  # random places of robots from which a shape is sought: each costs time with their number


@dataclass(frozen=True)
class Analysis:
    """Figures of one case."""

    plan: Plan  # the case, compiled
    without_neighbours: Index  # rows without neighbours
    start: Array  # (N, 3) on the floor [m]
    parts: int  # of the network
    asked: Links  # the links of the beginning, with what the law takes them to ask for
    standing: Mask  # (E,) those that are there at the beginning, however far the robots are from each other
    # places that were tried for the last stage of the formation, the best of which is to be its end
    shapes: tuple[Shape, ...]
    shape: Shape | None  # the best for the beginning; None if no link stands then
    later: tuple[Shape, ...]  # the best after each change
    planar: Rigidity | None  # rigidity with heights held
    spatial: Rigidity | None  # rigidity in full space
    # what the formation can lose and stay rigid, of the pairs `edges(...)` of the links that stand at the beginning;
    # None if it is not rigid, if its links ask for more than distances, or if it has too many robots
    spare: Redundancy | None
    modes: Modes | None  # of the sampled loop at the shape
    prediction: Prediction  # the motion
    error: Array  # (T, E) of each link along it [m]; 0 while it is not there
    anchored: Array  # (T, A) of each anchor along it [m]
    scene: Scene  # what stands in the arena

    @property
    def pattern(self) -> Pattern:
        return self.plan.formation

    @property
    def law(self) -> Gradient:
        """The law, for callers that know it as a gradient."""
        return cast(Gradient, self.plan.law)

    @property
    def is_gradient(self) -> bool:
        """Whether the law pulls toward targets of its links; else there is neither shape nor error."""
        return isinstance(self.plan.law, Gradient)

    @property
    def links(self) -> Links:
        """Every link of the law that there may be, with the targets of the beginning."""
        return self.plan.links

    @property
    def anchors(self) -> Anchored:
        return self.plan.anchors_by_row

    @property
    def kinds(self) -> tuple[Kind, ...]:
        return self.plan.kinds

    @property
    def height(self) -> Array:
        """(N,) that each robot holds [m]: 0 on wheels."""
        return np.array([held_height(self.plan.experiment, name) for name in self.names])

    @property
    def limits(self) -> Limits:
        """Limits of every robot, except `hold_s`."""
        return self.plan.limits(self.names[0])

    @property
    def names(self) -> tuple[str, ...]:
        return self.plan.names

    @property
    def speed(self) -> Array:
        """(N,) that each robot may drive or fly at [m/s]."""
        own = np.array([kind.speed for kind in self.kinds])
        return np.asarray(np.minimum(own, self.limits.top_speed))

    @property
    def pull(self) -> Array:
        """(N,) the speed at which each robot follows its law [m/s]: a velocity, or a goal that is a full clamp away."""
        hz = self.plan.experiment.rates.coordination_hz
        clamped = np.minimum(self.speed, closed_shares(self.kinds, hz) * self.plan.experiment.formation.clamp * hz)
        return np.where(self.prediction.velocities or False, self.speed, clamped)

    @property
    def legs(self) -> list[tuple[int, str, Planner]]:
        """Number in the timeline, robot and planner of each leg."""
        built = {name: iter(legs) for name, legs in self.plan.legs_by_robot.items()}
        return [(k, leg.robot, next(built[leg.robot]).planner) for k, leg in enumerate(self.plan.experiment.timeline)]

    @property
    def departure(self) -> float:
        """Time of the first moving leg or the first change of shape after the start [s]; infinity without either."""
        timeline = self.plan.experiment.timeline
        leaves = [timeline[k].at_s for k, _, plan in self.legs if plan.speed() > 0]
        return min((at for at in (*leaves, *(each.at for each in self.pattern.changes)) if at > 0), default=math.inf)

    @property
    def fastest(self) -> tuple[int, str, Planner] | None:
        """The leg that asks for most speed."""
        return max(self.legs, key=lambda leg: leg[2].speed(), default=None)

    @property
    def follower(self) -> int | None:
        """The slowest row that follows the formation and no plan."""
        planned = [self.names.index(robot) for _, robot, _ in self.legs]
        rows = np.setdiff1d(self.links.receiver, np.array(planned, dtype=np.intp))
        return int(rows[self.pull[rows].argmin()]) if len(rows) else None

    @property
    def mean_error(self) -> Array:
        """(T, E) of each link over the last `WINDOW_S` [m]."""
        window = max(1, round(WINDOW_S * self.plan.experiment.rates.coordination_hz))
        return moving_mean(self.error, window)

    @property
    def spans_end(self) -> tuple[float, ...]:
        """Times until which the formation is to be acquired: before any plan begins, and at the end [s]."""
        end = float(self.prediction.time[-1])
        return tuple(dict.fromkeys((min(self.departure, end), end)))

    def flown(self, prediction: Prediction) -> Analysis:
        """The same with another motion."""
        return replace(
            self,
            prediction=prediction,
            error=link_errors(self.plan.law, self.pattern, prediction),
            anchored=anchor_errors(self.anchors, prediction.position),
        )

    @cached_property
    def noisy(self) -> Analysis | None:
        """The same with the motion of the flight with noise beside the ideal one, if there was one."""
        beside = self.prediction.noisy
        return None if beside is None or beside.stuck else self.flown(beside)

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

    def stopped(self, at: int) -> Index:
        """Robots on wheels that stand at sample `at`, because their goals are too near to drive to."""
        at %= len(self.prediction.time)
        time, position, pattern = self.prediction.time, self.prediction.position, self.pattern
        links, hz = pattern.at(float(time[at])), self.plan.experiment.rates.coordination_hz
        there, here = pattern.present(time[at : at + 1], position[at : at + 1]), position[at]
        links = links if there is None else links.take(there[0])
        offset = law_offsets(self.law, here, here[links.sender], links) + anchor_offsets(self.anchors, here)
        stands = norm(position[at] - position[max(0, at - round(WINDOW_S * hz))]) < STANDS
        wheels = np.array([not kind.flies for kind in self.kinds])
        length = norm(offset[:, :2])
        return np.flatnonzero(wheels & stands & (length > 0.1 * REACHED) & (length < 2.0 * REACHED))

    def link(self, number: int) -> str:
        links = self.links
        return f"{self.names[links.sender[number]]} - {self.names[links.receiver[number]]}"

    def pair(self, number: int) -> str:
        """A pair of `edges(...)` of the links that stand at the beginning, in words."""
        first, second = edges(self.asked.take(self.standing))[number]
        return f"{self.names[first]} - {self.names[second]}"

    def link_path(self, number: int) -> Path:
        wanted = self.links.receiver[number], self.links.sender[number]
        ends = tuple(self.names[row] for row in wanted)
        return next(
            (("formation", "links", text) for text in self.plan.experiment.formation.links if ends in link_pairs(text)),
            ("formation", "links"),
        )

    def fitting_links(self) -> dict[str, LinkTable]:
        """The links of the file with the nearest targets that fit together: those of the best shape, rounded to 0.1 mm.

        Empty where the shape has no links.
        """
        if self.shape is None:
            return {}
        place = dict(zip(self.names, np.round(self.shape.position, 5), strict=True))
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


def analyse(plan: Plan, prediction: Prediction) -> Analysis:
    """Analysis of one case with this predicted motion."""
    experiment, names = plan.experiment, plan.names
    law, kinds, pattern, anchors = plan.law, plan.kinds, plan.formation, plan.anchors_by_row
    links, rows, hz = pattern.links, len(names), experiment.rates.coordination_hz
    starts, _ = plan.start_poses()
    start = np.array(starts)
    aloft = start.copy()
    aloft[:, 2] = [held_height(experiment, name) for name in names]
    anchored = np.array([row for row, _ in anchors], dtype=np.intp)
    silent = np.setdiff1d(np.arange(rows), np.concatenate([links.receiver, anchored]))
    standing = pattern.planned_at(0.0)
    stages: list[list[Shape]] = []
    shape, planar, spatial, spare, loop = None, None, None, None, None
    asked = targets_of_law(law, links)
    if isinstance(law, Gradient) and (standing.any() or len(anchored)):
        for at, wanted in zip((0.0, *(each.at + each.over for each in pattern.changes)), pattern.stages(), strict=True):
            there = pattern.planned_at(at)
            stage = _shapes(plan, targets_of_law(law, wanted), there, prediction, aloft, silent)
            stages.append(stage)
        shape = best_shape(stages[0])
        here = asked.take(standing)
        planar, spatial = formation_rigidity(shape.position, here, silent, anchors)
        if planar.rigid and spatial is not None and rows <= MANY_ROBOTS:
            spare = formation_redundancy(shape.position, here, silent)
        share = closed_shares(kinds, hz)
        within = experiment.duration_s
        bearable = bearable_factors(kinds, hz)
        loop = modes(
            law, here, shape.position, share, hz,
            bearable=bearable, anchors=anchors, within_s=within,
        )  # fmt: skip
    return Analysis(
        plan=plan,
        without_neighbours=silent,
        start=start,
        parts=components(links, rows),
        asked=asked,
        standing=standing,
        shapes=tuple(stages[-1]) if stages else (),
        shape=shape,
        later=tuple(best_shape(each) for each in stages[1:]),
        planar=planar,
        spatial=spatial,
        spare=spare,
        modes=loop,
        prediction=prediction,
        error=link_errors(law, pattern, prediction),
        anchored=anchor_errors(anchors, prediction.position),
        scene=plan.scene,
    )


def link_errors(law: Law, pattern: Pattern, prediction: Prediction) -> Array:
    """Error of each link (T, E) along the motion [m]; 0 while it is not there."""
    return np.nan_to_num(errors_over_time(law, pattern, prediction.time, prediction.position))


def _shapes(  # noqa: PLR0917 - one caller
    plan: Plan, wanted: Links, there: Mask, prediction: Prediction, aloft: Array, silent: Index
) -> list[Shape]:
    """Shapes from the ends, the starts, the scaled distances and random places as guesses, until one is exact."""
    experiment, end = plan.experiment, prediction.position[-1].copy()
    rows, links = len(aloft), wanted.take(there)
    moves = np.ones(rows, dtype=bool)
    moves[silent] = False
    landed = moves & (end[:, 2] < aloft[:, 2] / 2)  # before the end: on the floor it has no place in the shape
    end[landed, 2] = aloft[landed, 2]
    rng = np.random.default_rng(experiment.seed)

    def guesses() -> Iterator[Array]:
        yield end
        plane = unfold_distances(links, aloft[:, 2])
        anchor = silent[:1] if len(silent) else np.arange(rows)
        for mirror in (1.0, -1.0):
            flipped = plane * [1.0, mirror, 1.0]
            flipped[:, :2] += (end[anchor] - flipped[anchor]).mean(axis=0)[:2]
            yield _resting_place(flipped, end, moves)
        yield _resting_place(aloft, end, moves)
        for _ in range(min(10, GUESSES // rows)):
            place = rng.uniform(-0.5, 0.5, (rows, 2)) * experiment.arena.size[:2]
            yield _resting_place(np.column_stack([place, aloft[:, 2]]), end, moves)

    found, solids = [], Solids.of(plan.kinds, links, moves)
    for each in find_shapes(links, guesses(), moves, plan.anchors_by_row, solids=solids):
        error = np.zeros(len(there))
        error[there] = each.error
        found.append(replace(each, error=error))
    return found


def _resting_place(guess: Array, end: Array, moves: Mask) -> Array:
    """The guess, with leaders where their plans leave them."""
    return np.where(moves[:, None], guess, end)
