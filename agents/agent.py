"""The whole decision of any number of robots: no clock, no I/O, no Zenoh, no randomness.

Time, measured poses and what was heard go in; who speaks, what the body must do and its setpoints come out. A robot's
process calls this with one row, a radio's process with three, the virtual clock with all rows of all repetitions.

A tick has two halves: `speak`, then `act`. Whoever carries messages may deliver between them what was just said.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask, some
from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.centralised import Guidance
from agents.decision.goals import GoalComputer, StationKeeping
from agents.decision.lifecycle import AIRBORNE, IDLE, LANDING, READY, RUNNING, BodyCommands, Lifecycle, Phase
from agents.decision.neighbours import NeighbourPoses, NeighbourStates
from agents.decision.perception import Perception
from agents.decision.position_control import PositionController
from agents.decision.transmission import Transmission, Transmitter
from agents.formation.graph import Links
from agents.network.messages import Setpoint
from agents.plugins.avoidance import Avoidance, Nearby, OwnState
from agents.plugins.registry import FAILURES, PluginError
from agents.plugins.triggers import LastEvent, Trigger
from agents.safety.detection import Detector, ProcessHealth, RowStatus
from agents.safety.hazards import Hazards, Outcome
from agents.safety.landing import Landing
from agents.safety.preflight import Preflight
from agents.safety.setpoint_filter import PoseValidity, SetpointFilter


class Actions(msgspec.Struct, frozen=True):
    """What comes out of a tick.

    Attributes:
        transmit: Rows that send their pose now.
        setpoint: (N, 4) for the body, NaN rows for those that act by themselves.
        commands: Take-offs, landings, stops; None on nearly every tick.
        changed: (N,) safety had to change what was decided.
        avoided: (N,) avoidance did.
        position: (N, 3) that rows which speak say [m].
        velocity: (N, 3) that they say [m/s].
    """

    transmit: Index
    setpoint: Array
    commands: BodyCommands | None
    changed: Mask
    avoided: Mask
    position: Array
    velocity: Array


NOBODY: Index = np.zeros(0, dtype=np.intp)
CENTRE = "centre"  # what guided rows miss when nobody guides them


class Agent:
    """The decision of N rows.

    Attributes:
        tick: Number of the next tick; set to 0 at the common start, so that robots decide together.
        goal: (N, 3) pursued [m].
        goal_yaw: (N,) yaw wanted at the goal [rad], NaN for any.
        error: (N,) Σ of the link errors as the rows see them [m]; 0 for those that are guided.
        offset: (N, 3) decided last, before it was clamped [m].
        decisions: Coordination decisions since the common start.
        updates: (N,) how often each row computed its goal anew at one of them; of guided rows, how often it was told.
        begun: Whether the first row has begun to run.
        decision_due: Whether goals are decided on this tick; known from its first half on.
        goal_computer: Computes the goals of rows that are not guided.
        guidance: What the others were told; None if there are none, and `all_guided` if there are only such.
        lifecycle: Phases.
        hazards: What is wrong with the rows, and what is done about it.
        origins: Where rows that came back were told that they began.
        health: What only the process around the decision knows: told by it.
    """

    def __init__(self, assignment: Assignment) -> None:
        rows = len(assignment.names)
        self.assignment = assignment
        self.tick = 0
        self.goal = np.full((rows, 3), np.nan)
        self.goal_yaw = np.full(rows, np.nan)
        self.error, self.offset = np.zeros(rows), np.zeros((rows, 3))
        self.decisions = 0
        self.updates: Index = np.zeros(rows, dtype=np.intp)
        self.decision_due = False
        self._flies = flies = np.array([kind.flies for kind in assignment.kinds])
        self._guided = np.zeros(rows, dtype=bool) if assignment.guided is None else assignment.guided
        self.guidance = None
        if some(self._guided):
            self.guidance = Guidance(self._guided, flies, assignment.limits.link_silence_s)
        self.goal_computer = GoalComputer(assignment, ~self._guided)
        self.all_guided = bool(self._guided.all())
        self._holding = StationKeeping(self.goal_computer.ground)
        self.lifecycle = Lifecycle(flies, assignment.hover, assignment.duration)
        self._voice = Transmitter(assignment.trigger, rows, assignment.predictor, kinds=assignment.kinds)
        self._setpoint = np.full((rows, 4), np.nan)
        self.health, self.hazards = ProcessHealth(), Hazards(flies, assignment.limits)
        self._detector, self._preflight = Detector(assignment), Preflight(assignment)
        self.begun = False
        self._decided = self._asked = -1
        self._duties: BodyCommands | None = None
        self._ordered = np.zeros(rows, dtype=bool)
        self._individual = PositionController(assignment.kinds)
        self._safety = SetpointFilter(assignment.kinds, assignment.limits)
        self._sight = _sight(assignment)
        self._landing = Landing(assignment)
        self.origins: dict[int, Setpoint] = {}
        self._nobody: Mask = np.zeros(rows, dtype=bool)
        self._everybody: Mask = np.ones(rows, dtype=bool)
        self._wild = self._nobody
        self._where: PoseValidity
        self._age: Array

    # ------------------------------------------------------------------ what the outside tells

    @property
    def trigger(self) -> Trigger:
        """Who speaks when; may be replaced by one of the same kind."""
        return self._voice.trigger

    @trigger.setter
    def trigger(self, trigger: Trigger) -> None:
        self._voice.trigger = trigger

    @property
    def last_transmission(self) -> LastEvent:
        """What the neighbours were told."""
        return self._voice.last_event

    @property
    def neighbours(self) -> NeighbourStates:
        """What was heard on each link, and who takes part in the law."""
        return self.goal_computer.neighbours

    @property
    def neighbour_poses(self) -> NeighbourPoses:
        """What was heard on each link."""
        return self.neighbours.poses

    def receive(self, at: Index, position: Array, velocity: Array, stamp: Array, arrived: Array) -> None:
        """See `NeighbourStates.hear`."""
        self.neighbours.receive(at, position, velocity, stamp, arrived)

    def mark_lost(self, at: Index, t: float) -> None:
        """See `NeighbourStates.lose`."""
        self.neighbours.mark_lost(at, t)

    def mark_alive(self, at: Index) -> None:
        """See `NeighbourStates.find`."""
        self.neighbours.mark_alive(at)

    def discard_poses(self, at: Index) -> None:
        """See `NeighbourStates.forget`."""
        self.neighbours.discard_poses(at)

    def receive_goal(self, rows: Index, goal: Array, toward: Array, stamp: Array) -> Mask:
        """See `Guidance.hear`; rows that nobody guides take no goals."""
        return (
            np.zeros(len(rows), dtype=bool)
            if self.guidance is None
            else self.guidance.receive(rows, goal, toward, stamp)
        )

    def hold(self, row: int) -> str:
        """Order to stay where it is; an empty answer means yes, else why not."""
        if self.lifecycle.phase[row] not in (AIRBORNE, RUNNING):
            return f"cannot hold while {Phase(self.lifecycle.phase[row]).word}"
        self._ordered[row] = True
        return ""

    def resume(self, row: int) -> None:
        """Order to go on after a hold."""
        self._ordered[row] = False

    def start(self, row: int, at: float, t: float = -np.inf, origin: Setpoint | None = None) -> str:
        """Order to begin at `at` [s], or to go on after a hold.

        Args:
            row: Of the robot.
            at: Common start [s].
            t: Now [s].
            origin: x, y, z [m] and yaw [rad] where the plan of a robot began that comes back; None: it begins anew.
        """
        waits = self.lifecycle.phase[row] == AIRBORNE
        refusal = self.lifecycle.start(row, at)
        if not refusal:
            self.resume(row)
            if origin is not None and waits:
                x, y, z, yaw = origin
                self.origins[row] = origin
                self.goal_computer.begin_plans(
                    np.array([row]), np.array([[x, y, z]]), np.array([yaw]), max(0.0, t - at)
                )
        return refusal

    def origin(self, row: int) -> Setpoint | None:
        """x, y, z [m] and yaw [rad] where the plan of a row began, or where it was told that it began."""
        return self.goal_computer.origin(row) or self.origins.get(row)

    def missing_neighbours(self, row: int) -> list[str]:
        """Neighbours that a row has never heard, or that are gone; likewise its centre."""
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
        """So many ticks come too late to be made: called before each tick, mostly with 0."""
        self.tick += ticks
        self.health.count_tick(ticks, 1.0 / self.assignment.body_hz)

    @property
    def descending(self) -> Mask:
        """Rows (N,) that come down, or are down; not those that look for a place to."""
        return np.asarray((self.lifecycle.phase >= LANDING) & ~self._landing.aside)

    def land_here(self) -> None:
        """Something else has made the bodies land: nobody looks for a better place any more."""
        self._landing.land_in_place()

    # ------------------------------------------------------------------ the decision

    def step(self, t: float, state: BodyState) -> Actions:
        """One tick at time `t` [s] of the process's clock."""
        return self.act(t, state, self.transmit(t, state))

    def transmit(self, t: float, state: BodyState) -> Transmission:
        """The first half of a tick: phases move on, and it is decided who speaks. What is said was measured."""
        self.goal_computer.update_links(t)
        life = self.lifecycle
        self._age = t - state.time
        self._where = self._safety.validate_poses(state.position, state.yaw, self._age)
        duties = life.advance(t, self._ready(t, state), state.position, state.velocity, state.flying)
        self._duties = self._landing.filter_commands(
            t, duties, state, self._where, hearing=self.neighbours, late=self.health.loop_failing, phase=life.phase
        )
        assignment = self.assignment
        if life.moved and not self.begun and (life.phase == RUNNING).any():
            since = t - float(life.start_at[life.phase == RUNNING].min())
            self._decided = self._asked = -1
            self.begun, self.tick = True, round(since * assignment.body_hz)  # 0, unless it joins a run under way
        # by number, not by remainder: a tick that was skipped because the process was late is made up for
        decision, question = self.tick // assignment.decide_every, self.tick // assignment.pose_every
        self.decision_due, self._decided = decision != self._decided, decision
        if question == self._asked:
            return Transmission(NOBODY, state.position, state.velocity)
        self._asked = question
        self.error, energy = self.goal_computer.errors(t, state.position)
        return self._voice.transmit(
            t, state.position, state.velocity,
            error=self.error, energy=energy, start=life.start_at, offset=self.offset,
            setpoint=self._setpoint,
        )  # fmt: skip

    def act(self, t: float, state: BodyState, said: Transmission) -> Actions:
        """The second half: goals, and what bodies do."""
        held = self.hazards.held
        self._heed(t, state)
        if self.decision_due:
            self._decide(t, state)
        elif self.lifecycle.moved or held is not self.hazards.held:
            # a row that has just arrived at its height, or must stop, needs a place to stay until the next decision
            held = (self.lifecycle.phase == RUNNING) & self.hazards.held
            self._stay(self._holding.held | held | (self.lifecycle.phase == AIRBORNE), state.position)
        if self.guidance is not None:
            self._follow(self.guidance, state.position)
        goal, avoided = self.goal, self._nobody
        aside = self._landing.aside
        if self._landing.any_aside:
            goal = np.where(aside[:, None], self._landing.place, goal)
        age, where = self._age, self._where
        avoidance = self.assignment.avoidance
        if avoidance is None or self._sight is None:
            setpoint = self._individual.setpoint(goal, self.goal_yaw, state.position, state.yaw)
            verdict = self._safety.check(setpoint, state.position, state.yaw, age, where=where)
        else:
            own, near = self._sight.sense(t, state, self.neighbour_poses)
            wanted, goal = goal, self._deviate(avoidance, goal, own, near)
            setpoint = self._individual.setpoint(goal, self.goal_yaw, state.position, state.yaw)
            verdict = self._safety.check(setpoint, state.position, state.yaw, age, avoidance, own, near, where)
            avoided = verdict.avoided
            if goal is not wanted:
                avoided = avoided | (np.abs(goal - wanted) > 0.0).any(axis=1)
        setpoint, changed, self._wild = verdict.setpoint, verdict.changed, verdict.not_finite
        if not self.lifecycle.all_running:
            phase = self.lifecycle.phase
            passive = ((phase < AIRBORNE) | (phase > RUNNING)) & ~aside
            setpoint = np.where(passive[:, None], np.where(self._flies, np.nan, 0.0)[:, None], setpoint)
            changed, avoided, self._wild = changed & ~passive, avoided & ~passive, self._wild & ~passive
        self.tick, self._setpoint = self.tick + 1, setpoint
        return Actions(said.rows, setpoint, self._duties, changed, avoided, said.position, said.velocity)

    def _ready(self, t: float, state: BodyState) -> Mask:
        life, assignment = self.lifecycle, self.assignment
        if not life.waiting:
            return self._nobody  # nobody asks any more
        lacks = np.zeros(len(life.phase), dtype=bool)
        if assignment.patience_s is None or t <= assignment.patience_s:
            lacks[assignment.links.receiver[assignment.unreceived(self.neighbours.stamp_once_alive)]] = True
            if self.guidance is not None:
                lacks |= self.guidance.rows_without_goal()
        failing = self._preflight.check(
            t, state, self._where, self.neighbours, self.health, (lacks, self.missing_neighbours)
        )
        lost = self._preflight.lost(t, failing)
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

    def _heed(self, t: float, state: BodyState) -> None:
        """What is wrong is noticed, and has its consequences: rows hold, land, or have their motors cut."""
        life, hearing, guidance = self.lifecycle, self.neighbours, self.guidance
        if life.all_running:
            active = cruising = running = self._everybody
            landing = self._nobody
        else:
            running, landing, active = life.phase == RUNNING, life.phase == LANDING, life.active
            cruising = running | (life.phase == AIRBORNE)
        rows = RowStatus(
            self._ordered,
            cruising,
            landing,
            self.goal_computer.without_neighbours() if hearing.incomplete else None,
            None if guidance is None else running & guidance.unguided(t),
            None if guidance is None else guidance.stamp,
            self.goal[:, 2],
            self._wild,
            self._landing,
        )
        seen = self._detector.detect(t, state, self._where, hearing, rows, self.health)
        for incident in self.hazards.update(t, seen, active, landing):
            end = life.stop if incident.outcome == Outcome.CUT else life.land
            end(incident.row, self.hazards.words(incident.cause))

    def _decide(self, t: float, state: BodyState) -> None:
        """A new goal for every row that decides for itself and is under way; all others may have to stay."""
        phase = self.lifecycle.phase
        running = phase == RUNNING
        if some(running):
            self.decisions += 1
            if not self.all_guided:
                own = running if self.guidance is None else running & ~self._guided
                own = own if self._where.all_valid else own & ~self._where.invalid
                new = self.goal_computer.decide(
                    t, state.position, state.velocity, state.yaw, start=self.lifecycle.start_at, running=own
                )
                self.goal = np.where(new.due[:, None], new.goal, self.goal)
                self.offset = np.where(new.due[:, None], new.offset, self.offset)
                self.goal_yaw = np.where(new.due, new.yaw, self.goal_yaw)
                self.updates += new.due
        self._stay(self._holds(running) | (phase == AIRBORNE), state.position)
        if some(away := self._holding.held | ~running):
            self.goal_computer.require_update(np.flatnonzero(away))  # whoever comes back has an old goal

    def _stay(self, held: Mask, position: Array) -> None:
        """Rows that are held keep the place where that began."""
        self.goal, self.goal_yaw = self._holding.hold_position(held, position, self.goal, self.goal_yaw)

    def _holds(self, running: Mask) -> Mask:
        """Which running rows must stay: for their safety, or because no link is there that the law could listen to."""
        held = running & self.hazards.held
        if len(self.neighbours.active) < len(self.assignment.links):
            held = held | (running & self.goal_computer.without_neighbours())
        return held

    def _follow(self, guidance: Guidance, position: Array) -> None:
        """Guided rows go where they were told, from the moment on that they were."""
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

    def _deviate(self, avoidance: Avoidance, wanted: Array, own: OwnState, near: Nearby) -> Array:
        """The goals that are pursued; an avoidance that fails is named, for it may be somebody's first."""
        name = type(avoidance).__name__
        try:
            goal = avoidance.deviate(wanted, own, near, 1.0 / self.assignment.body_hz)
        except FAILURES as error:
            raise PluginError(f"the avoidance {name} failed: {_what(error)}") from error
        if np.shape(goal) != wanted.shape:
            raise PluginError(
                f"`deviate` of the avoidance {name} must give a goal per row, {wanted.shape}, not {np.shape(goal)}"
            )
        return goal


def _what(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _sight(assignment: Assignment) -> Perception | None:
    avoidance = assignment.avoidance
    if avoidance is None:
        return None
    kinds, speakers, limits = assignment.kinds, assignment.robot_kinds, assignment.limits
    return Perception(kinds, speakers, assignment.links, limits, avoidance.clearance, assignment.avoids)


def links_by_sender(links: Links, speakers: Sequence[str]) -> dict[str, Index]:
    """For each speaker's name, the links on which it is heard."""
    return {speakers[s]: np.flatnonzero(links.sender == s) for s in np.unique(links.sender)}
