"""Centralised control: goals for many robots from the poses that they transmit. Pure.

`Centre` uses `agents.decision.goals` as each robot would for itself, with one difference: it knows a robot only by
its last received pose, extrapolated by the prediction. What a law says goes from one robot to the next without a
network, as it was at the last decision.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isfinite, nan
from typing import NamedTuple

from agents.decision.assignment import Assignment
from agents.decision.goals import GoalComputer, StationKeeping
from agents.decision.lifecycle import AIRBORNE, RUNNING
from agents.decision.neighbours import NO_WORDS
from agents.plugins.law import Values
from agents.ticks import ROUNDING_S
from agents.vectors import UNKNOWN, ZERO, Pose, Vector, is_finite


class CentreGoal(NamedTuple):
    """Goal to be sent to a robot."""

    row: int
    goal: Vector  # [m]
    yaw: float  # wanted at the goal [rad], NaN for any
    pose_stamp: float  # time of the pose from which the goal was computed [s]
    velocity: Vector = UNKNOWN  # output of a law that gives velocities [m/s]; its third NaN: the height is held


class Followed:
    """A robot as the central controller knows it."""

    def __init__(self, assignment: Assignment) -> None:
        self.guided = self.needed = assignment.guided  # gets goals; its poses are needed
        self.held = False  # True if its safety holds it, as far as known; set by the caller
        self.words: Mapping[str, Values] = NO_WORDS  # what its law says, as it was at the last decision
        self.computer, self.keeping = GoalComputer(assignment), StationKeeping(assignment.ground)  # makers of its goals
        # guided robots that receive its poses, and by which link
        self.receivers: list[tuple[GoalComputer, int]] = []
        self.position, self.velocity = UNKNOWN, ZERO  # last received [m], [m/s]
        self.yaw = 0.0  # likewise [rad]
        self.stamp = -inf  # [s]; minus infinity before the first pose
        self.lost_since = -inf  # [s]; infinity: alive; minus infinity: never seen
        self.goal, self.goal_yaw = UNKNOWN, nan  # last goal [m], and what is wanted there [rad], NaN for any
        self.pose_stamp = -inf  # stamp of the pose on which it rests [s]
        self.sent_at = -inf  # [s]
        self.updates = 0  # decisions that recomputed its goal


class Centre:
    """Central controller of the guided ones among all robots of an experiment."""

    def __init__(self, assignments: Sequence[Assignment]) -> None:
        """Take the assignments of all robots, with links, anchors and plans of the guided ones."""
        self.assignments = tuple(assignments)
        self.robots = [Followed(each) for each in assignments]
        for assignment, robot in zip(assignments, self.robots, strict=True):
            for link, incoming in enumerate(assignment.neighbours):
                sender = self.robots[incoming.sender]
                sender.receivers.append((robot.computer, link))
                sender.needed = True
        self.decisions = 0  # count since the first guided robot began

    @property
    def needed(self) -> list[int]:
        """Rows of robots with needed poses."""
        return [row for row, robot in enumerate(self.robots) if robot.needed]

    def receive(
        self, row: int, position: Vector, velocity: Vector, stamp: float, arrival: float, *, yaw: float
    ) -> None:
        """Store a pose of a robot; an outdated one is dropped."""
        robot = self.robots[row]
        if not stamp > robot.stamp:
            return
        robot.position, robot.velocity, robot.yaw, robot.stamp = position, velocity, yaw, stamp
        for computer, link in robot.receivers:
            computer.neighbours.receive(link, position, velocity, stamp, arrival, yaw=yaw, said=robot.words)

    def begin_plan(self, row: int, origin: Pose) -> None:
        """Begin the plan of a robot that began at `origin`, x, y, z [m] and yaw [rad], before this controller."""
        x, y, z, yaw = origin
        self.robots[row].computer.begin_plan((x, y, z), yaw)

    def mark_lost(self, row: int, t: float) -> None:
        """Liveliness token of this robot lost at `t` [s]."""
        robot = self.robots[row]
        robot.lost_since = min(robot.lost_since, t)
        for computer, link in robot.receivers:
            computer.neighbours.mark_lost(link, t)

    def mark_alive(self, row: int) -> None:
        """Liveliness token of this robot seen, whether or not poses follow."""
        self.robots[row].lost_since = inf
        for computer, link in self.robots[row].receivers:
            computer.neighbours.mark_alive(link)

    def discard_pose(self, row: int) -> None:
        """Discard the pose of this robot, which was restarted."""
        robot = self.robots[row]
        robot.velocity, robot.stamp = ZERO, -inf
        for computer, link in robot.receivers:
            computer.neighbours.discard_pose(link)

    def missing_robots(self) -> list[int]:
        """Needed robots without a pose so far, or lost."""
        return [
            row
            for row, robot in enumerate(self.robots)
            if robot.needed and (not isfinite(robot.stamp) or robot.lost_since < inf)
        ]

    def decide(self, t: float, phase: Sequence[int], start: Sequence[float]) -> list[CentreGoal]:
        """Goals at `t` [s], for robots in each `phase`, as far as known, that `start` [s].

        A running robot gets a goal whenever a new one was decided, and again before the last one is too old. A waiting
        robot gets its own place as goal: with this goal and poses of all its neighbours it can begin.
        """
        found, any_runs = [], False
        for row, robot in enumerate(self.robots):
            if not robot.guided:
                continue
            robot.computer.update_links(t)
            known = isfinite(robot.stamp) and robot.lost_since == inf
            # a status with the new phase may be on its way, but the start is known
            begun = phase[row] == AIRBORNE and t >= start[row] - ROUNDING_S
            runs = known and (begun or phase[row] == RUNNING)
            any_runs = any_runs or runs
            hovers = known and not runs and phase[row] <= AIRBORNE and self._complete(row, t)
            if (goal := self._goal_of(row, t, start[row], runs=runs, hovers=hovers)) is not None:
                found.append(goal)
        self.decisions += any_runs
        self._exchange_words()
        return found

    def _exchange_words(self) -> None:
        """After all have decided, what each law says becomes known to the others."""
        for robot in self.robots:
            stepping = robot.computer.stepping
            if robot.guided and stepping is not None and stepping.speech is not None:
                stepping.speech.record()
                robot.words = dict(stepping.speech.words)
                for computer, link in robot.receivers:
                    computer.neighbours.hear(link, robot.words)

    def _step(self, row: int, t: float, position: Vector, start: float) -> None:
        """Prepare the step of a law that remembers; one that says something steps here, as on a robot."""
        robot, assignment = self.robots[row], self.assignments[row]
        stepping = robot.computer.stepping
        if stepping is None:
            return
        stepping.moves = not (robot.held or robot.computer.without_neighbours())
        stepping.tick = round((t - start) * assignment.body_hz)
        if stepping.speech is not None:
            robot.computer.step(t, position, robot.velocity, robot.yaw, start)

    def _goal_of(self, row: int, t: float, start: float, *, runs: bool, hovers: bool) -> CentreGoal | None:
        robot, assignment = self.robots[row], self.assignments[row]
        computer, new = robot.computer, False
        velocity = UNKNOWN
        position = UNKNOWN
        if isfinite(robot.stamp):
            position = assignment.predictor.position(robot, t - robot.stamp)
        if runs:
            self._step(row, t, position, start)
            new = computer.decide(t, position, robot.velocity, robot.yaw, start)
            if new:
                robot.goal, robot.goal_yaw = computer.goal, computer.yaw
                robot.updates += 1
            if computer.stepping is not None:
                if not computer.stepping.sound:
                    return None  # a robot without goals holds
                if computer.follows and not computer.stepping.gives_goal:
                    velocity = computer.stepping.velocity
        held = (runs and computer.without_neighbours()) or hovers
        robot.keeping.hold(held, position)
        if held:
            robot.goal = robot.keeping.at
            robot.goal_yaw, velocity = nan, UNKNOWN
        if new or held:
            robot.pose_stamp = robot.stamp
        if held or not runs:
            computer.require_update()
        again = runs and t - robot.sent_at >= 0.5 * assignment.limits.neighbour_timeout_s
        if not ((new or held or again) and is_finite(robot.goal)):
            return None
        robot.sent_at = t
        return CentreGoal(row, robot.goal, robot.goal_yaw, robot.pose_stamp, velocity)

    def _complete(self, row: int, t: float) -> bool:
        """Whether a robot has a pose of each neighbour, or its patience is over."""
        patience = self.assignments[row].patience_s
        return (patience is not None and t > patience) or not self.robots[row].computer.neighbours.unreceived()


class ReceivedGoals:
    """Goal received from the central controller, its age, and liveliness of the controller."""

    def __init__(self, *, flies: bool, silence_s: float) -> None:
        """Start without a goal; on wheels it is on the floor, and none is older than `silence_s` [s]."""
        self._flies, self._silence_s = flies, silence_s
        self.goal, self.goal_yaw = UNKNOWN, nan  # last received [m], and wanted there [rad], NaN for any
        self.velocity = UNKNOWN  # wanted [m/s], its third NaN: the height is held; NaN: the robot goes to the goal
        self.stamp = -inf  # time of its decision [s]; minus infinity before the first
        self.fresh = False  # not used yet
        self.lost_since = inf  # loss of the controller [s]; infinity while it is alive

    def receive(self, goal: Vector, yaw: float, stamp: float, velocity: Vector = UNKNOWN) -> bool:
        """Store a goal that was decided at `stamp` [s]; returns whether it was new."""
        if not (stamp > self.stamp and is_finite(goal)):
            return False
        self.goal = goal if self._flies else (goal[0], goal[1], 0.0)
        self.goal_yaw, self.stamp = yaw, stamp
        self.fresh, self.velocity = True, velocity
        if stamp > self.lost_since:  # decided after the loss: another controller
            self.lost_since = inf
        return True

    def begin_anew(self) -> None:
        """Forget the time of the last goal: the clock of a new controller may be behind that of the former one."""
        self.stamp = -inf

    def mark_lost(self, t: float) -> None:
        """Controller lost at `t` [s]; a goal decided later comes from another controller."""
        self.lost_since = min(self.lost_since, t)

    def mark_alive(self) -> None:
        """Controller alive, whether or not goals follow."""
        self.lost_since = inf

    @property
    def missing(self) -> bool:
        """Whether there was no goal so far."""
        return self.stamp == -inf

    def unguided(self, t: float) -> bool:
        """Whether guidance is missing at `t` [s]: controller lost, or goal missing or too old."""
        return self.lost_since < inf or not t - self.stamp <= self._silence_s
