"""The centre of a centralised experiment: one decision for many robots, from what they said of themselves. Pure.

It asks `agents.decision.goals` as each robot would for itself, with one difference: it knows where a robot is only from
the last pose that it heard of it, carried on by the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.arrays import Array, Index, Mask, some
from agents.decision.assignment import Assignment
from agents.decision.goals import GoalComputer, StationKeeping
from agents.decision.lifecycle import AIRBORNE, RUNNING
from agents.decision.neighbours import NeighbourPoses

ROUNDING_S = 1e-6  # instants of decisions are multiples of a period that binary fractions miss by less than this


@dataclass(frozen=True)
class CentreGoals:
    """Goals to be sent (K).

    Attributes:
        rows: Whose.
        goal: (K, 3) [m].
        yaw: (K,) yaw wanted there [rad], NaN for any.
        pose_stamp: (K,) when the pose of that robot was taken on which its goal rests [s].
    """

    rows: Index
    goal: Array
    yaw: Array
    pose_stamp: Array


class Centre:
    """Decides for the rows `assignment.guided` of all robots of an experiment.

    Attributes:
        poses: What was last heard of each robot (N).
        yaw: (N,) and where it looked [rad].
        needed: Rows whose poses it needs: those that it guides, and those to whom they listen.
        goal_computer: Computes the goals.
        decisions: Since the first robot that it guides began.
        updates: (N,) of these, those at which each row's goal was computed anew.
    """

    def __init__(self, assignment: Assignment) -> None:
        """`assignment` of all robots, with links, anchors and plans of those that are guided."""
        assert assignment.guided is not None
        rows = len(assignment.names)
        self.assignment, self.guided = assignment, assignment.guided
        self.goal_computer = GoalComputer(assignment, self.guided)
        self.poses, self.yaw = NeighbourPoses.none_received(rows), np.zeros(rows)
        self._holding = StationKeeping(self.goal_computer.ground)
        self.goal, self.goal_yaw = np.full((rows, 3), np.nan), np.full(rows, np.nan)
        self._rests, self._sent = np.full(rows, -np.inf), np.full(rows, -np.inf)
        self.decisions = 0
        self.updates: Index = np.zeros(rows, dtype=np.intp)
        speaks = np.zeros(rows, dtype=bool)
        speaks[assignment.links.sender] = True
        self.needed: Index = np.flatnonzero(self.guided | speaks)

    def receive(  # noqa: PLR0917 - as `Hearing.hear`
        self, rows: Index, position: Array, velocity: Array, yaw: Array, stamp: Array, arrived: Array
    ) -> None:
        """Poses of `rows` (H,) that arrived, in order of arrival; older samples than known are left out."""
        poses = self.poses
        order = np.argsort(stamp, kind="stable")  # of several of one robot the newest stays, whichever came last
        order = order[stamp[order] > poses.stamp[rows[order]]]
        mine = rows[order]
        poses.position[mine], poses.velocity[mine], self.yaw[mine] = position[order], velocity[order], yaw[order]
        poses.stamp[mine], poses.arrival[mine] = stamp[order], arrived[order]
        links = self._links(mine)
        who = self.assignment.links.sender[links]
        self.goal_computer.neighbours.receive(
            links, poses.position[who], poses.velocity[who], poses.stamp[who], poses.arrival[who]
        )

    def begin_plan(self, row: int, origin: tuple[float, float, float, float]) -> None:
        """A robot began at `origin`, x, y, z [m] and yaw [rad]: its plan does too, though this centre was not there."""
        x, y, z, yaw = origin
        self.goal_computer.begin_plans(np.array([row]), np.array([[x, y, z]]), np.array([yaw]))

    def mark_lost(self, rows: Index, t: float) -> None:
        """The tokens of these robots are gone since `t` [s]."""
        self.poses.lost_since[rows] = np.minimum(self.poses.lost_since[rows], t)
        self.goal_computer.neighbours.mark_lost(self._links(rows), t)

    def mark_alive(self, rows: Index) -> None:
        """The tokens of these robots are there: they live, whether or not they have something to say."""
        self.poses.lost_since[rows] = np.inf
        self.goal_computer.neighbours.mark_alive(self._links(rows))

    def discard_poses(self, rows: Index) -> None:
        """These robots begin a new life: poses of the one before are of another robot."""
        poses = self.poses
        poses.position[rows], poses.velocity[rows] = np.nan, 0.0
        poses.stamp[rows] = poses.arrival[rows] = -np.inf
        self.goal_computer.neighbours.discard_poses(self._links(rows))

    def missing_robots(self) -> Index:
        """Rows that it needs and never heard, or that are gone."""
        poses, rows = self.poses, self.needed
        return rows[~np.isfinite(poses.stamp[rows]) | (poses.lost_since[rows] < np.inf)]

    def decide(self, t: float, phase: Index, start: Array) -> CentreGoals:
        """Goals at `t` [s].

        Who runs gets one whenever it was decided anew, and again when the last one would soon be too old. Who still
        waits is told to stay: a robot that heard this, and whose neighbours were all heard, can begin.

        Args:
            t: Now [s].
            phase: (N,) of the robots, as far as is known.
            start: (N,) when each began [s].
        """
        deciding, poses, limits = self.goal_computer, self.poses, self.assignment.limits
        deciding.update_links(t)
        # a status that says so may still be on its way, but the start was known before
        phase = np.where((phase == AIRBORNE) & (t >= start - ROUNDING_S), RUNNING, phase)
        known = self.guided & np.isfinite(poses.stamp) & (poses.lost_since == np.inf)
        running, waiting = known & (phase == RUNNING), known & (phase <= AIRBORNE) & self._complete(t)
        position = np.full((len(known), 3), np.nan)
        position[known] = poses.extrapolate_position(self.assignment.predictor, t, np.flatnonzero(known))
        held = anew = (running & deciding.without_neighbours()) | waiting
        if running.any():
            self.decisions += 1
            new = deciding.decide(t, position, poses.velocity, self.yaw, start=start, running=running)
            self.goal = np.where(new.due[:, None], new.goal, self.goal)
            self.goal_yaw = np.where(new.due, new.yaw, self.goal_yaw)
            self.updates += new.due
            held = (running & deciding.without_neighbours()) | waiting  # links may have come or gone by the decision
            anew = held | new.due
        self.goal, self.goal_yaw = self._holding.hold_position(held, position, self.goal, self.goal_yaw)
        self._rests = np.where(anew, poses.stamp, self._rests)
        deciding.require_update(np.flatnonzero(~running | held))
        again = running & (t - self._sent >= 0.5 * limits.link_silence_s)
        rows = np.flatnonzero((anew | again) & np.isfinite(self.goal).all(axis=1))
        self._sent[rows] = t
        return CentreGoals(rows, self.goal[rows], self.goal_yaw[rows], self._rests[rows])

    def _complete(self, t: float) -> Mask:
        """Rows (N,) whose neighbours were all heard once, or waited for long enough."""
        complete = np.ones(len(self.guided), dtype=bool)
        patience, stamp = self.assignment.patience_s, self.goal_computer.neighbours.stamp_once_alive
        if patience is None or t <= patience:
            complete[self.assignment.links.receiver[self.assignment.unreceived(stamp)]] = False
        return complete

    def _links(self, rows: Index) -> Index:
        """All links on which `rows` are heard."""
        spoke = np.zeros(len(self.guided), dtype=bool)
        spoke[rows] = True
        return np.flatnonzero(spoke[self.assignment.links.sender])


class Guidance:
    """Goals from the centre, for some of N rows.

    Attributes:
        guided: (N,) which rows it decides for.
        goal: (N, 3) told last [m].
        goal_yaw: (N,) yaw wanted there [rad], NaN for any.
        stamp: (N,) when it was decided [s]; minus infinity before the first.
        fresh: (N,) goals that nobody has acted on yet.
        lost_since: Since when the centre is known to be dead [s]; infinity while it lives.
    """

    def __init__(self, guided: Mask, flies: Mask, silence_s: float) -> None:
        """Before anything was told.

        Args:
            guided: (N,) which rows.
            flies: (N,) rows that do; the others' goals are on the floor.
            silence_s: A goal that is older is none [s].
        """
        rows = len(guided)
        self.guided, self._flies, self._silence_s = guided, flies, silence_s
        self.goal, self.goal_yaw = np.full((rows, 3), np.nan), np.full(rows, np.nan)
        self.stamp, self.lost_since = np.full(rows, -np.inf), np.inf
        self.fresh: Mask = np.zeros(rows, dtype=bool)

    def receive(self, rows: Index, goal: Array, toward: Array, stamp: Array) -> Mask:
        """Goals (H, 3) of `rows` (H,), each once, that arrived: decided at `stamp` (H,) [s]. Which were news."""
        newer = np.asarray((stamp > self.stamp[rows]) & self.guided[rows] & np.isfinite(goal).all(axis=1))
        rows = rows[newer]
        self.goal[rows], self.goal_yaw[rows], self.stamp[rows] = goal[newer], toward[newer], stamp[newer]
        self.goal[rows, 2] = np.where(self._flies[rows], self.goal[rows, 2], 0.0)
        self.fresh[rows] = True
        if self.lost_since < np.inf and some(
            self.stamp[rows] > self.lost_since
        ):  # decided after that: there is another
            self.lost_since = np.inf
        return newer

    def mark_lost(self, t: float) -> None:
        """The centre is gone since `t` [s]; a goal that was decided later is of another one."""
        self.lost_since = min(self.lost_since, t)

    def mark_alive(self) -> None:
        """The centre is back, though it may have nothing to say yet."""
        self.lost_since = np.inf

    def rows_without_goal(self) -> Mask:
        """Guided rows (N,) that were never told anything."""
        return np.asarray(self.guided & (self.stamp == -np.inf))

    def unguided(self, t: float) -> Mask:
        """Guided rows (N,) that nobody guides at `t` [s]: the centre is dead, or their goal is old, or not there."""
        if self.lost_since < np.inf:
            return self.guided
        return np.asarray(self.guided & ~(t - self.stamp <= self._silence_s))
