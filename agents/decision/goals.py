"""Goals of rows: formation law, plans, links and station keeping, from own positions and received poses.

Pure and row-wise. A robot computes its own goal from its measured position; the central controller computes the goals
of all robots that it guides from their last received poses.
"""

from __future__ import annotations

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask, some
from agents.decision.assignment import Assignment
from agents.decision.control_updates import ControlUpdates, ControlView
from agents.decision.neighbours import NeighbourStates
from agents.formation.changes import Reshaping
from agents.plugins import laws
from agents.plugins.calls import call
from agents.plugins.planners import Itinerary, Leg, Waypoints


class GoalDecision(msgspec.Struct, frozen=True):
    """Result of a decision for all rows (N); meaningless for rows that are not `due`."""

    due: Mask  # (N,) rows with a new goal
    goal: Array  # (N, 3) [m]
    offset: Array  # (N, 3) of the law, before it was clamped [m]
    yaw: Array  # (N,) wanted at the goal [rad], NaN for any


class GoalComputer:
    """Goals of some of N rows."""

    def __init__(self, assignment: Assignment, mine: Mask) -> None:
        """Compute goals of the rows `mine` (N,); links, anchors and plans of the others are not used."""
        rows = len(assignment.names)
        self._assignment, links = assignment, assignment.links
        self.neighbours = NeighbourStates(links, assignment.avoidance_only, assignment.limits.link_silence_s)
        self.clamp = assignment.clamp  # largest step of a goal per axis and decision [m]
        self.tracking_gain = assignment.tracking_gain  # k of (7) [1/(m² decision)]
        self._updating = None if assignment.update is None else ControlUpdates(assignment.update, rows, links)
        self._flies = np.array([kind.flies for kind in assignment.kinds])
        self.ground: Array = np.where(self._flies, assignment.hover, 0.0)  # (N,) heights that rows hold [m]
        self._anchored = np.zeros(rows, dtype=bool)
        if assignment.anchors is not None:
            self._anchored[assignment.anchors.row] = True
        self._uses_law = self._anchored.copy()
        avoidance_only = assignment.avoidance_only
        self._uses_law[links.receiver if avoidance_only is None else links.receiver[~avoidance_only]] = True
        changing = bool(assignment.changes) or assignment.presence is not None
        self._reshaping = Reshaping(links, assignment.changes, assignment.presence) if changing else None
        if self._reshaping is not None:
            self.neighbours.set_targets(self._reshaping.links, self._reshaping.present)
        planned = np.zeros(rows, dtype=bool)
        itineraries = []
        for group, legs in assignment.legs:
            planned[group] = True
            for lawful in (True, False):
                part = group[self._uses_law[group] == lawful]
                if len(part):
                    itineraries.append(Itinerary(part, legs, holds_before=not lawful))
        rest = np.flatnonzero(mine & ~planned & ~self._uses_law)
        if len(rest):  # neither law nor plan: stay in place
            itineraries.append(Itinerary(rest, (), holds_before=True))
        self._itineraries = tuple(itineraries)
        self._detours: dict[int, tuple[float, Itinerary]] = {}  # since when [s], by row
        self._gated = self._uses_law & ~planned  # a plan moves its target at every decision

    def update_links(self, t: float) -> None:
        """Update the active links at `t` [s] for neighbours that appeared or were lost."""
        if self.neighbours.incomplete:
            self.require_update(self.neighbours.update_active(t))

    def without_neighbours(self) -> Mask:
        """Rows (N,) for which the law has no input: all their neighbours are lost."""
        neighbours = self.neighbours
        if len(neighbours.active) == len(self._assignment.links):
            return np.zeros(len(self._uses_law), dtype=bool)
        has_input = self._anchored.copy()
        has_input[neighbours.links.receiver] = True
        return self._uses_law & ~has_input

    def begin_plans(self, rows: Index, place: Array, yaw: Array, elapsed_s: float = 0.0) -> None:
        """Begin the plans of `rows` (K,) at `place` (K, 3) [m] and `yaw` (K,) [rad], if they have not begun.

        Legs that are due `elapsed_s` after the common start follow from there [s].
        """
        count = len(self._uses_law)
        elapsed, position, heading = np.full(count, -np.inf), np.full((count, 3), np.nan), np.zeros(count)
        elapsed[rows], position[rows], heading[rows] = elapsed_s, place, yaw
        position[:, 2] = self.ground
        for itinerary in self._itineraries:
            mine = itinerary.rows
            itinerary.target(elapsed[mine], position[mine], heading[mine])

    def leads(self, row: int) -> bool:
        """Whether a row has neither links nor anchors: it follows a plan, or stays."""
        return not self._uses_law[row]

    def redirect(self, row: int, goal: tuple[float, float], t: float, speed: float) -> None:
        """Sends a row that leads to x, y [m] instead of along its plan, from `t` [s] on, at `speed` [m/s]."""
        way = Leg(0.0, Waypoints(points=[list(goal)], speed_=speed))
        self._detours[row] = t, Itinerary(np.array([row]), (way,), holds_before=False)

    def origin(self, row: int) -> tuple[float, float, float, float] | None:
        """x, y, z [m] and yaw [rad] at which the plan of a row began; None without plan, or before."""
        return next(filter(None, (itinerary.origin(row) for itinerary in self._itineraries)), None)

    def require_update(self, rows: Index) -> None:
        """Rows with old goals, or new targets, compute the law at the next decision, whatever a trigger decides."""
        if self._updating is not None:
            self._updating.require_update(rows)

    def decide(
        self,
        t: float,  # now [s]
        position: Array,  # (N, 3) measured or believed [m]
        velocity: Array,  # (N, 3) [m/s]
        yaw: Array,  # (N,) [rad]
        *,
        start: Array,  # (N,) [s]
        running: Mask,  # (N,) rows that want a goal
    ) -> GoalDecision:
        follows, due, view = self._uses_law, running, None
        if self._reshaping is not None:
            everywhere = self.neighbours.extrapolate_all(self._assignment.predictor, t)
            self._reshaping.advance(t - start, position, everywhere)
            self.require_update(self.neighbours.set_targets(self._reshaping.links, self._reshaping.present))
        if self._updating is not None:
            view = self.control_view(t, position, velocity, start)
            due = running & (~self._gated | self._updating.due(view))
        if view is None:
            offset = self.law_offset(t, position)
        else:
            offset = view.offset if some(due & follows) else np.zeros_like(position)
        goal = position.copy()
        goal_yaw = np.full(len(position), np.nan)
        place = position.copy()
        place[:, 2] = self.ground  # a plan begins at the held height, not where the climb ended
        for itinerary in self._itineraries:
            rows = itinerary.rows
            target, goal_yaw[rows] = itinerary.target(t - start[rows], place[rows], yaw[rows])
            leads = ~follows[rows]
            if leads.all():
                goal[rows] = target
            else:
                offset[rows] += laws.tracking_offset(position[rows], target, self.tracking_gain)
        for row, (since, way) in self._detours.items():
            goal[[row]], goal_yaw[[row]] = way.target(np.array([t - since]), place[[row]], yaw[[row]])
        goal = np.where(follows[:, None], laws.goal_position(position, offset, self.clamp), goal)
        goal[:, 2] = np.where(follows | ~self._flies, self.ground, goal[:, 2])
        return GoalDecision(due, goal, offset, goal_yaw)

    def law_offset(self, t: float, position: Array) -> Array:
        """Offset of all rows (N, 3) [m]; raises PluginError, which names the law, if it fails."""
        law, neighbours, anchors = self._assignment.law, self.neighbours, self._assignment.anchors
        believed = neighbours.poses.extrapolate_position(self._assignment.predictor, t, neighbours.active)
        inputs = position, believed, neighbours.links
        offset = call("law", law, "offset", *inputs, shape=position.shape, each="a vector for each robot")
        return offset if anchors is None else offset + anchors.offset(position)

    def errors(self, t: float, position: Array) -> tuple[Array, Array]:
        """Σ|e| [m] and Σ ½e² [m²] of the links of each row, as it knows them.

        Raises PluginError if the law fails, or gives something else than one error for each link.
        """
        law, neighbours = self._assignment.law, self.neighbours
        believed = neighbours.poses.extrapolate_position(self._assignment.predictor, t, neighbours.active)
        inputs, shape = (position, believed, neighbours.links), neighbours.links.receiver.shape
        error = call("law", law, "error", *inputs, shape=shape, each="one value for each link")
        both = neighbours.links.sum_by_receiver(_error_and_energy(error), len(position))
        anchors = self._assignment.anchors
        if anchors is not None:
            np.add.at(both, anchors.row, _error_and_energy(anchors.error(position)))
        return both[:, 0], both[:, 1]

    def control_view(self, t: float, position: Array, velocity: Array, start: Array) -> ControlView:
        assert self._updating is not None
        neighbours, predictor, active = self.neighbours, self._assignment.predictor, self.neighbours.active
        receiver = neighbours.links.receiver
        apart = position[receiver] - neighbours.poses.extrapolate_position(predictor, t, active)
        rate = velocity[receiver] - neighbours.poses.extrapolate_velocity(predictor, t, active)
        return ControlView(
            t, position, velocity, self._updating.last_event, start, neighbours.links,
            self._updating.inputs(active), (apart, rate), self._anchored,
            law=lambda: self.law_offset(t, position),
            errors=lambda: self.errors(t, position),
        )  # fmt: skip


class StationKeeping:
    """Rows (N) that stay at the place where their hold began."""

    def __init__(self, ground: Array) -> None:
        """Hold at the heights `ground` (N,) [m]."""
        self._ground, self._at = ground, np.full((len(ground), 3), np.nan)
        self.held: Mask = np.zeros(len(ground), dtype=bool)  # (N,) rows that stay

    def hold_position(self, held: Mask, position: Array, goal: Array, yaw: Array) -> tuple[Array, Array]:
        """Goals (N, 3) [m] and yaws (N,) [rad]: the held place for rows `held` (N,), else the given ones."""
        before, self.held = self.held, held
        if not some(held):
            return goal, yaw
        entered = held & ~before
        if some(entered):
            self._at[entered] = np.nan
        nowhere = held & np.isnan(self._at[:, 0])  # rows without a position stay at the first known one
        if some(nowhere):
            self._at[nowhere] = position[nowhere]
            self._at[nowhere, 2] = self._ground[nowhere]
        return np.where(held[:, None], self._at, goal), np.where(held, np.nan, yaw)


def _error_and_energy(error: Array) -> Array:
    both = np.empty((len(error), 2))  # `stack` takes three times as long
    both[:, 0], both[:, 1] = error, 0.5 * error * error
    return both
