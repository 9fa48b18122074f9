"""One case of an experiment in numbers: its network, the shape that it asks for, and the motion to be expected."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from agents.agent import Assignment
from agents.graph import Rigidity, components, edges
from agents.planning import Planner
from agents.rows import Array, Index, Mask
from experiments import assign
from experiments.experiment import Experiment
from experiments.feasibility import (
    Modes,
    Shape,
    algebraic_connectivity,
    link_errors,
    modes,
    realise,
    stiffness,
    unfolded,
)
from experiments.links import pairs
from experiments.locate import Path
from experiments.prediction import Prediction, closed, predict
from twins.scene import Scene

GUESSES: Final = 400  # random places of robots from which a shape is sought: each costs time with their number


@dataclass(frozen=True)
class Analysis:
    """The numbers of one case.

    Attributes:
        experiment: The case.
        assignment: Of all its robots; without avoidance, and without the links that only avoidance needs.
        leaders: Names.
        silent: Rows that hear nobody.
        start: (N, 3) on the floor [m].
        parts: Of the network.
        fiedler: Algebraic connectivity.
        shapes: Places that were tried; `shape` is the best.
        shape: None without links.
        planar: Rigidity with heights held.
        spatial: Rigidity in full space.
        modes: Of the sampled loop at the shape.
        prediction: The motion.
        error: (T, E) of each link along it [m].
        scene: What stands in the arena.
    """

    experiment: Experiment
    assignment: Assignment
    leaders: tuple[str, ...]
    silent: Index
    start: Array
    parts: int
    fiedler: float
    shapes: tuple[Shape, ...]
    shape: Shape | None
    planar: Rigidity | None
    spatial: Rigidity | None
    modes: Modes | None
    prediction: Prediction
    error: Array
    scene: Scene

    @property
    def names(self) -> tuple[str, ...]:
        return self.assignment.names

    @property
    def edges(self) -> int:
        """How many pairs are linked, directions ignored."""
        return len(edges(self.assignment.links))

    @property
    def speed(self) -> Array:
        """(N,) that each robot may drive or fly at [m/s]."""
        own = np.array([kind.speed for kind in self.assignment.kinds])
        return np.asarray(np.minimum(own, self.assignment.limits.speed))

    @property
    def pull(self) -> Array:
        """(N,) the speed at which each robot follows a goal that is a full clamp away [m/s]."""
        hz = self.experiment.rates.coordination_hz
        return np.minimum(self.speed, closed(self.assignment.kinds, hz) * self.assignment.clamp * hz)

    @property
    def legs(self) -> list[tuple[int, str, Planner]]:
        """Number in the timeline, robot and planner of each leg."""
        built = {name: iter(legs) for (rows, legs) in self.assignment.legs for name in [self.names[rows[0]]]}
        return [(k, leg.robot, next(built[leg.robot]).planner) for k, leg in enumerate(self.experiment.timeline)]

    @property
    def departure(self) -> float:
        """When the first robot leaves by plan, after the start; infinity if none does [s]."""
        timeline = self.experiment.timeline
        return min(
            (timeline[k].at_s for k, _, plan in self.legs if plan.speed() > 0 and timeline[k].at_s > 0),
            default=math.inf,
        )

    @property
    def fastest(self) -> tuple[int, str, Planner] | None:
        """The leg that asks for most speed."""
        return max(self.legs, key=lambda leg: leg[2].speed(), default=None)

    @property
    def follower(self) -> int | None:
        """The slowest row that follows the formation and no plan."""
        planned = [self.names.index(robot) for _, robot, _ in self.legs]
        rows = np.setdiff1d(self.assignment.links.listener, planned)
        return int(rows[self.pull[rows].argmin()]) if len(rows) else None

    def acquired(self, until: float) -> float | None:
        """From when on every link keeps within the tolerance, up to `until` [s]."""
        time = self.prediction.time
        outside = self.error.max(axis=1, initial=0.0)[time <= until + 1e-9] > self.experiment.tolerance
        if not len(outside) or outside[-1]:
            return None
        bad = np.flatnonzero(outside)
        return float(time[bad[-1] + 1]) if len(bad) else 0.0

    def link(self, number: int) -> str:
        """A link in words."""
        links = self.assignment.links
        return f"{self.names[links.speaker[number]]} - {self.names[links.listener[number]]}"

    def link_path(self, number: int) -> Path:
        """Where a link stands in the file."""
        wanted = self.assignment.links.listener[number], self.assignment.links.speaker[number]
        wanted_names = tuple(self.names[row] for row in wanted)
        return next(
            (("formation", "links", text) for text in self.experiment.formation.links if wanted_names in pairs(text)),
            ("formation", "links"),
        )


def analyse(experiment: Experiment) -> Analysis:
    """All the numbers of one case."""
    names = tuple(experiment.robots)
    assignment = replace(
        assign.assign(experiment, names), links=assign.all_links(experiment), watched=None, avoidance=None
    )
    links, rows, hz = assignment.links, len(names), experiment.rates.coordination_hz
    start, yaw = assign.start(experiment, names)
    aloft = start.copy()
    aloft[:, 2] = np.nan_to_num(assignment.hover)
    silent = np.setdiff1d(np.arange(rows), links.listener)
    prediction = predict(assignment, aloft, yaw, silent, hz)
    shapes: list[Shape] = []
    shape, planar, spatial, loop = None, None, None, None
    if len(links):
        shapes = _shapes(experiment, assignment, prediction, aloft, silent)
        shape = min(shapes, key=lambda each: each.worst)
        planar, spatial = stiffness(shape.position, links, silent)
        loop = modes(assignment.law, links, shape.position, closed(assignment.kinds, hz), hz)
    return Analysis(
        experiment=experiment,
        assignment=assignment,
        leaders=tuple(assign.leaders(experiment)),
        silent=silent,
        start=start,
        parts=components(links, rows),
        fiedler=algebraic_connectivity(links, rows),
        shapes=tuple(shapes),
        shape=shape,
        planar=planar,
        spatial=spatial,
        modes=loop,
        prediction=prediction,
        error=link_errors(links, prediction.position),
        scene=assign.scene(experiment),
    )


def _shapes(
    experiment: Experiment, assignment: Assignment, prediction: Prediction, aloft: Array, silent: Index
) -> list[Shape]:
    """Where the robots end, where they start, what the distances suggest, and random places, until one is exact."""
    end, rows = prediction.position[-1], len(aloft)
    moves = np.ones(rows, dtype=bool)
    moves[silent] = False
    rng = np.random.default_rng(experiment.seed)

    def guesses() -> Iterator[Array]:
        yield end
        plane = unfolded(assignment.links, aloft[:, 2])
        anchor = silent[:1] if len(silent) else np.arange(rows)
        for mirror in (1.0, -1.0):
            flipped = plane * [1.0, mirror, 1.0]
            flipped[:, :2] += (end[anchor] - flipped[anchor]).mean(axis=0)[:2]
            yield _rest(flipped, end, moves)
        yield _rest(aloft, end, moves)
        for _ in range(min(10, GUESSES // rows)):
            place = rng.uniform(-0.5, 0.5, (rows, 2)) * experiment.arena.size[:2]
            yield _rest(np.column_stack([place, aloft[:, 2]]), end, moves)

    return realise(assignment.links, guesses(), moves)


def _rest(guess: Array, end: Array, moves: Mask) -> Array:
    """Leaders stay where their plans leave them."""
    return np.where(moves[:, None], guess, end)
