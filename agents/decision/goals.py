"""Where rows should go next: the law, plans and links of a formation, from where they are and what was heard.

Pure and row-wise. A robot asks it for itself, from where it is measured; the centre of a centralised experiment asks
it for all that it guides, from where they last said that they are.
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
from agents.plugins.planners import Itinerary
from agents.plugins.registry import FAILURES, PluginError


class GoalDecision(msgspec.Struct, frozen=True):
    """What a decision says of all rows; of those that are not `due` it means nothing.

    Attributes:
        due: (N,) rows that have a new goal.
        goal: (N, 3) [m].
        offset: (N, 3) of the law, before it was clamped [m].
        yaw: (N,) yaw wanted at the goal [rad], NaN for any.
    """

    due: Mask
    goal: Array
    offset: Array
    yaw: Array


class GoalComputer:
    """Goals of some of N rows.

    Attributes:
        neighbours: What was heard on each link, and who takes part in the law.
        clamp: Largest step of a goal per axis and decision [m].
        tracking_gain: k of (7) [1/(m² decision)].
        ground: (N,) heights that rows hold [m]; 0 for ground robots.
    """

    def __init__(self, assignment: Assignment, mine: Mask) -> None:
        """Of the rows `mine` (N,); links, anchors and plans of the others are none of its business."""
        rows = len(assignment.names)
        self._assignment, links = assignment, assignment.links
        self.neighbours = NeighbourStates(links, assignment.avoidance_only, assignment.limits.link_silence_s)
        self.clamp, self.tracking_gain = assignment.clamp, assignment.tracking_gain
        self._updating = None if assignment.update is None else ControlUpdates(assignment.update, rows, links)
        self._flies = np.array([kind.flies for kind in assignment.kinds])
        self.ground = np.where(self._flies, assignment.hover, 0.0)
        self._anchored = np.zeros(rows, dtype=bool)
        if assignment.anchors is not None:
            self._anchored[assignment.anchors.row] = True
        self._listens = self._anchored.copy()
        watched = assignment.avoidance_only
        self._listens[links.receiver if watched is None else links.receiver[~watched]] = True
        changing = bool(assignment.changes) or assignment.presence is not None
        self._reshaping = Reshaping(links, assignment.changes, assignment.presence) if changing else None
        if self._reshaping is not None:
            self.neighbours.set_targets(self._reshaping.links, self._reshaping.present)
        planned = np.zeros(rows, dtype=bool)
        itineraries = []
        for group, legs in assignment.legs:
            planned[group] = True
            for listens in (True, False):
                part = group[self._listens[group] == listens]
                if len(part):
                    itineraries.append(Itinerary(part, legs, holds_before=not listens))
        rest = np.flatnonzero(mine & ~planned & ~self._listens)
        if len(rest):  # nobody tells it anything: it stays where it is
            itineraries.append(Itinerary(rest, (), holds_before=True))
        self._itineraries = tuple(itineraries)
        self._gated = self._listens & ~planned  # a plan moves its target while nobody looks

    def update_links(self, t: float) -> None:
        """Takes in who is there and who is gone at `t` [s]."""
        if self.neighbours.incomplete:
            self._links_changed(self.neighbours.update_active(t))

    def without_neighbours(self) -> Mask:
        """Rows (N,) that the law has no answer for: all their neighbours are gone."""
        hearing = self.neighbours
        if len(hearing.active) == len(self._assignment.links):
            return np.zeros(len(self._listens), dtype=bool)
        hears = self._anchored.copy()
        hears[hearing.links.receiver] = True
        return self._listens & ~hears

    def begin_plans(self, rows: Index, place: Array, yaw: Array, elapsed_s: float = 0.0) -> None:
        """Plans of `rows` (K,) that have not begun do so where these were when they did: (K, 3) [m] and (K,) [rad].

        Legs that are due `elapsed_s` after the common start follow from there [s].
        """
        count = len(self._listens)
        elapsed, position, heading = np.full(count, -np.inf), np.full((count, 3), np.nan), np.zeros(count)
        elapsed[rows], position[rows], heading[rows] = elapsed_s, place, yaw
        position[:, 2] = self.ground
        for itinerary in self._itineraries:
            mine = itinerary.rows
            itinerary.target(elapsed[mine], position[mine], heading[mine])

    def origin(self, row: int) -> tuple[float, float, float, float] | None:
        """x, y, z [m] and yaw [rad] where the plan of a row began; None if it has none, or it has not begun."""
        return next(filter(None, (itinerary.origin(row) for itinerary in self._itineraries)), None)

    def require_update(self, rows: Index) -> None:
        """Rows whose goals are old compute the law at the next decision, whatever a trigger says."""
        if self._updating is not None:
            self._updating.require_update(rows)

    def decide(
        self, t: float, position: Array, velocity: Array, yaw: Array, *, start: Array, running: Mask
    ) -> GoalDecision:
        """New goals of rows that are under way.

        Args:
            t: Now [s].
            position: (N, 3) where rows are, or are believed to be [m].
            velocity: (N, 3) [m/s].
            yaw: (N,) [rad].
            start: (N,) when each row began [s].
            running: (N,) rows that want a goal.
        """
        follows, due, view = self._listens, running, None
        if self._reshaping is not None:
            everywhere = self.neighbours.extrapolate_all(self._assignment.predictor, t)
            self._reshaping.advance(t - start, position, everywhere)
            self._links_changed(self.neighbours.set_targets(self._reshaping.links, self._reshaping.present))
        if self._updating is not None:
            view = self.control_view(t, position, velocity, start)
            due = running & (~self._gated | self._updating.due(view))
        if view is None:
            offset = self.law_offset(t, position)
        else:
            offset = view.offset if some(due & follows) else np.zeros_like(position)
        goal = position.copy()
        toward = np.full(len(position), np.nan)
        place = position.copy()
        place[:, 2] = self.ground  # a plan begins at the height that is held, not where the climb was called done
        for itinerary in self._itineraries:
            rows = itinerary.rows
            target, toward[rows] = itinerary.target(t - start[rows], place[rows], yaw[rows])
            leads = ~follows[rows]
            if leads.all():
                goal[rows] = target
            else:
                offset[rows] += laws.tracking_offset(position[rows], target, self.tracking_gain)
        goal = np.where(follows[:, None], laws.goal_position(position, offset, self.clamp), goal)
        goal[:, 2] = np.where(follows | ~self._flies, self.ground, goal[:, 2])
        return GoalDecision(due, goal, offset, toward)

    def law_offset(self, t: float, position: Array) -> Array:
        """The offset of all rows (N, 3) [m]; a law that fails is named, for it may be somebody's first."""
        law, hearing, anchors = self._assignment.law, self.neighbours, self._assignment.anchors
        believed = hearing.poses.extrapolate_position(self._assignment.predictor, t, hearing.active)
        try:
            offset = law.offset(position, believed, hearing.links)
        except FAILURES as error:
            raise PluginError(f"the law {type(law).__name__} failed: {type(error).__name__}: {error}") from error
        return offset if anchors is None else offset + anchors.offset(position)

    def errors(self, t: float, position: Array) -> tuple[Array, Array]:
        """Σ|e| [m] and Σ ½e² [m²] of each row's links, as it sees them."""
        hearing = self.neighbours
        believed = hearing.poses.extrapolate_position(self._assignment.predictor, t, hearing.active)
        error = self._assignment.law.error(position, believed, hearing.links)
        both = hearing.links.sum_by_receiver(_error_and_energy(error), len(position))
        anchors = self._assignment.anchors
        if anchors is not None:
            np.add.at(both, anchors.row, _error_and_energy(anchors.error(position)))
        return both[:, 0], both[:, 1]

    def control_view(self, t: float, position: Array, velocity: Array, start: Array) -> ControlView:
        """What the trigger of the control place sees; see `decide`."""
        assert self._updating is not None
        hearing, predictor = self.neighbours, self._assignment.predictor
        listener = hearing.links.receiver
        believed = hearing.poses.extrapolate_position(predictor, t, hearing.active)
        moves = hearing.poses.extrapolate_velocity(predictor, t, hearing.active)
        return self._updating.view(
            t, position, velocity,
            start=start,
            live=hearing.active,
            links=hearing.links,
            anchored=self._anchored,
            apart=position[listener] - believed,
            rate=velocity[listener] - moves,
            law=lambda: self.law_offset(t, position),
            errors=lambda: self.errors(t, position),
        )  # fmt: skip

    def _links_changed(self, rows: Index) -> None:
        """Rows that got or lost a link, or whose links ask for something else, compute the law at once."""
        if len(rows):
            self.require_update(rows)


