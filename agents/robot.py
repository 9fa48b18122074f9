"""Decision of one robot: no clock, no I/O, no Zenoh, no randomness.

Inputs are the time, the state of its body and received messages; outputs are transmissions, commands and the setpoint
of its body. A robot's process calls this for its robot, a radio's process for three, the virtual clock for all robots
of all repetitions: a swarm is many of one.

A tick has two halves, `transmit` and `act`; the caller may deliver the new transmissions between them. While the robot
runs and nothing is amiss both are quiet; what they call for texts, orders and changes of phase is not.
"""

from __future__ import annotations

from math import inf, isfinite, isnan, nan
from typing import ClassVar, Final

from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.centralised import ReceivedGoals
from agents.decision.goals import GoalComputer, StationKeeping
from agents.decision.lifecycle import AIRBORNE, IDLE, LANDING, PAUSED, READY, RUNNING, Lifecycle, Phase
from agents.decision.neighbours import Neighbours
from agents.decision.perception import Perception
from agents.decision.position_control import PositionController, VelocityFollower
from agents.decision.situation import ProcessHealth, Situation
from agents.decision.stepping import Stepping, Words
from agents.decision.transmission import Transmitter
from agents.plugins.law import View
from agents.plugins.predictors import HOLD
from agents.safety.detection import Detector, RobotStatus
from agents.safety.hazards import Cause, Hazards, Outcome
from agents.safety.landing import Landing
from agents.safety.positions import Continuity, ExternalPositions
from agents.safety.preflight import Preflight, rehearse
from agents.safety.setpoint_filter import SetpointFilter
from agents.vectors import NO_SETPOINT, UNKNOWN, ZERO, Pose, Setpoint, Vector, is_finite

CENTRE: Final = "centre"  # missing neighbour of a guided robot without guidance
OLD_VELOCITY: Final = 3.0  # decisions after which a velocity of the central controller counts no more
HALT: Final[Setpoint] = (0.0, 0.0, 0.0, 0.0)
LAND_AGAIN_S: Final = 1.0  # pause between two orders to land for a body that hovers: one may be lost


