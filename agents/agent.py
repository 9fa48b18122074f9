"""The whole decision of any number of robots: no clock, no I/O, no Zenoh, no randomness.

Time, measured poses and what was heard go in; who speaks, what the body must do and its setpoints come out. A robot's
process calls this with one row, a radio's process with three, the virtual clock with all rows of all repetitions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents import coordination
from agents.assignment import Assignment
from agents.avoidance import Avoidance, Nearby, Self
from agents.body import BodyState
from agents.graph import Links
from agents.hearing import Heard, Hearing
from agents.individual import Individual
from agents.lifecycle import AIRBORNE, RUNNING, Duties, Lifecycle, Phase
from agents.planning import Itinerary
from agents.plugins import FAILURES, PluginError
from agents.reshaping import Reshaping
from agents.rows import Array, Index, Mask, some
from agents.safety import Safety, Verdict
from agents.sight import Sight
from agents.speaking import Said, Voice
from agents.triggers import Told, Trigger
from agents.updating import Input, Updating


@dataclass(frozen=True)
class Actions:
    """What comes out of a tick.

    Attributes:
        speak: Rows that send their pose now.
        setpoint: (N, 4) for the body, NaN rows for those that act by themselves.
        duties: Take-offs, landings, stops; None on nearly every tick.
        changed: (N,) safety had to change what was decided.
        avoided: (N,) avoidance did.
        position: (N, 3) that rows which speak say [m].
        velocity: (N, 3) that they say [m/s].
    """

    speak: Index
    setpoint: Array
    duties: Duties | None
    changed: Mask
    avoided: Mask
    position: Array
    velocity: Array


NOBODY: Index = np.zeros(0, dtype=np.intp)


class Agent:
    """The decision of N rows.

    Attributes:
        tick: Number of the next tick; set to 0 at the common start, so that robots decide together.
        goal: (N, 3) decided last [m].
        toward: (N,) yaw wanted at the goal [rad], NaN for any.
        error: (N,) Σ of the link errors as the rows see them [m].
        offset: (N, 3) decided last, before it was clamped [m].
        decisions: Coordination decisions since the common start.
        updates: (N,) of these, those at which each row computed its goal anew.
        hearing: What was heard on each link, and who takes part in the law.
        life: Phases.
    """

    def __init__(self, assignment: Assignment) -> None:
        rows = len(assignment.names)
        self.assignment = assignment
        self.tick = 0
        self.goal = np.full((rows, 3), np.nan)
        self.toward = np.full(rows, np.nan)
        self.error, self.offset = np.zeros(rows), np.zeros((rows, 3))
        self.decisions = 0
        self.updates: Index = np.zeros(rows, dtype=np.intp)
        self.hearing = Hearing(assignment.links, assignment.watched, assignment.limits.link_silence_s)
        flies = np.array([kind.flies for kind in assignment.kinds])
        self.life = Lifecycle(flies, assignment.hover, assignment.duration)
        self._voice = Voice(assignment.trigger, rows, assignment.predictor)
        self._updating = None if assignment.update is None else Updating(assignment.update, rows, assignment.links)
        self.clamp, self.tracking_gain = assignment.clamp, assignment.tracking_gain
        self.offline_since = np.inf
        self._begun = False
        self._decided = self._asked = -1
        self._flies = flies
        self._ground = np.where(flies, assignment.hover, 0.0)
        self._listens = np.zeros(rows, dtype=bool)
        watched = assignment.watched
        self._listens[assignment.links.listener if watched is None else assignment.links.listener[~watched]] = True
        self._anchored = np.zeros(rows, dtype=bool)
        if assignment.anchors is not None:
            self._anchored[assignment.anchors.row] = True
        self._listens |= self._anchored
        changing = bool(assignment.changes) or assignment.presence is not None
        self._reshaping = Reshaping(assignment.links, assignment.changes, assignment.presence) if changing else None
        if self._reshaping is not None:
            self.hearing.reshape(self._reshaping.links, self._reshaping.there)
        self._ordered = np.zeros(rows, dtype=bool)
        self._held = np.zeros(rows, dtype=bool)
        self._hold_at = np.full((rows, 3), np.nan)
        self._individual = Individual(assignment.kinds)
        self._safety = Safety(assignment.kinds, assignment.limits)
        self._sight = _sight(assignment)
        self._nobody: Mask = np.zeros(rows, dtype=bool)
        self._blind_since, self._any_blind = np.full(rows, np.inf), False
        planned = np.zeros(rows, dtype=bool)
        itineraries = []
        for group, legs in assignment.legs:
            planned[group] = True
            for listens in (True, False):
                part = group[self._listens[group] == listens]
                if len(part):
                    itineraries.append(Itinerary(part, legs, holds_before=not listens))
        rest = np.flatnonzero(~planned & ~self._listens)
        if len(rest):  # nobody tells it anything: it stays where it is
            itineraries.append(Itinerary(rest, (), holds_before=True))
        self._itineraries = tuple(itineraries)
        self._gated = self._listens & ~planned  # a plan moves its target while nobody looks

    # ------------------------------------------------------------------ what the outside tells

    @property
    def trigger(self) -> Trigger:
        """Who speaks when; may be replaced by one of the same kind."""
        return self._voice.trigger

    @trigger.setter
    def trigger(self, trigger: Trigger) -> None:
        self._voice.trigger = trigger

    @property
    def told(self) -> Told:
        """What the neighbours were told."""
        return self._voice.told

    @property
    def heard(self) -> Heard:
        """What was heard on each link."""
        return self.hearing.heard

    def hear(self, at: Index, position: Array, velocity: Array, stamp: Array, arrived: Array) -> None:
        """See `Hearing.hear`."""
        self.hearing.hear(at, position, velocity, stamp, arrived)

    def lose(self, at: Index, t: float) -> None:
        """See `Hearing.lose`."""
        self.hearing.lose(at, t)

    def find(self, at: Index) -> None:
        """See `Hearing.find`."""
        self.hearing.find(at)

    def hold(self, row: int) -> str:
        """Order to stay where it is; an empty answer means yes, else why not."""
        if self.life.phase[row] not in (AIRBORNE, RUNNING):
            return f"cannot hold while {Phase(self.life.phase[row]).word}"
        self._ordered[row] = True
        return ""

    def start(self, row: int, at: float) -> str:
        """Order to begin at `at` [s], or to go on after a hold."""
        refusal = self.life.start(row, at)
        if not refusal:
            self._ordered[row] = False
        return refusal

    def missing(self, row: int) -> list[str]:
        """Neighbours that a row has never heard, or that are gone."""
        return [self.assignment.speakers[s] for s in self.hearing.missing(row)]

    # ------------------------------------------------------------------ the decision

    def step(self, t: float, state: BodyState) -> Actions:
        """One tick at time `t` [s] of the process's clock."""
        if self.hearing.unsettled:
            self._links_changed(self.hearing.choose(t))
        duties = self.life.advance(t, self._ready(t, state), state.position, state.velocity, state.flying)
        assignment = self.assignment
        if self.life.moved and not self._begun and (self.life.phase == RUNNING).any():
            since = t - float(self.life.start_at[self.life.phase == RUNNING].min())
            self._decided = self._asked = -1
            self._begun, self.tick = True, round(since * assignment.body_hz)  # 0, unless it joins a run under way
        # by number, not by remainder: a tick that was skipped because the process was late is made up for
        decision, question = self.tick // assignment.decide_every, self.tick // assignment.pose_every
        if decision != self._decided:
            self._decided = decision
            self._decide(t, state)
        elif self.life.moved:  # a row that has just arrived at its height needs a place to stay until the next decision
            self._stay(self._held | (self.life.phase == AIRBORNE), state.position)
        said = Said(NOBODY, state.position, state.velocity)
        if question != self._asked:
            self._asked = question
            said = self._speak(t, state)
        goal, avoided = self.goal, self._nobody
        age = t - state.time
        avoidance = self.assignment.avoidance
        if avoidance is None or self._sight is None:
            setpoint = self._individual.setpoint(goal, self.toward, state.position, state.yaw)
            verdict = self._safety.check(setpoint, state.position, state.yaw, age)
        else:
            own, near = self._sight.see(t, state, self.heard)
            goal = self._deviate(avoidance, own, near)
            setpoint = self._individual.setpoint(goal, self.toward, state.position, state.yaw)
            verdict = self._safety.check(setpoint, state.position, state.yaw, age, avoidance, own, near)
            avoided = verdict.avoided
            if goal is not self.goal:
                avoided = avoided | (np.abs(goal - self.goal) > 0.0).any(axis=1)
        self._escalate(t, state, verdict)
        setpoint, changed = verdict.setpoint, verdict.changed
        if not self.life.all_running:
            phase = self.life.phase
            passive = (phase < AIRBORNE) | (phase > RUNNING)
            setpoint = np.where(passive[:, None], np.where(self._flies, np.nan, 0.0)[:, None], setpoint)
            changed, avoided = changed & ~passive, avoided & ~passive
        self.tick += 1
        return Actions(said.rows, setpoint, duties, changed, avoided, said.position, said.velocity)

    def _ready(self, t: float, state: BodyState) -> Mask:
        if not self.life.waiting:
            return self._listens  # nobody asks any more
        seen = np.isfinite(state.position).all(axis=1) & (t - state.time <= self.assignment.limits.own_silence_s)
        lacks = np.zeros(len(seen), dtype=bool)
        lacks[self.assignment.links.listener[~np.isfinite(self.heard.stamp)]] = True
        patience = self.assignment.patience_s
        ready = seen & (~lacks | (patience is not None and t > patience))
        for row in np.flatnonzero(~ready).tolist():
            lacking = "never heard " + ", ".join(self.missing(row)) if seen[row] else "no position of its own"
            self.life.wait(row, lacking)
        return ready

    def _decide(self, t: float, state: BodyState) -> None:
        """A new goal for every row that is in the air or under way."""
        phase = self.life.phase
        running = phase == RUNNING
        if some(running):
            self.decisions += 1
            self._formation_goal(t, state, running)
        self._stay(self._holds(t, running) | (phase == AIRBORNE), state.position)
        if self._updating is not None and some(away := self._held | ~running):
            self._updating.forget(np.flatnonzero(away))  # whoever comes back has an old goal

    def _stay(self, held: Mask, position: Array) -> None:
        """Rows that are held keep the place where that began."""
        if not some(held):
            self._held = held
            return
        entered = held & ~self._held
        if some(entered):
            self._hold_at[entered] = position[entered]
            self._hold_at[entered, 2] = self._ground[entered]
        self._held = held
        self.goal = np.where(held[:, None], self._hold_at, self.goal)
        self.toward = np.where(held, np.nan, self.toward)

    def _holds(self, t: float, running: Mask) -> Mask:
        """Which running rows must stay where they are: told to, cut off, or all their neighbours are gone."""
        limits = self.assignment.limits
        held = running & self._ordered
        if t - self.offline_since > limits.link_silence_s:
            held = held | running
        if len(self.hearing.live) < len(self.assignment.links):
            hears = np.zeros(len(held), dtype=bool)
            hears[self.hearing.links.listener] = True
            if self.assignment.anchors is not None:
                hears[self.assignment.anchors.row] = True
            held = held | (running & self._listens & ~hears)
        return held

    def _formation_goal(self, t: float, state: BodyState, running: Mask) -> None:
        position, follows, due, view = state.position, self._listens, running, None
        if self._reshaping is not None:
            everywhere = self.hearing.everywhere(self.assignment.predictor, t)
            self._reshaping.move(t - self.life.start_at, position, everywhere)
            self._links_changed(self.hearing.reshape(self._reshaping.links, self._reshaping.there))
        if self._updating is not None:
            view = self._input(self._updating, t, state)
            due = running & (~self._gated | self._updating.due(view))
        if view is None:
            offset = self._law_offset(t, position)
        else:
            offset = view.offset if some(due & follows) else np.zeros_like(position)
        goal = position.copy()
        toward = np.full(len(position), np.nan)
        place = position.copy()
        place[:, 2] = self._ground  # a plan begins at the height that is held, not where the climb was called done
        for itinerary in self._itineraries:
            rows = itinerary.rows
            target, yaw = itinerary.target(t - self.life.start_at[rows], place[rows], state.yaw[rows])
            toward[rows] = yaw
            leads = ~follows[rows]
            if leads.all():
                goal[rows] = target
            else:
                offset[rows] += coordination.tracking(position[rows], target, self.tracking_gain)
        goal = np.where(follows[:, None], coordination.goal(position, offset, self.clamp), goal)
        goal[:, 2] = np.where(follows | ~self._flies, self._ground, goal[:, 2])
        self.goal = np.where(due[:, None], goal, self.goal)
        self.offset = np.where(due[:, None], offset, self.offset)
        self.toward = np.where(due, toward, self.toward)
        self.updates += due

    def _law_offset(self, t: float, position: Array) -> Array:
        """The offset of all rows (N, 3) [m]; a law that fails is named, for it may be somebody's first."""
        law, hearing, anchors = self.assignment.law, self.hearing, self.assignment.anchors
        believed = hearing.heard.believed(self.assignment.predictor, t, hearing.live)
        try:
            offset = law.offset(position, believed, hearing.links)
        except FAILURES as error:
            raise PluginError(f"the law {type(law).__name__} failed: {_what(error)}") from error
        return offset if anchors is None else offset + anchors.offset(position)

    def _see_errors(self, t: float, position: Array) -> tuple[Array, Array]:
        """Σ|e| [m] and Σ ½e² [m²] of each row's links, as it sees them."""
        hearing = self.hearing
        believed = hearing.heard.believed(self.assignment.predictor, t, hearing.live)
        error = self.assignment.law.error(position, believed, hearing.links)
        both = hearing.links.onto_listeners(_error_and_energy(error), len(position))
        anchors = self.assignment.anchors
        if anchors is not None:
            np.add.at(both, anchors.row, _error_and_energy(anchors.error(position)))
        return both[:, 0], both[:, 1]

    def _speak(self, t: float, state: BodyState) -> Said:
        """Who speaks now, and what."""
        self.error, energy = self._see_errors(t, state.position)
        return self._voice.speak(
            t, state.position, state.velocity,
            error=self.error, energy=energy, start=self.life.start_at, offset=self.offset,
        )  # fmt: skip

    def _input(self, updating: Updating, t: float, state: BodyState) -> Input:
        """What the trigger of the control place sees."""
        hearing, predictor, position = self.hearing, self.assignment.predictor, state.position
        listener = hearing.links.listener
        believed = hearing.heard.believed(predictor, t, hearing.live)
        moves = hearing.heard.believed_velocity(predictor, t, hearing.live)
        return updating.input(
            t, position, state.velocity,
            start=self.life.start_at,
            live=hearing.live,
            links=hearing.links,
            anchored=self._anchored,
            apart=position[listener] - believed,
            rate=state.velocity[listener] - moves,
            law=lambda: self._law_offset(t, position),
            errors=lambda: self._see_errors(t, position),
        )  # fmt: skip

    def _deviate(self, avoidance: Avoidance, own: Self, near: Nearby) -> Array:
        """The goals that are pursued; an avoidance that fails is named, for it may be somebody's first."""
        name = type(avoidance).__name__
        try:
            goal = avoidance.deviate(self.goal, own, near, 1.0 / self.assignment.body_hz)
        except FAILURES as error:
            raise PluginError(f"the avoidance {name} failed: {_what(error)}") from error
        if np.shape(goal) != self.goal.shape:
            raise PluginError(
                f"`deviate` of the avoidance {name} must give a goal per row, {self.goal.shape}, not {np.shape(goal)}"
            )
        return goal

    def _escalate(self, t: float, state: BodyState, verdict: Verdict) -> None:
        """A flying robot that does not know where it is holds, then lands; one that left the arena lands or halts.

        One whose motors are off in mid-run has come down by itself: it must not be commanded as if it flew.
        """
        blind, escaped, grounded = verdict.blind, verdict.escaped, self._flies & ~state.flying
        if not (some(blind) or some(escaped) or some(grounded)):
            if self._any_blind:
                self._blind_since, self._any_blind = np.full(len(self._flies), np.inf), False
            return
        self._any_blind = True
        self._blind_since = np.where(blind, np.minimum(self._blind_since, t), np.inf)
        blind = blind & (t - self._blind_since >= self.assignment.limits.blind_s - 1e-9)
        active, phase = self.life.active, self.life.phase
        for row in np.flatnonzero(grounded & (phase >= AIRBORNE) & (phase <= RUNNING)).tolist():
            self.life.land(row, "it came down by itself")
        for row in np.flatnonzero(active & blind & self._flies).tolist():
            self.life.land(row, "its own position is lost")
        for row in np.flatnonzero(active & escaped).tolist():
            self.life.land(row, "it left the arena")

    def _links_changed(self, rows: Index) -> None:
        """Rows that got or lost a link, or whose links ask for something else, compute the law at once."""
        if self._updating is not None and len(rows):
            self._updating.forget(rows)


def _error_and_energy(error: Array) -> Array:
    both = np.empty((len(error), 2))  # `stack` takes three times as long
    both[:, 0], both[:, 1] = error, 0.5 * error * error
    return both


def _what(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _sight(assignment: Assignment) -> Sight | None:
    avoidance = assignment.avoidance
    if avoidance is None:
        return None
    kinds, speakers, limits = assignment.kinds, assignment.speaker_kinds, assignment.limits
    return Sight(kinds, speakers, assignment.links, limits, avoidance.clearance, assignment.avoids)


def links_by_speaker(links: Links, speakers: Sequence[str]) -> dict[str, Index]:
    """For each speaker's name, the links on which it is heard."""
    return {speakers[s]: np.flatnonzero(links.speaker == s) for s in np.unique(links.speaker)}