class StationKeeping:
    """Rows that stay where they were when that began.

    Attributes:
        held: (N,) which.
    """

    def __init__(self, ground: Array) -> None:
        """Rows that hold their heights, `ground` (N,) [m]."""
        self._ground, self._at = ground, np.full((len(ground), 3), np.nan)
        self.held: Mask = np.zeros(len(ground), dtype=bool)

    def hold_position(self, held: Mask, position: Array, goal: Array, toward: Array) -> tuple[Array, Array]:
        """Goals (N, 3) [m] and yaws (N,) [rad] when rows `held` (N,) must stay and the others have those given."""
        before, self.held = self.held, held
        if not some(held):
            return goal, toward
        entered = held & ~before
        if some(entered):
            self._at[entered] = np.nan
        nowhere = held & np.isnan(self._at[:, 0])  # who does not know where it is stays where it finds itself
        if some(nowhere):
            self._at[nowhere] = position[nowhere]
            self._at[nowhere, 2] = self._ground[nowhere]
        return np.where(held[:, None], self._at, goal), np.where(held, np.nan, toward)


def _error_and_energy(error: Array) -> Array:
    both = np.empty((len(error), 2))  # `stack` takes three times as long
    both[:, 0], both[:, 1] = error, 0.5 * error * error
    return both
