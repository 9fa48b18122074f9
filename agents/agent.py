"""Decision of any number of robots: no clock, no I/O, no Zenoh, no randomness.

Inputs are the time, measured poses and received messages; outputs are transmissions, commands and setpoints of the
bodies. A robot's process calls this with one row, a radio's process with three, the virtual clock with all rows of all
repetitions.

A tick has two halves, `transmit` and `act`; the caller may deliver the new transmissions between them.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask, some
from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.centralised import Guidance
from agents.decision.goals import GoalComputer, StationKeeping
from agents.decision.lifecycle import AIRBORNE, IDLE, LANDING, READY, RUNNING, BodyCommands, Lifecycle, Phase
from agents.decision.perception import Perception
from agents.decision.position_control import PositionController
from agents.decision.transmission import Transmission, Transmitter
from agents.network.messages import Setpoint
from agents.plugins.calls import call
from agents.plugins.predictors import HOLD
from agents.safety.detection import Detector, RowStatus
from agents.safety.hazards import Cause, Hazards, Outcome
from agents.safety.landing import Landing
from agents.safety.positions import Continuity, ExternalPositions
from agents.safety.preflight import Preflight
from agents.safety.setpoint_filter import SetpointFilter
from agents.safety.situation import ProcessHealth, Situation


class Actions(msgspec.Struct, frozen=True):
    """Result of a tick."""

    transmit: Index  # (K,) rows that transmit their pose now
    setpoint: Array  # (N, 4) for the body, NaN for rows that their bodies drive by themselves
    commands: BodyCommands | None  # take-offs, landings, stops; None on nearly every tick
    changed: Mask  # (N,) decided setpoint changed by safety
    avoided: Mask  # (N,) decided setpoint changed by avoidance
    position: Array  # (N, 3) transmitted by these rows [m]
    velocity: Array  # (N, 3) likewise [m/s]


NO_ROWS: Index = np.zeros(0, dtype=np.intp)
CENTRE = "centre"  # missing neighbour of guided rows without guidance


class Agent:
    """Decision of N rows."""

    def __init__(self, assignment: Assignment) -> None:
        rows = len(assignment.names)
        self.assignment = assignment
        self.tick = 0  # number of the next tick; 0 at the common start, so that robots decide together
        self.goal: Array = np.full((rows, 3), np.nan)  # (N, 3) pursued [m]
        self.goal_yaw: Array = np.full(rows, np.nan)  # (N,) wanted at the goal [rad], NaN for any
        # (N,) Σ of the link errors as the rows know them [m]; 0 for guided rows, NaN without a position
        self.error: Array = np.zeros(rows)
        self.offset: Array = np.zeros((rows, 3))  # (N, 3) decided last, before it was clamped [m]
        self.decisions = 0  # since the common start
        # (N,) decisions at which each row computed its goal anew; of guided rows, received goals
        self.updates: Index = np.zeros(rows, dtype=np.intp)
        self.decision_due = False  # whether goals are decided on this tick; known from its first half on
        self._flies = flies = np.array([kind.flies for kind in assignment.kinds])
        self._guided = np.zeros(rows, dtype=bool) if assignment.guided is None else assignment.guided
        self.guidance: Guidance | None = None  # goals of the guided rows; None: no row is guided
        if some(self._guided):
            self.guidance = Guidance(self._guided, flies, assignment.limits.link_silence_s)
        self.goal_computer = GoalComputer(assignment, ~self._guided)  # of rows that are not guided
        self.neighbours = self.goal_computer.neighbours
        self.all_guided = bool(self._guided.all())
        self._holding = StationKeeping(self.goal_computer.ground)
        self.lifecycle = Lifecycle(flies, assignment.hover, assignment.duration)
        self.transmitter = Transmitter(assignment.trigger, rows, assignment.predictor, kinds=assignment.kinds)
        self._setpoint = np.full((rows, 4), np.nan)
        self.health = ProcessHealth()  # set by the process around the decision
        self.hazards = Hazards(flies, assignment.limits)
        self._detector, self._preflight = Detector(assignment), Preflight(assignment)
        self.begun = False  # whether the first row has begun to run
        self._decided = self._asked = -1
        self._commands: BodyCommands | None = None
        self._ordered = np.zeros(rows, dtype=bool)
        self._controller, self._continuity = PositionController(assignment.kinds), Continuity(assignment.kinds)
        self._external = ExternalPositions(assignment.kinds)
        self._safety = SetpointFilter(assignment.kinds, assignment.limits)
        self._perception = None if assignment.avoidance is None else Perception(assignment)
        self.landing = Landing(assignment)
        self.origins: dict[int, Setpoint] = {}  # of restarted rows, from their start orders
        self._no_row: Mask = np.zeros(rows, dtype=bool)
        self._every_row: Mask = np.ones(rows, dtype=bool)
        self._not_finite = self._blind = self._no_row  # (N,) rows without a valid pose when poses were last due,
        self._place = np.full((rows, 3), np.nan)  # and where they were last known (N, 3) [m]
        self._now: Situation

    # ------------------------------------------------------------------ inputs

    def hold(self, row: int) -> str:
        """Order to stay in place; returns the reason of a refusal, empty when accepted."""
        if self.lifecycle.phase[row] not in (AIRBORNE, RUNNING):
            return f"cannot hold while {Phase(self.lifecycle.phase[row]).word}"
        self._ordered[row] = True
        return ""

    def resume(self, row: int) -> None:
        """Order to go on after a hold, from where the row is now."""
        self._ordered[row] = False
        self._continuity.forget(row)
        self._external.forget(row)

    def believes(self, row: int, t: float, position: Array) -> bool:
        """Whether a `position` (3,) [m] that was measured from outside at `t` [s] may be used; ask for each one.

        One that is not believed must not reach the body either: an estimator on board would fly by it.
        """
        return self._external.believes(row, t, position, watched=self.lifecycle.in_motion(row))

    def believed_yaw(self, row: int, t: float, yaw: float) -> float:
        """The `yaw` [rad] of a position that is believed, or NaN: then the body's own goes on."""
        return self._external.believed_yaw(row, t, yaw, watched=self.lifecycle.in_motion(row))

    def go(self, row: int, goal: tuple[float, float], t: float) -> str:
        """Order of a leader to a place x, y [m], from `t` [s] on, instead of its plan; returns as `hold`.

        The robot moves as on a leg of its plan: avoidance, setpoint filter and hazards are the same.
        """
        assignment = self.assignment
        phase = Phase(self.lifecycle.phase[row])
        if phase != RUNNING:
            return f"cannot go anywhere while {phase.word}"
        if self._guided[row]:
            return "its goals are the central controller's"
        if not self.goal_computer.leads(row):
            return "it follows its neighbours: only a leader can be sent somewhere"
        low, high = assignment.limits.low, assignment.limits.high
        if not all(low[k] <= goal[k] <= high[k] for k in range(2)):
            return f"x = {goal[0]:g} m, y = {goal[1]:g} m is outside the arena"
        self.goal_computer.redirect(row, goal, t, 0.5 * assignment.kinds[row].speed)
        return ""

    def start(self, row: int, at: float, t: float = -np.inf, origin: Setpoint | None = None) -> str:
        """Order to begin at `at` [s], or to go on after a hold; returns as `hold`.

        `origin`: x, y, z [m] and yaw [rad] at which the plan of a restarted robot began; None: it begins anew.
        """
        waits = self.lifecycle.phase[row] == AIRBORNE
        refusal = self.lifecycle.start(row, at)
        if not refusal:
            if waits and self._flies[row]:  # the common start confirms no position that jumped in the air
                self._ordered[row] = False
            else:
                self.resume(row)
            if origin is not None and waits:
                x, y, z, yaw = origin
                self.origins[row] = origin
                self.goal_computer.begin_plans(
                    np.array([row]), np.array([[x, y, z]]), np.array([yaw]), max(0.0, t - at)
                )
        return refusal

    def origin(self, row: int) -> Setpoint | None:
        """x, y, z [m] and yaw [rad] at which the plan of a row began, by itself or by the start order."""
        return self.goal_computer.origin(row) or self.origins.get(row)

    def missing_neighbours(self, row: int) -> list[str]:
        """Neighbours that a row has never received, or that are lost; likewise its central controller."""
        names = [self.assignment.robots[s] for s in self.neighbours.missing_senders(row)]
        guidance = self.guidance
        if (
            guidance is not None
            and self._guided[row]
            and (guidance.lost_since < np.inf or guidance.rows_without_goal()[row])
        ):
            names.append(CENTRE)
        return names

    def skip_ticks(self, ticks: int) -> None:
        """Skip `ticks` that are too late; called before each tick, mostly with 0."""
        self.tick += ticks
        self.health.count_tick(ticks, 1.0 / self.assignment.body_hz)

    @property
    def descending(self) -> Mask:
        """Rows (N,) that land or have landed; not those on their way to a landing place."""
        return np.asarray((self.lifecycle.phase >= LANDING) & ~self.landing.aside)

    @property
    def state(self) -> BodyState:
        """State of the bodies on this tick, without the positions that jumped."""
        return self._now.state

    # ------------------------------------------------------------------ the decision

    def step(self, t: float, state: BodyState) -> Actions:
        """Decide one tick at time `t` [s] of the process's clock."""
        return self.act(t, state, self.transmit(t, state))

    def transmit(self, t: float, state: BodyState) -> Transmission:
        """First half of a tick: advance the phases, and decide which rows transmit their measured pose."""
        self.goal_computer.update_links(t)
        life = self.lifecycle
        watched = self._every_row if life.all_running else life.active | (life.phase == LANDING)
        jump = self._continuity.jumps(state.time, state.position, watched, state.yaw)
        if self._external.doubted:
            jump = self._external.jump if jump is None else np.fmax(jump, self._external.jump)
        if jump is not None:
            unknown = ~np.isnan(jump) | self._external.deceived
            state = replace(state, position=np.where(unknown[:, None], np.nan, state.position))
        where = self._safety.validate_poses(state.position, state.yaw, t - state.time)
        self._now = Situation(t, state, where, self.neighbours, self.health, jump, self._continuity.turned)
        ready = self._ready(self._now) if life.waiting else self._no_row  # all rows have taken off
        commands = life.advance(t, ready, state.position, state.velocity, state.flying)
        if commands is not None or self.landing.any_aside:
            commands = self.landing.filter_commands(self._now, commands, life.phase)
        self._commands = commands
        assignment = self.assignment
        if life.moved and not self.begun and (life.phase == RUNNING).any():
            since = t - float(life.start_at[life.phase == RUNNING].min())
            self._decided = self._asked = -1
            self.begun, self.tick = True, round(since * assignment.body_hz)  # 0, unless it joins a run under way
        # by number, not by remainder: a decision due on a skipped tick is made on the next one
        decision, question = self.tick // assignment.decide_every, self.tick // assignment.pose_every
        self.decision_due, self._decided = decision != self._decided, decision
        if question == self._asked:
            return Transmission(NO_ROWS, state.position, state.velocity)
        self._asked = question
        error, energy = self.goal_computer.errors(t, state.position)
        self.error = error if where.all_valid else np.where(where.invalid, np.nan, error)
        sent = self.transmitter.transmit(
            t, state.position, state.velocity,
            error=error, energy=energy, start=life.start_at, offset=self.offset,
            setpoint=self._setpoint,
        )  # fmt: skip
        return sent if assignment.predictor is HOLD else self._add_blind(sent, state.position, where.invalid)

    def _add_blind(self, sent: Transmission, position: Array, blind: Mask) -> Transmission:
        """Add rows on wheels that have just become `blind` (N,), at rest: others would follow them by prediction."""
        stand = blind & ~self._blind & ~self._flies & np.isfinite(self._place).all(axis=1)
        self._blind, place = blind, self._place
        self._place = np.where(blind[:, None], place, position)
        if not some(stand):
            return sent
        rows = np.union1d(sent.rows, np.flatnonzero(stand))
        standing = np.where(stand[:, None], 0.0, sent.velocity)
        return Transmission(rows, np.where(stand[:, None], place, sent.position), standing)

    def act(self, t: float, state: BodyState, transmission: Transmission) -> Actions:
        """Second half of a tick: goals, setpoints and commands."""
        state = state if self._now.jump is None else self._now.state
        held = self.hazards.held
        self._apply_hazards(self._now)
        if self.decision_due:
            self._decide(t, state)
        elif self.lifecycle.moved or held is not self.hazards.held:
            # a row that arrived at its height, or must stop, needs a place until the next decision
            held = (self.lifecycle.phase == RUNNING) & self.hazards.held
            self._stay(self._holding.held | held | (self.lifecycle.phase == AIRBORNE), state.position)
        if self.guidance is not None:
            self._follow(self.guidance, state.position)
        goal, avoided = self.goal, self._no_row
        aside = self.landing.aside
        if self.landing.any_aside:
            goal = np.where(aside[:, None], self.landing.place, goal)
        age, where = t - state.time, self._now.where
        avoidance = self.assignment.avoidance
        if avoidance is None or self._perception is None:
            setpoint = self._controller.setpoint(goal, self.goal_yaw, state.position, state.yaw)
            filtered = self._safety.check(setpoint, state.position, state.yaw, age, where=where)
        else:
            own, near = self._perception.sense(t, state, self.neighbours.poses)
            inputs, wanted = (goal, own, near, 1.0 / self.assignment.body_hz), goal
            goal = call("avoidance", avoidance, "deviate", *inputs, shape=goal.shape, each="a goal per row")
            setpoint = self._controller.setpoint(goal, self.goal_yaw, state.position, state.yaw)
            filtered = self._safety.check(
                setpoint, state.position, state.yaw, age, where=where, avoidance=(avoidance, own, near)
            )
            avoided = filtered.avoided
            if goal is not wanted:
                avoided = avoided | (np.abs(goal - wanted) > 0.0).any(axis=1)
        setpoint, changed, self._not_finite = filtered.setpoint, filtered.changed, filtered.not_finite
        if not self.lifecycle.all_running:
            phase = self.lifecycle.phase
            passive = ((phase < AIRBORNE) | (phase > RUNNING)) & ~aside
            setpoint = np.where(passive[:, None], np.where(self._flies, np.nan, 0.0)[:, None], setpoint)
            changed, avoided, self._not_finite = changed & ~passive, avoided & ~passive, self._not_finite & ~passive
        self.tick, self._setpoint = self.tick + 1, setpoint
        return Actions(
            transmission.rows, setpoint, self._commands, changed, avoided, transmission.position, transmission.velocity
        )

    def _ready(self, now: Situation) -> Mask:
        t, state = now.t, now.state
        life, assignment = self.lifecycle, self.assignment
        lacks = np.zeros(len(life.phase), dtype=bool)
        if assignment.patience_s is None or t <= assignment.patience_s:
            lacks[assignment.links.receiver[assignment.unreceived(self.neighbours.stamp_once_alive)]] = True
            if self.guidance is not None:
                lacks |= self.guidance.rows_without_goal()
        failing = self._preflight.check(now, (lacks, self.missing_neighbours))
        life.failing, lost = failing, self._preflight.lost(t, failing)
        ready = np.ones(len(lacks), dtype=bool)
        for row, reason in failing.items():
            ready[row] = life.phase[row] == READY and row not in lost
            life.set_missing(row, reason)
        if some(news := ready & (life.phase == IDLE)):
            with np.errstate(all="ignore"):
                lawless = news & ~np.isfinite(self.goal_computer.law_offset(t, state.position)).all(axis=1)
            for row in np.flatnonzero(lawless).tolist():
                ready[row] = False
                life.set_missing(row, "its law wants something that is not finite")
        return ready

    def _apply_hazards(self, now: Situation) -> None:
        """Detect hazards and apply their outcomes: rows hold, land, or have their motors cut."""
        life, neighbours, guidance = self.lifecycle, self.neighbours, self.guidance
        if life.all_running:
            active = cruising = running = self._every_row
            landing, climbing, unstarted = self._no_row, None, self._no_row
        else:
            running, landing, active = life.phase == RUNNING, life.phase == LANDING, life.active
            climbing = life.climbing
            cruising = running | (life.phase == AIRBORNE)
            unstarted = active & np.isinf(life.start_at)
        rows = RowStatus(
            self._ordered,
            cruising,
            climbing,
            landing,
            self.goal_computer.without_neighbours() if neighbours.incomplete else None,
            None if guidance is None else running & guidance.unguided(now.t),
            None if guidance is None else guidance.stamp,
            unstarted,
            self.goal[:, 2],
            self._setpoint,
            self._not_finite,
            self.landing,
        )
        for incident in self.hazards.update(now.t, self._detector.detect(now, rows), active, landing):
            end = life.stop if incident.outcome == Outcome.CUT else life.land
            end(incident.row, incident.cause.rule.words)
            jumped = now.jump is not None and np.isfinite(now.jump[incident.row])
            if self._flies[incident.row] and (jumped or incident.cause in (Cause.STILL, Cause.STRAYING)):
                self._external.disbelieve(incident.row)  # it lands by what it knows itself

    def _decide(self, t: float, state: BodyState) -> None:
        """New goals for running rows that decide for themselves; the others may have to stay."""
        phase = self.lifecycle.phase
        running = phase == RUNNING
        if some(running):
            self.decisions += 1
            if not self.all_guided:
                own = running if self.guidance is None else running & ~self._guided
                own = own if self._now.where.all_valid else own & ~self._now.where.invalid
                new = self.goal_computer.decide(
                    t, state.position, state.velocity, state.yaw, start=self.lifecycle.start_at, running=own
                )
                self.goal = np.where(new.due[:, None], new.goal, self.goal)
                self.offset = np.where(new.due[:, None], new.offset, self.offset)
                self.goal_yaw = np.where(new.due, new.yaw, self.goal_yaw)
                self.updates += new.due
        self._stay(self._holds(running) | (phase == AIRBORNE), state.position)
        if some(away := self._holding.held | ~running):
            self.goal_computer.require_update(np.flatnonzero(away))  # their goals are old when they return

    def _stay(self, held: Mask, position: Array) -> None:
        """Held rows keep the place where their hold began."""
        self.goal, self.goal_yaw = self._holding.hold_position(held, position, self.goal, self.goal_yaw)

    def _holds(self, running: Mask) -> Mask:
        """Running rows that must stay: for their safety, or because no link of the law is active."""
        held = running & self.hazards.held
        if len(self.neighbours.active) < len(self.assignment.links):
            held = held | (running & self.goal_computer.without_neighbours())
        return held

    def _follow(self, guidance: Guidance, position: Array) -> None:
        """Guided rows take their received goals, on the tick of reception."""
        phase = self.lifecycle.phase
        running = phase == RUNNING
        held = np.where(self._guided, self._holds(running) | (phase == AIRBORNE), self._holding.held)
        if (held != self._holding.held).any():
            self._stay(held, position)
        follows = self._guided & running & ~held
        if some(follows):
            self.goal = np.where(follows[:, None], guidance.goal, self.goal)
            self.goal_yaw = np.where(follows, guidance.goal_yaw, self.goal_yaw)
            self.updates += follows & guidance.fresh
        guidance.fresh[:] = False