class Robot:
    """Decision of one robot."""

    FIXED: ClassVar = ("_flies", "_predicts")
    # more than CPython keeps beside an object: the tick would look each up in a dictionary
    __slots__ = (
        "_asked", "_blind", "_continuity", "_controller", "_decide_every", "_decided", "_detector", "_dt",
        "_external", "_filter", "_flies", "_follower", "_land_again_at", "_ordered", "_origin", "_perception", "_place",
        "_pose_every", "_predicts", "_preflight", "_run_began", "_status", "_stepping", "assignment", "avoided",
        "begun", "causes", "changed", "decision_due", "decisions", "error", "evasions", "goal", "goal_yaw", "goals",
        "guidance", "hazards", "health", "interventions", "keeping", "landing", "lands", "lifecycle", "neighbours",
        "now", "sent_position", "sent_velocity", "setpoint", "stops", "takes_off", "tick", "transmitter", "updates",
    )  # fmt: skip

    def __init__(self, assignment: Assignment, health: ProcessHealth | None = None) -> None:
        """Take the `assignment`, and the `health` of the process, which sets it."""
        kind, limits = assignment.kind, assignment.limits
        self.assignment, self.health = assignment, health or ProcessHealth()
        self.goals = GoalComputer(assignment, passive=assignment.guided)
        self.neighbours: Neighbours = self.goals.neighbours
        self.guidance: ReceivedGoals | None = None
        if assignment.guided:
            self.guidance = ReceivedGoals(flies=kind.flies, silence_s=limits.neighbour_timeout_s)
        self.keeping = StationKeeping(assignment.ground)
        self.lifecycle = Lifecycle(kind, assignment.hover, assignment.duration, assignment.lands_at)
        stepping = self._stepping = self.goals.stepping
        self._follower = None if stepping is None else VelocityFollower(kind, assignment.ground)
        speech = None if stepping is None or assignment.guided else stepping.speech
        self.transmitter = Transmitter(assignment.trigger, assignment.predictor, kind, speech)
        self.hazards, self.landing = Hazards(kind, limits), Landing(assignment)
        self._detector, self._preflight = Detector(assignment), Preflight(assignment)
        self._status = RobotStatus()
        self._controller, self._filter = PositionController(kind), SetpointFilter(kind, limits)
        self._continuity, self._external = Continuity(kind), ExternalPositions(kind)
        self._flies, self._predicts = kind.flies, assignment.predictor is not HOLD
        self._decide_every, self._pose_every = assignment.decide_every, assignment.pose_every
        self._dt = 1.0 / assignment.body_hz
        avoids = assignment.avoidance is not None and assignment.avoids
        self._perception = Perception(assignment) if avoids else None
        self.now = Situation()  # situation of this tick
        self.tick = 0  # number of the next tick; 0 at the common start, so that robots decide together
        self.goal, self.goal_yaw = UNKNOWN, nan  # pursued [m], and wanted there [rad], NaN for any
        self.error = 0.0  # Σ of the link errors as the robot knows them [m]; NaN without a link or a position
        self.setpoint = NO_SETPOINT  # setpoint of the last tick, NaN where the body drives by itself
        self.changed = self.avoided = False  # decided setpoint changed by safety, by avoidance
        self.takes_off = self.lands = self.stops = False  # commands to the body on this tick
        # what is transmitted, where `transmit` says so [m], [m/s]
        self.sent_position = self.sent_velocity = UNKNOWN
        self.decisions = 0  # count since the common start
        self.updates = 0  # decisions that recomputed the goal; of a guided robot, received goals
        # ticks on which safety, and avoidance, changed the setpoint, from the common start on
        self.interventions = self.evasions = 0
        self.causes = 0  # causes of hazards on this tick, a bit for each
        self.decision_due = False  # whether the goal is decided on this tick; known from its first half on
        self.begun = False  # whether the robot has begun to run
        self._ordered = self._blind = False
        self._decided = self._asked = -1
        self._place, self._land_again_at = UNKNOWN, -inf
        self._origin: Pose | None = None
        self._run_began = inf  # common start of a run under way that the robot joins [s]; infinity: it joins none

    # ------------------------------------------------------------------ inputs

    def hold(self) -> str:
        """Order to stay in place; returns the reason of a refusal, empty when accepted.

        One that climbs stays at its height, and one that waits does not take off.
        """
        life = self.lifecycle
        if life.phase > RUNNING:
            return f"cannot hold while {Phase(life.phase).word}"
        self._ordered, life.reason = True, PAUSED
        if life.phase <= READY and not life.climbing:
            life.failing = PAUSED
        return ""

    def resume(self) -> None:
        """Order to go on after a hold, from where the robot is now: no order confirms one that jumped in the air."""
        self._ordered = False
        if self.lifecycle.reason == PAUSED:
            self.lifecycle.reason = ""
        if not self._flies:
            self._continuity.forget()
            self._external.forget()

    def believes(self, t: float, position: Vector) -> bool:
        """Whether a `position` [m] that was measured from outside at `t` [s] may be used; ask for each one.

        One that is not believed must not reach the body either: an estimator on board would fly by it.
        """
        return self._external.believes(t, position, watched=self.lifecycle.in_motion)

    def believed_yaw(self, t: float, yaw: float) -> float:
        """The `yaw` [rad] of a position that is believed, or NaN: then the body's own goes on."""
        return self._external.believed_yaw(t, yaw, watched=self.lifecycle.in_motion)

    def go(self, goal: tuple[float, float] | None, t: float) -> str:
        """Order of a leader to a place x, y [m], from `t` [s] on, instead of its plan; returns as `hold`.

        The robot moves as on a leg of its plan: avoidance, setpoint filter and hazards are the same.
        """
        limits, phase = self.assignment.limits, Phase(self.lifecycle.phase)
        if goal is None or not all(map(isfinite, goal)):
            return "an order to go needs a `goal`, x and y in metres"
        if phase != RUNNING:
            return f"cannot go anywhere while {phase.word}"
        if self.guidance is not None:
            return "its goals are the central controller's"
        if not self.goals.leads:
            return "it follows its neighbours: only a leader can be sent somewhere"
        if not all(limits.low[k] <= goal[k] <= limits.high[k] for k in range(2)):
            return f"x = {goal[0]:g} m, y = {goal[1]:g} m is outside the arena"
        self.goals.redirect(goal, t, 0.5 * self.assignment.kind.speed)
        return ""

    def join(self, at: float, t: float, origin: Pose | None) -> None:
        """Join a run that began at `at` [s]: the law steps from AIRBORNE on, so that the robot says what is current.

        For the arguments see `start`.
        """
        self._run_began = at
        if origin is not None:
            self._begin_plan(origin, t - at)

    def start(self, at: float, t: float = -inf, origin: Pose | None = None) -> str:
        """Order to begin at `at` [s], or to continue after a hold; returns as `hold`.

        A robot that was ordered to hold before goes on to hold: the order to begin comes by itself in a run.
        `origin`: x, y, z [m] and yaw [rad] at which the plan of a restarted robot began; None: the plan restarts.
        """
        airborne = self.lifecycle.phase == AIRBORNE
        refusal = self.lifecycle.start(at)
        if not refusal:
            if not (airborne and self._ordered):
                self.resume()
            if origin is not None and airborne:
                self._begin_plan(origin, t - at)
        return refusal

    def _begin_plan(self, origin: Pose, elapsed_s: float) -> None:
        x, y, z, yaw = self._origin = origin
        self.goals.begin_plan((x, y, z), yaw, max(0.0, elapsed_s))

    @property
    def origin(self) -> Pose | None:
        """x, y, z [m] and yaw [rad] at which the plan began, by itself or by the start order."""
        return self.goals.origin or self._origin

    @property
    def words(self) -> Words:
        """Variables, by name, that go out with the transmitted pose."""
        stepping = self._stepping
        if stepping is None or stepping.speech is None or self.guidance is not None:
            return ()
        return stepping.speech.words

    @property
    def stepping(self) -> Stepping | None:
        """The law at work, if it is no gradient; that of a guided robot is at work in its central controller."""
        return self._stepping if self.guidance is None else None

    def view(self, t: float) -> View:
        """View of the law for its step at `t` [s], between the halves of a tick; of a law that steps, once a tick."""
        now, goals = self.now, self.goals
        start = self.lifecycle.start_at
        if goals.changes_shape:
            goals.reshape(t - start, now.position, t)
        return goals.view(t, now.position, now.velocity, now.yaw, start)

    def missing_neighbours(self) -> list[str]:
        """Neighbours that the robot has never received, or that are lost; likewise its central controller."""
        names, guidance = self.neighbours.missing(), self.guidance
        if guidance is not None and (guidance.lost_since < inf or guidance.missing):
            names.append(CENTRE)
        return names

    @property
    def descending(self) -> bool:
        """Whether the robot lands or has landed, and is not on its way to a landing place."""
        return self.lifecycle.phase >= LANDING and not self.landing.aside

    # ------------------------------------------------------------------ the decision

    def transmit(self, t: float, state: BodyState) -> bool:
        """First half of a tick at `t` [s]: advance the phase; returns whether the robot transmits its pose now."""
        self.take(t, state)
        if not self.is_steady(t):
            self.live(t)
        return self.transmission_due(t)

    def take(self, t: float, state: BodyState) -> None:
        """Take the state of the body at `t` [s]."""
        self.now.state = state
        if self._perception is not None:
            self.notice()
        if self._stepping is not None:
            self._stepping.scan = state.scan
        self.observe(t)

    def notice(self) -> None:
        """Take what the range sensors of the body saw last; of a robot that avoids things."""
        assert self._perception is not None
        self._perception.notice(self.now.state.scan)
        self._detector.notice(self.now.state.scan)

    def rare_parts(self) -> list[object]:
        """Objects that `notice` changes; none of a robot that avoids nothing."""
        return [] if self._perception is None else [self._perception, self._detector]

    def observe(self, t: float) -> None:
        """Look at the state of the body, without what jumped; quiet."""
        self.goals.update_links(t)
        life, now = self.lifecycle, self.now
        life.moved = self.takes_off = self.lands = self.stops = False
        now.begin(t)
        state = now.state
        moves = life.climbing or AIRBORNE <= life.phase <= LANDING
        now.jump = self._continuity.jump(state.time, state.position, state.yaw, moves)
        now.yaw_jump = self._continuity.yaw_jump
        if self._external.doubted:
            self._doubt()
        if now.jump == now.jump:
            now.position = UNKNOWN
        self._filter.judge(now)
        if self._external.doubted:
            self._filter.judge_far(now, self._external.place)

    def _doubt(self) -> None:
        """Note that the external positions jumped, or deceive."""
        now, external = self.now, self._external
        now.jump = external.jump if isnan(now.jump) else max(now.jump, external.jump)
        if external.deceived:
            now.position = UNKNOWN

    def is_steady(self, t: float) -> bool:
        """Whether the phase stays as it is at `t` [s], and nothing is due; quiet."""
        life, now = self.lifecycle, self.now
        if t < life.settled_until:
            return True
        if life.phase == READY and not life.climbing:
            return self._stays_ready()
        return not self.landing.aside and life.stays(t, now.position, now.velocity, now.state.flying)

    def _stays_ready(self) -> bool:
        """Whether a ready robot stays ready, as nothing fails, and nothing did; quiet."""
        if self._ordered or self.landing.aside or self.guidance is not None or self.neighbours.unreceived():
            return False
        return self._preflight.passes(self.now, self.neighbours, self.health)

    def live(self, t: float) -> None:
        """Advance the phase of a robot that is not steady, with what follows."""
        life, now = self.lifecycle, self.now
        ready = life.phase <= READY and self._ready()
        life.advance(t, now.position, now.velocity, flying=now.state.flying, ready=ready)
        self._take_commands()
        if life.moved and not self.begun and life.phase == RUNNING:
            self._decided = self._asked = -1
            # 0, unless it joins a run under way
            self.begun, self.tick = True, round((t - life.start_at) * self.assignment.body_hz)

    def transmission_due(self, t: float) -> bool:
        """Whether the robot transmits its pose now; quiet."""
        # by number, not by remainder: a decision due on a skipped tick is made on the next one
        decision, pose = self.tick // self._decide_every, self.tick // self._pose_every
        self.decision_due, self._decided = decision != self._decided, decision
        if self._stepping is not None and self.decision_due:
            self._step(t, self._stepping)
        if pose == self._asked:
            return False
        self._asked = pose
        goals, transmitter, now = self.goals, self.transmitter, self.now
        goals.errors(t, now.position)
        error = nan if now.invalid else goals.error  # 0 without a link: triggers rest
        self.error = error if goals.judged else nan
        due = transmitter.transmits(
            t, now.position, now.velocity, error, goals.energy, max(t - self.lifecycle.start_at, 0.0),
            goals.offset, self.setpoint,
        )  # fmt: skip
        if self._stepping is not None:
            self._stepping.deviation = 0.0 if due else transmitter.asking.view.deviation
        self.sent_position, self.sent_velocity = transmitter.position, transmitter.velocity
        if self._predicts:
            due = self._stands_blind() or due
        return due

    def _step(self, t: float, stepping: Stepping) -> None:
        """Before its first question on a tick: a law that says something steps, so that it says what is new."""
        life, now = self.lifecycle, self.now
        running = life.phase == RUNNING
        start, tick = life.start_at, self.tick
        joins = life.phase == AIRBORNE and self._run_began < t
        if joins:
            start, tick = self._run_began, round((t - self._run_began) / stepping.tick_s)
        stepping.moves = running and not self._holds()
        stepping.tick = tick
        if stepping.speech is not None and (running or joins) and not now.invalid and self.guidance is None:
            self.goals.step(t, now.position, now.velocity, now.yaw, start)

    def _renew_goal(self, t: float, stepping: Stepping) -> None:
        """A law gives a velocity, here or at the central controller: the goal moves on with it on every tick."""
        follower, velocity, now, guidance = self._follower, stepping.velocity, self.now, self.guidance
        follows = self.goals.follows and self.decisions > 0 and not stepping.gives_goal
        if guidance is not None:  # a robot without new goals stands still, long before it counts as unguided
            velocity = guidance.velocity
            follows = isfinite(velocity[0]) and t - guidance.stamp <= OLD_VELOCITY * self._decide_every * self._dt
        if follower is None:
            return
        if not (self.lifecycle.phase == RUNNING and not self.keeping.held and follows):
            follower.reference = UNKNOWN
        elif not now.invalid:
            self.goal = follower.goal(velocity, now.position, self._dt)

    def _stands_blind(self) -> bool:
        """Whether a robot on wheels has just become blind: it sends that it is at rest, or others would follow it."""
        blind, now = self.now.invalid, self.now
        begins, self._blind = blind and not self._blind, blind
        if not blind:
            self._place = now.position
        if not (begins and not self._flies and is_finite(self._place)):
            return False
        self.sent_position, self.sent_velocity = self._place, ZERO
        return True

    def _take_commands(self) -> None:
        """Commands of the lifecycle to the body; a landing may have to wait until the place below is free."""
        life = self.lifecycle
        self.takes_off, self.stops = life.takeoff_due, life.stop_due
        ordered = life.land_due
        self.lands = ordered
        if ordered or self.landing.aside:
            self.lands = self.landing.filter_land(
                self.now, self.neighbours, self.health, ordered=ordered, landing=life.phase == LANDING
            )
        life.takeoff_due = life.land_due = life.stop_due = False

    def act(self, t: float) -> None:
        """Second half of the tick at `t` [s]: goal, setpoint and commands."""
        self.detect(t)
        self.finish(t)

    def finish(self, t: float) -> None:
        """Everything after the detection of hazards."""
        troubled = self.causes != 0 or self.hazards.under_way
        if troubled:
            self.respond()
        self.pursue(t, troubled)

    def detect(self, t: float) -> bool:
        """Find the causes of hazards on this tick; returns whether there are any, or hazards under way. Quiet."""
        life, status, guidance = self.lifecycle, self._status, self.guidance
        phase = life.phase
        status.ordered, status.setpoint = self._ordered, self.setpoint
        status.not_finite = self._filter.not_finite
        status.goal_height, status.aside = self.goal[2], self.landing.aside
        status.cruising, status.climbing = AIRBORNE <= phase <= RUNNING, life.climbing
        status.landing = phase == LANDING
        status.unstarted = life.start_at == inf and (life.climbing or phase == AIRBORNE)
        status.alone = self.neighbours.incomplete and self.goals.without_neighbours()
        if guidance is not None:
            status.unguided, status.goal_stamp = phase == RUNNING and guidance.unguided(t), guidance.stamp
        self.causes = self._detector.causes(self.now, status, self.neighbours, self.health)
        return self.causes != 0 or self.hazards.under_way

    def pursue(self, t: float, troubled: bool) -> None:
        """Goal and setpoint of this tick; quiet."""
        life, now, landing = self.lifecycle, self.now, self.landing
        if self.decision_due:
            self._decide(t)
        elif life.moved or troubled:
            # a robot that arrived at its height, or must stop, needs a place until the next decision
            held = life.phase == RUNNING and self.hazards.held
            self._stay(held or self.keeping.held or life.phase == AIRBORNE)
        if self.guidance is not None:
            self._follow(self.guidance)
        if self._stepping is not None:
            self._renew_goal(t, self._stepping)
        goal = landing.place if landing.aside else self.goal
        self.avoided = False
        if self._perception is not None:
            setpoint = self._avoid(t, goal, self._perception)
        else:
            setpoint = self._controller.setpoint(goal, self.goal_yaw, now.position, now.yaw)
            setpoint = self._filter.limit(setpoint, now)
        self.changed = self._filter.changed
        if not (AIRBORNE <= life.phase <= RUNNING or landing.aside):
            setpoint = NO_SETPOINT if self._flies else HALT
            self.changed = self.avoided = self._filter.not_finite = False
        self.tick, self.setpoint = self.tick + 1, setpoint
        if self.begun:
            self.interventions += self.changed
            self.evasions += self.avoided

    def _avoid(self, t: float, goal: Vector, perception: Perception) -> Setpoint:
        """Setpoint toward a goal, with avoidance."""
        now = self.now
        perception.sense(t, now, self.neighbours)
        own, near, avoidance = perception.own, perception.near, perception.avoidance
        x, y, z = avoidance.deviate(goal, own, near, self._dt)
        setpoint = self._controller.setpoint((x, y, z), self.goal_yaw, now.position, now.yaw)
        setpoint = self._filter.check(setpoint, now, avoidance, own, near)
        moved = abs(x - goal[0]) > 0.0 or abs(y - goal[1]) > 0.0 or abs(z - goal[2]) > 0.0
        self.avoided = self._filter.avoided or moved
        return setpoint

    def _ready(self) -> bool:
        """Whether nothing is missing for a take-off; asked before it alone. Raises PluginError as `rehearse`."""
        t = self.now.t
        life, assignment = self.lifecycle, self.assignment
        if life.phase == IDLE and not self.now.invalid:
            rehearse(assignment, self.goals, self.transmitter, self._perception, position=self.now.position, t=t)
        lacks = False
        if assignment.patience_s is None or t <= assignment.patience_s:
            lacks = self.neighbours.unreceived() or (self.guidance is not None and self.guidance.missing)
        missing = self.missing_neighbours() if lacks else []
        paused = self._ordered and not life.climbing
        failing = PAUSED if paused else self._preflight.check(self.now, missing, self.neighbours, self.health)
        life.failing, lost = failing, self._preflight.lost(t, failing)
        if failing:
            life.set_missing(failing)
            return life.phase == READY and not lost
        if life.phase == IDLE and not self.goals.is_sound(t, self.now.position):
            reads = self.goals.unknown_reads(t, self.now.position)
            life.set_missing(f"its law wants something that is not finite{reads}")
            return False
        return True

    def respond(self) -> None:
        """Apply outcomes of hazards: the robot holds, lands, or has its motors cut."""
        life, now, status = self.lifecycle, self.now, self._status

        def words(cause: Cause) -> str:
            if cause is Cause.BELOW:
                return self.landing.robot_below()
            if cause is Cause.SETPOINT and self._stepping is not None and not self._stepping.sound:
                reads = self.goals.unknown_reads(now.t, now.position)
                return f"the law {type(self.assignment.law).__name__} decides what is not finite{reads}"
            return self._detector.words(cause, now, status, self.neighbours, self.health)

        serious = self.hazards.update(now.t, self.causes, words, active=life.active, landing=life.phase == LANDING)
        for incident in serious:
            end = life.stop if incident.outcome == Outcome.CUT else life.land
            end(incident.cause.rule.words)
            misled = isfinite(now.jump) or incident.cause in (Cause.UNRESPONSIVE, Cause.STRAYING)
            if self.assignment.kind.flies and misled:
                self._external.disbelieve()  # it lands by what it knows itself
        hovers = life.phase == LANDING and not self.landing.aside and self.causes >> Cause.HOVERING & 1
        if hovers and now.t >= self._land_again_at:  # no descent is under way that a second order could disturb
            self.lands, self._land_again_at = True, now.t + LAND_AGAIN_S

    def _decide(self, t: float) -> None:
        """A new goal of a running robot that decides for itself; it may have to stay."""
        life, now, goals = self.lifecycle, self.now, self.goals
        running = life.phase == RUNNING
        if running:
            self.decisions += 1
        if running and self.guidance is None and not now.invalid:  # noqa: SIM102 - the decision changes the robot
            if goals.decide(t, now.position, now.velocity, now.yaw, life.start_at):
                self.goal, self.goal_yaw = goals.goal, goals.yaw
                self.updates += 1
        self._stay((running and self._holds()) or life.phase == AIRBORNE)
        if self.keeping.held or not running:
            goals.require_update()  # its goal is old when it returns

    def _stay(self, held: bool) -> None:
        """Keep the place where the hold began."""
        self.keeping.hold(held, self.now.position)
        if held:
            self.goal, self.goal_yaw = self.keeping.at, nan

    def _holds(self) -> bool:
        """Whether a running robot must stay: for its safety, or because no link of the law is active."""
        return self.hazards.held or self.goals.without_neighbours()

    def _follow(self, guidance: ReceivedGoals) -> None:
        """A guided robot takes its received goal, on the tick of reception."""
        running = self.lifecycle.phase == RUNNING
        held = (running and self._holds()) or self.lifecycle.phase == AIRBORNE
        if held != self.keeping.held:
            self._stay(held)
        if running and not held:
            self.goal, self.goal_yaw = guidance.goal, guidance.goal_yaw
            self.updates += guidance.fresh
        guidance.fresh = False
