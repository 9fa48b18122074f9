"""Goals of a robot: formation law, plan, links and station keeping, from its own position and received poses. Pure.

A robot computes its own goal from its measured position; the central controller computes the goal of each robot that it
guides from that robot's last received pose. `errors`, `law_offset` and `decide` are quiet unless the formation changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, isfinite, isnan, nan
from typing import ClassVar, cast

from agents.decision.assignment import Assignment
from agents.decision.control_updates import ControlUpdates
from agents.decision.neighbours import Neighbours
from agents.decision.stepping import Stepping, is_sound
from agents.formation.changes import change_target, exists, planned_at
from agents.plugins.calls import unknown_reads
from agents.plugins.law import NeighbourView, View
from agents.plugins.laws import Gradient, goal_position, tracking_offset
from agents.plugins.planners import Itinerary, Leg, Waypoints
from agents.vectors import UNKNOWN, ZERO, Pose, Vector, difference, is_finite, norm


class GoalComputer:
    """Goals of one robot."""

    FIXED: ClassVar = ("_gated", "changes_shape", "follows", "needs_company")
    RARE: ClassVar = ("step", "reshape")

    def __init__(self, assignment: Assignment, *, passive: bool = False) -> None:
        """Of a robot with an `assignment`; `passive`: its goals come from elsewhere."""
        links, legs = assignment.neighbours, assignment.legs
        # a law that is no gradient, at work; without one `law` is a gradient
        self.stepping = None if isinstance(assignment.law, Gradient) else Stepping(assignment)
        self.law = cast(Gradient, assignment.law)
        self._anchors, self.predictor, self._changes = assignment.anchors, assignment.predictor, assignment.changes
        says = None if self.stepping is None else self.stepping.says
        self.neighbours = Neighbours(links, assignment.limits.neighbour_timeout_s, says)
        self.clamp = assignment.clamp  # largest step of a goal per axis and decision [m]
        self.tracking_gain = assignment.tracking_gain  # k of (7) [1/(m² decision)]
        self._flies, self.ground = assignment.kind.flies, assignment.ground  # height that it holds [m]
        linked = any(link.in_law for link in links)
        alone = self.stepping is not None and self.stepping.alone and not (passive or legs)
        self.follows = bool(self._anchors) or linked or alone  # the law moves it
        # without neighbours it stays in place
        self.needs_company = linked and not self._anchors and not assignment.law.ALONE
        self._given = [replace(sender.link) for sender in self.neighbours.all]
        self.changes_shape = bool(self._changes)  # targets or links of the formation change
        for sender in self.neighbours.all:
            planned = planned_at(sender.since, sender.until, sender.reach, 0.0)
            sender.present = sender.in_law and planned
            self.changes_shape = self.changes_shape or not planned or sender.until < inf
        self.itinerary: Itinerary | None = None
        if legs or not (self.follows or passive):  # neither law nor plan: stay in place
            self.itinerary = Itinerary(legs, holds_before=not self.follows)
        self._detour: Itinerary | None = None
        self._detour_since = 0.0
        self._gated = self.follows and not legs  # a plan moves its target at every decision
        self._updating = None
        if assignment.update is not None:
            self._updating = ControlUpdates(assignment.update, len(links), anchored=bool(self._anchors))
        self.goal, self.yaw = UNKNOWN, nan  # decided last [m], and wanted there [rad], NaN for any
        self.offset = ZERO  # offset of the law at the last decision, before it was clamped [m]
        self.error = self.energy = 0.0  # Σ|e| of the links [m] and Σ ½e² [m²], of the last call of `errors`
        self.judged = False  # True if that call found an active link or an anchor, or took the error of a step

    def update_links(self, t: float) -> None:
        """Update the active links at `t` [s] for neighbours that appeared or were lost."""
        if self.neighbours.incomplete and self.neighbours.update_active(t):
            self.require_update()

    def without_neighbours(self) -> bool:
        """Whether the law has no input: all neighbours are lost, or not there now."""
        if not self.needs_company:
            return False
        for sender in self.neighbours.all:  # noqa: SIM110 - quiet
            if sender.active:
                return False
        return True

    def begin_plan(self, place: Vector, yaw: float, elapsed_s: float = 0.0) -> None:
        """Begin the plan at `place` [m] and `yaw` [rad], if it has not begun.

        Legs that are due `elapsed_s` after the common start follow from there [s].
        """
        if self.itinerary is not None:
            self.itinerary.target(elapsed_s, (place[0], place[1], self.ground), yaw)

    @property
    def leads(self) -> bool:
        """Whether the robot has neither links nor anchors: it follows a plan, or stays."""
        return not self.follows

    def redirect(self, goal: tuple[float, float], t: float, speed: float) -> None:
        """Send a robot that leads to x, y [m] instead of along its plan, from `t` [s] on, at `speed` [m/s]."""
        way = Leg(0.0, Waypoints(points=[list(goal)], speed_=speed))
        self._detour, self._detour_since = Itinerary((way,), holds_before=False), t

    @property
    def origin(self) -> Pose | None:
        """x, y, z [m] and yaw [rad] at which the plan began; None without plan, or before."""
        return None if self.itinerary is None else self.itinerary.origin

    def require_update(self) -> None:
        """Compute the law at the next decision, whatever a trigger decides: the goal is old, or targets are new."""
        if self._updating is not None:
            self._updating.require()

    def decide(self, t: float, position: Vector, velocity: Vector, yaw: float, start: float) -> bool:
        """Decide the goal at `t` [s] of a robot that began at `start` [s]; returns whether it is a new one.

        Args:
            position: Measured or believed [m].
            velocity: Likewise [m/s].
            yaw: Likewise [rad].
        """
        if self.stepping is not None:
            return self._decide_by_steps(self.stepping, t, position, velocity, yaw, start)
        elapsed = t - start
        if self.changes_shape:
            self.reshape(elapsed, position, t)
        offset = ZERO
        if self.follows:
            offset = self.law_offset(t, position)
        if self._updating is not None and self._gated:
            if self._updating.asking.trigger.JUDGES_ERRORS:
                self.errors(t, position)
            if not self._updating.due(
                t, position, velocity, self.neighbours, self.predictor, max(elapsed, 0.0), offset, self.error,
                self.energy,
            ):  # fmt: skip
                return False
        goal, goal_yaw = position, nan
        place = position[0], position[1], self.ground  # a plan begins at the held height, not where the climb ended
        if self.itinerary is not None:
            x, y, z, goal_yaw = self.itinerary.target(elapsed, place, yaw)
            if self.follows:
                a, b, c = tracking_offset(position, (x, y, z), self.tracking_gain)
                offset = offset[0] + a, offset[1] + b, offset[2] + c
            else:
                goal = x, y, z
        if self._detour is not None:
            x, y, z, goal_yaw = self._detour.target(t - self._detour_since, place, yaw)
            goal = x, y, z
        if self.follows:
            goal = goal_position(position, offset, self.clamp)
        if self.follows or not self._flies:
            goal = goal[0], goal[1], self.ground
        self.goal, self.yaw, self.offset = goal, goal_yaw, offset
        return True

    def law_offset(self, t: float, position: Vector) -> Vector:
        """Offset u_i of the law and the anchors at `t` [s] for a robot at `position` [m]."""
        law, predictor = self.law, self.predictor
        x = y = z = 0.0
        for sender in self.neighbours.all:
            if sender.active:
                a, b, c = law.pull(sender.apart(position, predictor, t), sender.link)
                x, y, z = x + a, y + b, z + c
        for anchor in self._anchors:
            a, b, c = anchor.pull(position)
            x, y, z = x + a, y + b, z + c
        return x, y, z

    def errors(self, t: float, position: Vector) -> None:
        """Compute `error` and `energy` of the links at `t` [s], as a robot at `position` [m] knows them.

        Those of a law that is no gradient are of its last step, without `energy`, which is NaN.
        """
        if self.stepping is not None:
            self.error, self.energy = self.stepping.error, nan
            self.judged = True
            return
        law, predictor = self.law, self.predictor
        total = energy = 0.0
        judged = len(self._anchors) > 0
        for sender in self.neighbours.all:
            if sender.active:
                judged = True
                error = abs(law.error(sender.apart(position, predictor, t), sender.link))
                total, energy = total + error, energy + 0.5 * error * error
        for anchor in self._anchors:
            error = anchor.error(position)
            total, energy = total + error, energy + 0.5 * error * error
        self.error, self.energy, self.judged = total, energy, judged

    def step(self, t: float, position: Vector, velocity: Vector, yaw: float, start: float) -> None:
        """Let a law that is no gradient step; for the arguments see `decide`. Quiet, if the law is."""
        if self.changes_shape:
            self.reshape(t - start, position, t)
        if self.stepping is not None:
            self.stepping.step(self.view(t, position, velocity, yaw, start))

    def is_sound(self, t: float, position: Vector) -> bool:
        """Whether the law, asked at `t` [s] for a robot that stands at `position` [m], wants what is finite."""
        if self.stepping is None:
            return is_finite(self.law_offset(t, position))
        control = self.stepping.rehearse(self.view(t, position, ZERO, 0.0, t))
        return is_sound(control.velocity) and is_sound(control.goal)

    def unknown_reads(self, t: float, position: Vector) -> str:
        """Words on what the law reads although it is unknown; empty without. In flight, too: it changes nothing."""
        stepping, law = self.stepping, self.law
        if stepping is not None:
            view = self._sight(t, position, ZERO, 0.0, UNKNOWN if self.itinerary is None else position, ZERO)
            return unknown_reads(law, lambda watched: stepping.rehearse(watched(view)))
        senders = [each for each in self.neighbours.all if each.active]
        return unknown_reads(
            law,
            lambda watched: [law.pull(each.apart(position, self.predictor, t), watched(each.link)) for each in senders],
        )

    def view(self, t: float, position: Vector, velocity: Vector, yaw: float, start: float) -> View:
        """View of a law that is no gradient; for the arguments see `decide`. Quiet."""
        target, speed = UNKNOWN, ZERO
        stepping = self.stepping
        assert stepping is not None
        if self.itinerary is not None:
            x, y, z, _ = self.itinerary.target(t - start, (position[0], position[1], self.ground), yaw)
            target = x, y, z
            speed = stepping.speed_of(target, stepping.length())
        return self._sight(t, position, velocity, yaw, target, speed)

    def _sight(  # noqa: PLR0917 - quiet
        self, t: float, position: Vector, velocity: Vector, yaw: float, target: Vector, speed: Vector
    ) -> View:
        """View with this target of the plan [m], and its speed [m/s]."""
        stepping, predictor = self.stepping, self.predictor
        assert stepping is not None
        neighbours = [
            NeighbourView(
                sender.sender, sender.name, sender.place(predictor, t), sender.velocity, sender.yaw, t - sender.stamp,
                dict(sender.said), sender.link,
            )
            for sender in self.neighbours.all
            if sender.active
        ]  # fmt: skip
        return stepping.view(neighbours, position, velocity, yaw, target, speed, not self.follows)

    def _decide_by_steps(  # noqa: PLR0917 - quiet: compilers take no arguments by name alone
        self, stepping: Stepping, t: float, position: Vector, velocity: Vector, yaw: float, start: float
    ) -> bool:
        """As `decide`, for a law that is no gradient; where it gives a velocity, the goal is the robot's place."""
        if stepping.speech is None:
            self.step(t, position, velocity, yaw, start)
        place = position[0], position[1], self.ground
        goal, goal_yaw = place, stepping.yaw
        if self.follows:
            if stepping.gives_goal:
                wanted = stepping.goal
                goal = goal_position(place, difference(wanted, place), self.clamp)
                if not self._flies or isnan(wanted[2]):
                    goal = goal[0], goal[1], self.ground
        elif self.itinerary is not None:
            x, y, z, goal_yaw = self.itinerary.target(t - start, place, yaw)
            goal = x, y, z
        if self._detour is not None:
            x, y, z, goal_yaw = self._detour.target(t - self._detour_since, place, yaw)
            goal = x, y, z
        if not self._flies:
            goal = goal[0], goal[1], self.ground
        self.goal, self.yaw = goal, goal_yaw
        return True

    def rare_parts(self) -> list[object]:
        """Objects beside this one that `step` and `reshape` read or change."""
        parts: list[object] = [*self.neighbours.all]
        if self.changes_shape:
            parts += [sender.link for sender in self.neighbours.all]
            parts += [] if self._updating is None else [self._updating.asking.last]
        if self.stepping is not None:
            parts += [self.stepping] if self.stepping.speech is None else [self.stepping, self.stepping.speech]
        return parts

    def reshape(self, elapsed: float, position: Vector, t: float) -> None:
        """Set targets and presence of the links `elapsed` [s] after the start."""
        elapsed, changed = max(elapsed, 0.0), False
        for sender, given in zip(self.neighbours.all, self._given, strict=True):
            if not sender.in_law:
                continue
            if self._changes:
                changed |= change_target(sender.link, given, self._changes, sender.targets, elapsed)
            a, b, c = sender.place(self.predictor, t)
            apart = norm((position[0] - a, position[1] - b, position[2] - c))
            reach = sender.release if sender.present else sender.reach
            sender.present = exists(sender.since, sender.until, reach, elapsed, apart)
        if self.neighbours.select() or changed:
            self.require_update()


@dataclass(eq=False, slots=True)
class StationKeeping:
    """The place where the hold of a robot began."""

    ground: float  # its height [m]
    at: Vector = UNKNOWN  # [m]
    held: bool = False

    def hold(self, held: bool, position: Vector) -> None:
        """Begin, go on or end a hold; a robot without a position stays at the first known one."""
        if held and (not self.held or not isfinite(self.at[0])):
            self.at = (position[0], position[1], self.ground) if is_finite(position) else UNKNOWN
        self.held = held
