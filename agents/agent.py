"""The whole decision of any number of robots: no clock, no I/O, no Zenoh, no randomness.

Time, measured poses and what was heard go in; who speaks, what the body must do and its setpoints come out. A robot's
process calls this with one row, a radio's process with three, the virtual clock with all rows of all repetitions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents import coordination
from agents.avoidance import Avoidance, Nearby, Self
from agents.body import BodyState
from agents.graph import Links
from agents.individual import Individual
from agents.kinds import Kind
from agents.lifecycle import AIRBORNE, RUNNING, Duties, Lifecycle, Phase
from agents.planning import Itinerary, Leg
from agents.plugins import FAILURES, PluginError
from agents.rows import Array, Index, Mask, every, some
from agents.safety import Limits, Safety, Verdict
from agents.sight import Sight
from agents.triggers import Told, Trigger, View


@dataclass(frozen=True)
class Assignment:
    """What the experiment tells some of its robots.

    Attributes:
        names: Of the rows (N).
        kinds: Of the rows (N).
        hover: (N,) height that a flying row holds [m]; NaN for ground robots.
        speakers: Names of all robots of the experiment; `links.speaker` points here.
        links: On which the rows listen.
        law: Formation law.
        trigger: Who speaks when.
        clamp: Largest step of a goal per axis and decision [m].
        tracking_gain: k of (7) [1/(m² decision)].
        legs: Plans: rows, and the legs that they follow.
        limits: For `agents.safety`.
        avoidance: How the rows keep clear of what they see and hear; None: they do not.
        speaker_kinds: Kinds of all robots of the experiment.
        watched: (E,) links that are only for avoidance: the law knows nothing of them; None: there are none.
        avoids: (N,) rows that keep clear at all; None: all.
        body_hz: Rate of ticks.
        pose_every: The trigger is asked on every so many ticks.
        decide_every: A goal is decided on every so many ticks.
        duration: Of the experiment [s].
        patience_s: A row that misses a neighbour for this long is ready without it; None: never.
    """

    names: tuple[str, ...]
    kinds: tuple[Kind, ...]
    hover: Array
    speakers: tuple[str, ...]
    links: Links
    law: coordination.Law
    trigger: Trigger
    clamp: float
    tracking_gain: float
    legs: tuple[tuple[Index, tuple[Leg, ...]], ...]
    limits: Limits
    body_hz: float
    pose_every: int
    decide_every: int
    duration: float
    patience_s: float | None = None
    avoidance: Avoidance | None = None
    speaker_kinds: tuple[Kind, ...] = ()
    watched: Mask | None = None
    avoids: Mask | None = None


@dataclass
class Heard:
    """What was last heard on each link (E): positions and velocities (E, 3), sample and arrival times (E,) [s].

    `gone` is the time since which the speaker is known to be dead, infinity while it lives.
    """

    position: Array
    velocity: Array
    stamp: Array
    arrived: Array
    gone: Array

    @classmethod
    def nothing(cls, count: int) -> Heard:
        """Before anything was heard."""
        never = np.full(count, -np.inf)
        return cls(np.full((count, 3), np.nan), np.zeros((count, 3)), never, never.copy(), np.full(count, np.inf))


@dataclass(frozen=True)
class Actions:
    """What comes out of a tick.

    Attributes:
        speak: Rows that send their pose now.
        setpoint: (N, 4) for the body, NaN rows for those that act by themselves.
        duties: Take-offs, landings, stops; None on nearly every tick.
        changed: (N,) safety had to change what was decided.
        avoided: (N,) avoidance did.
    """

    speak: Index
    setpoint: Array
    duties: Duties | None
    changed: Mask
    avoided: Mask


NOBODY: Index = np.zeros(0, dtype=np.intp)


class Agent:
    """The decision of N rows.

    Attributes:
        tick: Number of the next tick; set to 0 at the common start, so that robots decide together.
        goal: (N, 3) decided last [m].
        toward: (N,) yaw wanted at the goal [rad], NaN for any.
        error: (N,) Σ of the link errors as the rows see them [m].
        decisions: Coordination decisions since the common start.
        heard: What was heard on each link.
        life: Phases.
    """

    def __init__(self, assignment: Assignment) -> None:
        rows = len(assignment.names)
        self.assignment = assignment
        self.tick = 0
        self.goal = np.full((rows, 3), np.nan)
        self.toward = np.full(rows, np.nan)
        self.error = np.zeros(rows)
        self.decisions = 0
        self.told = Told.nothing(rows)
        self.heard = Heard.nothing(len(assignment.links))
        flies = np.array([kind.flies for kind in assignment.kinds])
        self.life = Lifecycle(flies, assignment.hover, assignment.duration)
        self.trigger = assignment.trigger
        self.clamp, self.tracking_gain = assignment.clamp, assignment.tracking_gain
        self.offline_since = np.inf
        self._begun = False
        self._decided = self._asked = -1
        self._memory = self.trigger.memory(rows)
        self._flies = flies
        self._ground = np.where(flies, assignment.hover, 0.0)
        self._listens = np.zeros(rows, dtype=bool)
        watched = assignment.watched
        self._listens[assignment.links.listener if watched is None else assignment.links.listener[~watched]] = True
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
        self._choose_links(0.0)

    # ------------------------------------------------------------------ what the outside tells

    def hear(self, at: Index, position: Array, velocity: Array, stamp: Array, arrived: Array) -> None:
        """Poses that arrived on links `at` (H,), in order of arrival; older samples than known are left out."""
        if some(stamp[1:] < stamp[:-1]):  # of several on one link the newest stays, whichever came last
            order = np.argsort(stamp, kind="stable")
            at, position, velocity = at[order], position[order], velocity[order]
            stamp, arrived = stamp[order], arrived[order]
        newer = stamp > self.heard.stamp[at]
        if not every(newer):
            at, position, velocity = at[newer], position[newer], velocity[newer]
            stamp, arrived = stamp[newer], arrived[newer]
        self.heard.position[at], self.heard.velocity[at] = position, velocity
        self.heard.stamp[at], self.heard.arrived[at] = stamp, arrived
        if self._unsettled:
            self.heard.gone[at] = np.inf

    def lose(self, at: Index, t: float) -> None:
        """The speakers of links `at` are gone since `t` [s]; heard again, they are back."""
        self.heard.gone[at] = np.minimum(self.heard.gone[at], t)
        self._unsettled = True

    def find(self, at: Index) -> None:
        """The speakers of links `at` are back, whether or not they have something new to say."""
        self.heard.gone[at] = np.inf

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
        links = self.assignment.links
        lacks = ~np.isfinite(self.heard.stamp) | np.isfinite(self.heard.gone)
        return [self.assignment.speakers[s] for s in links.speaker[(links.listener == row) & lacks]]

    # ------------------------------------------------------------------ the decision

    def step(self, t: float, state: BodyState) -> Actions:
        """One tick at time `t` [s] of the process's clock."""
        if self._unsettled:
            self._choose_links(t)
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
        speak = NOBODY
        if question != self._asked:
            self._asked = question
            self._see_errors(state.position)
            view = View(t, state.position, state.velocity, self.told, self.error)
            speak = self._ask(view)
            if len(speak):
                seen = np.isfinite(state.position)
                if not every(seen):
                    speak = speak[seen[speak].all(axis=1)]
                self.told.tell(speak, t, state.position, state.velocity)
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
        return Actions(speak, setpoint, duties, changed, avoided)

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
        if len(self._live) < len(self.assignment.links):
            hears = np.zeros(len(held), dtype=bool)
            hears[self._live_links.listener] = True
            held = held | (running & self._listens & ~hears)
        return held

    def _formation_goal(self, t: float, state: BodyState, running: Mask) -> None:
        law, position = self.assignment.law, state.position
        try:
            offset = law.offset(position, self.heard.position[self._live], self._live_links)
        except FAILURES as error:
            raise PluginError(f"the law {type(law).__name__} failed: {_what(error)}") from error
        goal = position.copy()
        toward = np.full(len(position), np.nan)
        place = position.copy()
        place[:, 2] = self._ground  # a plan begins at the height that is held, not where the climb was called done
        for itinerary in self._itineraries:
            rows = itinerary.rows
            target, yaw = itinerary.target(t - self.life.start_at[rows], place[rows], state.yaw[rows])
            toward[rows] = yaw
            leads = ~self._listens[rows]
            if leads.all():
                goal[rows] = target
            else:
                offset[rows] += coordination.tracking(position[rows], target, self.tracking_gain)
        follows = self._listens
        goal = np.where(follows[:, None], coordination.goal(position, offset, self.clamp), goal)
        goal[:, 2] = np.where(follows | ~self._flies, self._ground, goal[:, 2])
        self.goal = np.where(running[:, None], goal, self.goal)
        self.toward = np.where(running, toward, self.toward)

    def _ask(self, view: View) -> Index:
        """Who speaks now; a trigger that fails is named, for it may be somebody's first."""
        try:
            return self.trigger.speaks(view, self._memory)
        except FAILURES as error:
            raise PluginError(f"the trigger {type(self.trigger).__name__} failed: {_what(error)}") from error

    def _see_errors(self, position: Array) -> None:
        error = self.assignment.law.error(position, self.heard.position[self._live], self._live_links)
        self.error = self._live_links.onto_listeners(error[:, None], len(position))[:, 0]

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

    def _choose_links(self, t: float) -> None:
        """Which links take part in the law: heard once, and the speaker is not gone for long."""
        links, heard = self.assignment.links, self.heard
        known, here = np.isfinite(heard.stamp), np.isinf(heard.gone)
        self._unsettled = not (known & here).all()
        live = known & (t - heard.gone <= self.assignment.limits.link_silence_s)
        if self.assignment.watched is not None:
            live &= ~self.assignment.watched
        self._live = np.flatnonzero(live)
        self._live_links = (
            links
            if live.all()
            else Links(links.listener[live], links.speaker[live], links.distance[live], links.gain[live])
        )


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
