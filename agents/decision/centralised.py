"""Centralised control: goals for many robots from the poses that they transmit. Pure.

`Centre` uses `agents.decision.goals` as each robot would for itself, with one difference: it knows a robot only by
its last received pose, extrapolated by the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.arrays import Array, Index, Mask, PoseTable, some
from agents.decision.assignment import Assignment
from agents.decision.goals import GoalComputer, StationKeeping
from agents.decision.lifecycle import AIRBORNE, RUNNING
from agents.decision.neighbours import NeighbourPoses

ROUNDING_S = 1e-6  # instants of decisions are multiples of a period that binary fractions miss by less than this


@dataclass(frozen=True)
class CentreGoals:
    """Goals to be sent (K)."""

    rows: Index  # (K,)
    goal: Array  # (K, 3) [m]
    yaw: Array  # (K,) wanted at the goal [rad], NaN for any
    pose_stamp: Array  # (K,) time of the pose from which the goal was computed [s]


class Centre:
    """Central controller of the rows `assignment.guided` among all robots (N) of an experiment."""

    def __init__(self, assignment: Assignment) -> None:
        """Take the `assignment` of all robots, with links, anchors and plans of the guided ones."""
        assert assignment.guided is not None
        rows = len(assignment.names)
        self.assignment, self.guided = assignment, assignment.guided
        self.goal_computer = GoalComputer(assignment, self.guided)
        self.poses = NeighbourPoses(rows)  # last received of each robot (N)
        self.yaw: Array = np.zeros(rows)  # (N,) last received [rad]
        self._holding = StationKeeping(self.goal_computer.ground)
        self.goal, self.goal_yaw = np.full((rows, 3), np.nan), np.full(rows, np.nan)
        self._pose_stamp, self._sent = np.full(rows, -np.inf), np.full(rows, -np.inf)
        self.decisions = 0  # since the first guided robot began
        # (N,) decisions at which the goal of each row was computed anew
        self.updates: Index = np.zeros(rows, dtype=np.intp)
        sends = np.zeros(rows, dtype=bool)
        sends[assignment.links.sender] = True
        self.needed: Index = np.flatnonzero(self.guided | sends)  # rows whose poses are needed

    def receive(self, received: PoseTable) -> None:
        """Store poses, whose `link` is the row of the robot, in order of arrival; outdated ones are dropped."""
        assert received.yaw is not None
        poses, new = self.poses, self.poses.receive(received)
        self.yaw[new.link] = new.yaw
        links = self._links(new.link)
        at = self.assignment.links.sender[links]
        self.goal_computer.neighbours.receive(
            PoseTable(links, links, poses.stamp[at], poses.arrival[at], poses.position[at], poses.velocity[at])
        )

    def begin_plan(self, row: int, origin: tuple[float, float, float, float]) -> None:
        """Begin the plan of a robot that began at `origin`, x, y, z [m] and yaw [rad], before this controller."""
        x, y, z, yaw = origin
        self.goal_computer.begin_plans(np.array([row]), np.array([[x, y, z]]), np.array([yaw]))

    def mark_lost(self, rows: Index, t: float) -> None:
        """Liveliness tokens of these robots lost at `t` [s]."""
        self.poses.mark_lost(rows, t)
        self.goal_computer.neighbours.mark_lost(self._links(rows), t)

    def mark_alive(self, rows: Index) -> None:
        """Liveliness tokens of these robots seen, whether or not poses follow."""
        self.poses.mark_alive(rows)
        self.goal_computer.neighbours.mark_alive(self._links(rows))

    def discard_poses(self, rows: Index) -> None:
        """Discard the poses of these robots, which were restarted."""
        self.poses.discard(rows)
        self.goal_computer.neighbours.discard_poses(self._links(rows))

    def missing_robots(self) -> Index:
        """Needed rows without a pose so far, or lost."""
        poses, rows = self.poses, self.needed
        return rows[~np.isfinite(poses.stamp[rows]) | (poses.lost_since[rows] < np.inf)]

    def decide(self, t: float, phase: Index, start: Array) -> CentreGoals:
        """Goals at `t` [s], for robots in `phase` (N,), as far as known, that `start` (N,) [s].

        A running robot gets a goal whenever a new one was decided, and again before the last one is too old. A waiting
        robot gets its own place as goal: with this goal and poses of all its neighbours it can begin.
        """
        deciding, poses, limits = self.goal_computer, self.poses, self.assignment.limits
        deciding.update_links(t)
        # a status with the new phase may be on its way, but the start is known
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
        self._pose_stamp = np.where(anew, poses.stamp, self._pose_stamp)
        deciding.require_update(np.flatnonzero(~running | held))
        again = running & (t - self._sent >= 0.5 * limits.link_silence_s)
        rows = np.flatnonzero((anew | again) & np.isfinite(self.goal).all(axis=1))
        self._sent[rows] = t
        return CentreGoals(rows, self.goal[rows], self.goal_yaw[rows], self._pose_stamp[rows])

    def _complete(self, t: float) -> Mask:
        """Rows (N,) with a pose of each neighbour, or after their patience."""
        complete = np.ones(len(self.guided), dtype=bool)
        patience, stamp = self.assignment.patience_s, self.goal_computer.neighbours.stamp_once_alive
        if patience is None or t <= patience:
            complete[self.assignment.links.receiver[self.assignment.unreceived(stamp)]] = False
        return complete

    def _links(self, rows: Index) -> Index:
        """All links with one of `rows` as sender."""
        sends = np.zeros(len(self.guided), dtype=bool)
        sends[rows] = True
        return np.flatnonzero(sends[self.assignment.links.sender])


class Guidance:
    """Goals received from the central controller, one per row (N), their age, and liveliness of the controller."""

    def __init__(self, guided: Mask, flies: Mask, silence_s: float) -> None:
        """Start without goals; those on wheels are on the floor, those older than `silence_s` [s] are ignored."""
        rows = len(guided)
        self.guided, self._flies, self._silence_s = guided, flies, silence_s
        self.goal: Array = np.full((rows, 3), np.nan)  # (N, 3) last received [m]
        self.goal_yaw: Array = np.full(rows, np.nan)  # (N,) wanted there [rad], NaN for any
        self.stamp: Array = np.full(rows, -np.inf)  # (N,) time of its decision [s]; minus infinity before the first
        self.fresh: Mask = np.zeros(rows, dtype=bool)  # (N,) goals not used yet
        self.lost_since = np.inf  # loss of the controller [s]; infinity while it is alive

    def receive(self, rows: Index, goal: Array, yaw: Array, stamp: Array) -> Mask:
        """Store goals (H, 3) of `rows` (H,), each once, decided at `stamp` (H,) [s]; returns which were new (H,)."""
        newer = np.asarray((stamp > self.stamp[rows]) & self.guided[rows] & np.isfinite(goal).all(axis=1))
        rows = rows[newer]
        self.goal[rows], self.goal_yaw[rows], self.stamp[rows] = goal[newer], yaw[newer], stamp[newer]
        self.goal[rows, 2] = np.where(self._flies[rows], self.goal[rows, 2], 0.0)
        self.fresh[rows] = True
        if self.lost_since < np.inf and some(
            self.stamp[rows] > self.lost_since
        ):  # decided after the loss: another controller
            self.lost_since = np.inf
        return newer

    def mark_lost(self, t: float) -> None:
        """Controller lost at `t` [s]; a goal decided later comes from another controller."""
        self.lost_since = min(self.lost_since, t)

    def mark_alive(self) -> None:
        """Controller alive, whether or not goals follow."""
        self.lost_since = np.inf

    def rows_without_goal(self) -> Mask:
        """Guided rows (N,) without any goal so far."""
        return np.asarray(self.guided & (self.stamp == -np.inf))

    def unguided(self, t: float) -> Mask:
        """Guided rows (N,) without guidance at `t` [s]: controller lost, or goal missing or too old."""
        if self.lost_since < np.inf:
            return self.guided
        return np.asarray(self.guided & ~(t - self.stamp <= self._silence_s))
