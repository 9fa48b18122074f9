"""What is wrong with robots now: the causes of `agents.safety.hazards`, as one tick shows them. Pure and row-wise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import asin, degrees, expm1, hypot, sin
from typing import Final

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask, every, norm, some
from agents.body.interface import BodyState
from agents.decision.assignment import Assignment
from agents.decision.neighbours import NeighbourStates
from agents.safety.hazards import Cause, Observation
from agents.safety.landing import Landing
from agents.safety.setpoint_filter import OUTSIDE_M, PoseValidity


class Separation:
    """Distances on all links (E) of rows to those whom they hear, whether the law or only avoidance listens there.

    Attributes:
        touching: (E,) distance of the axes at which two upright robots side by side touch [m].
    """

    def __init__(self, assignment: Assignment) -> None:
        """Of the rows of an assignment."""
        self._assignment, links = assignment, assignment.links
        own = np.array([kind.radius for kind in assignment.kinds])
        theirs = np.array([kind.radius for kind in assignment.robot_kinds])
        self.touching = own[links.receiver] + (theirs[links.sender] if len(theirs) else 0.0)

    def distances(self, t: float, position: Array, hearing: NeighbourStates) -> Array:
        """From rows at `position` (N, 3) to where others are believed to be at `t` [s]: (E,) [m].

        Infinite where nothing was heard, the own position is unknown, or the other is gone for long.
        """
        assignment = self._assignment
        believed = hearing.extrapolate_all(assignment.predictor, t)
        apart = norm(position[assignment.links.receiver] - believed)
        there = np.isfinite(apart) & (t - hearing.poses.lost_since <= assignment.limits.link_silence_s)
        return np.where(there, apart, np.inf)

    def receivers_of(self, which: Mask) -> Mask:
        """Rows (N,) of which a link is among `which` (E,)."""
        rows = np.zeros(len(self._assignment.names), dtype=bool)
        rows[self._assignment.links.receiver[which]] = True
        return rows

    def nearest_robot(self, row: int, distances: Array) -> tuple[float, str]:
        """How far the nearest robot is from a row [m], and its name."""
        links = self._assignment.links
        mine: Index = np.flatnonzero(links.receiver == row)
        at = int(mine[distances[mine].argmin()])
        return float(distances[at]), self._assignment.robots[links.sender[at]]


SUNK: Final = 0.15  # [m] so far below its goal,
SINKS: Final = 0.15  # [m/s] and this fast downward, a row is not flying where it wants to
AHEAD_S: Final = 0.1  # no network here is later than this: what is stamped further ahead is from a clock that is ahead
BEHIND: Final = 0.5  # share of the time after which a robot is blind; what is stamped so far behind is worth a warning
# who was not heard so long after a standstill has had nothing new to say: what was missed comes with the next heartbeat
# of its publisher, 0.5 s after what it said last, or with the history that is asked for after a reconnection
SILENT_S: Final = 1.0
LATE_WINDOW_S: Final = 1.0  # over so long it is counted how many ticks were missed,
LATE_SHARE: Final = 0.9  # and with a larger share of them a control loop is none


@dataclass
class ProcessHealth:
    """What the process around a decision knows and the decision cannot see.

    Attributes:
        offline_since: When the connection to the router was lost [s]; infinity while there is one.
        conductor_lost_since: When the conductor was lost [s]; infinity while it is there, or never was.
        missed_share: Share of the last ticks that were missed, 0 to 1.
        resumed_at: When the process went on after it had stood still [s].
        suspended_s: For how long it had stood still [s].
        connected_since: Since when after that it has had a router [s].
    """

    offline_since: float = np.inf
    conductor_lost_since: float = np.inf
    missed_share: float = 0.0
    resumed_at: float = -np.inf
    suspended_s: float = 0.0
    connected_since: float = -np.inf

    def mark_resumed(self, t: float, slept: float) -> None:
        """The process goes on at `t` [s]; it had stood still for so long [s]."""
        self.resumed_at, self.suspended_s, self.connected_since = t, slept, t

    def just_resumed(self, t: float) -> bool:
        """Whether what was missed in a standstill may still be on its way at `t` [s]; ask on every tick."""
        recent = t < self.connected_since + SILENT_S
        if recent and self.offline_since < np.inf:
            self.connected_since = t
        return recent

    @property
    def loop_failing(self) -> bool:
        """Whether the control loop is none any more."""
        return self.missed_share > LATE_SHARE

    def count_tick(self, missed: int, period: float) -> None:
        """A tick has come after `missed` ones that did not; they are `period` apart [s]."""
        if missed or self.missed_share > 0.0:
            forget = -expm1(-period * (1 + missed) / LATE_WINDOW_S)
            self.missed_share += forget * (missed / (1 + missed) - self.missed_share)
            if self.missed_share < 1e-3:
                self.missed_share = 0.0


class RowStatus(msgspec.Struct, frozen=True):
    """How rows (N,) stand in the experiment on a tick, for `Detector.look`.

    Attributes:
        ordered: Told to hold.
        cruising: At their height or running: their setpoints are followed.
        landing: On their way down.
        without_neighbours: Nobody is left that the law could listen to; None: nobody is alone.
        unguided: Run and are guided by nobody; None: nobody is guided.
        goal_stamp: Decision times of the goals of guided rows [s], minus infinity for others; None: none is guided.
        goal_height: Of their goals [m].
        not_finite: The last setpoint was not made of finite numbers.
        landing_places: Where those that land come down.
    """

    ordered: Mask
    cruising: Mask
    landing: Mask
    without_neighbours: Mask | None
    unguided: Mask | None
    goal_stamp: Array | None
    goal_height: Array
    not_finite: Mask
    landing_places: Landing


class Detector:
    """Looks for causes on N rows."""

    def __init__(self, assignment: Assignment) -> None:
        """Of the rows of an assignment."""
        self._assignment, self._limits = assignment, assignment.limits
        self._flies = np.array([kind.flies for kind in assignment.kinds])
        self._everybody: Mask = np.ones(len(self._flies), dtype=bool)
        speed = np.array([kind.speed for kind in assignment.kinds])
        # the speed of flying kinds is per axis
        self._fastest = assignment.limits.overspeed * np.where(self._flies, np.sqrt(3.0), 1.0) * speed
        self._fastest_squared = self._fastest**2
        self._slow_squared = np.minimum(self._fastest_squared, SINKS**2)  # who is slower neither sinks nor races
        self._all_fly = self._flies.tobytes()
        links, watched = assignment.links, assignment.avoidance_only
        self._lawful = np.ones(len(links), dtype=bool) if watched is None else ~watched
        self._separation = Separation(assignment)

    def detect(  # noqa: PLR0917 - what there is to look at
        self,
        t: float,
        state: BodyState,
        where: PoseValidity,
        hearing: NeighbourStates,
        rows: RowStatus,
        outside: ProcessHealth,
    ) -> list[Observation]:
        """What is wrong at `t` [s]."""
        seen: list[Observation] = []
        if not where.all_valid:
            self._lost(t, state, where, seen)
        if some(rows.ordered):
            seen.append(Observation(Cause.ORDERED, rows.ordered, lambda _: "by an operator"))
        if some(rows.not_finite):
            seen.append(
                Observation(Cause.SETPOINT, rows.not_finite & rows.cruising, lambda _: "not made of finite numbers")
            )
        self._measured(state, rows, seen)
        if self._limits.separation is not None:
            self._near(t, state, hearing, seen)
        if hearing.incomplete:
            self._missed(t, hearing, rows, seen)
        if hearing.clock_lag is not None:
            self._behind(hearing, hearing.clock_lag, seen)
        if rows.unguided is not None and some(rows.unguided):
            seen.append(Observation(Cause.CENTRE, rows.unguided, lambda _: "its centre is gone, or its goals are old"))
        if outside.just_resumed(t):
            self._forgotten(hearing, rows, outside, seen)
        self._surroundings(t, outside, seen)
        return seen

    def _forgotten(
        self, hearing: NeighbourStates, rows: RowStatus, outside: ProcessHealth, seen: list[Observation]
    ) -> None:
        """Rows that have not heard all who are there, or their centre, since the process stood still."""
        heard, links = hearing.poses, self._assignment.links
        silent = (heard.stamp < outside.resumed_at) & np.isfinite(heard.stamp) & np.isinf(heard.lost_since)
        waits = np.zeros(len(self._flies), dtype=bool)
        waits[links.receiver[silent]] = True
        if rows.goal_stamp is not None:
            waits |= (rows.goal_stamp < outside.resumed_at) & np.isfinite(rows.goal_stamp)
        if some(waits):
            seen.append(
                Observation(
                    Cause.STANDSTILL, waits, lambda _: f"for {outside.suspended_s:.1f} s; it waits for its neighbours"
                )
            )

    def _lost(self, t: float, state: BodyState, where: PoseValidity, seen: list[Observation]) -> None:
        """Position, and the arena."""

        def age(row: int) -> str:
            return f"the last is {t - state.time[row]:.2f} s old" if np.isfinite(state.position[row]).all() else "none"

        def out(limit: float, row: int) -> str:
            return f"{where.excess[row]:.2f} m outside (limit {limit:g} m)"

        cut = self._limits.cut_outside
        seen += [
            Observation(Cause.POSITION, where.invalid, age),
            Observation(Cause.MARGIN, where.outside_wall & ~where.outside, lambda row: out(0.0, row)),
            Observation(Cause.OUTSIDE, where.outside, lambda row: out(OUTSIDE_M, row)),
            Observation(Cause.FAR_OUTSIDE, where.flyaway & self._flies, lambda row: out(cut, row)),
        ]

    def _measured(self, state: BodyState, rows: RowStatus, seen: list[Observation]) -> None:
        """What the body itself says."""
        limits = self._limits
        squared = np.vecdot(state.velocity, state.velocity)
        moving = not every(squared < self._slow_squared)
        if moving and some(fast := squared > self._fastest_squared):
            speed = norm(state.velocity)
            seen.append(
                Observation(
                    Cause.OVERSPEED, fast, lambda row: f"{speed[row]:.2f} m/s (limit {self._fastest[row]:.2f} m/s)"
                )
            )
        low = state.battery < limits.battery_low
        if some(low):
            seen.append(
                Observation(
                    Cause.BATTERY, low, lambda row: f"{state.battery[row]:.0%} (limit {limits.battery_low:.0%})"
                )
            )
        if state.flying.tobytes() != self._all_fly and some(fallen := (self._flies > state.flying) & rows.cruising):
            seen.append(Observation(Cause.FALLEN, fallen, lambda _: "its motors are off"))
        if moving and some(sinks := (state.velocity[:, 2] < -SINKS) & rows.cruising & self._flies):
            short = rows.goal_height - state.position[:, 2]
            if some(sinks := sinks & (short > SUNK)):
                text = "{:.2f} m below its goal, and sinks at {:.2f} m/s"
                seen.append(
                    Observation(Cause.SINKING, sinks, lambda row: text.format(short[row], -state.velocity[row, 2]))
                )
        if state.ahead is not None and some(off := clock_off(state.ahead, limits.own_silence_s)):
            seen.append(Observation(Cause.CLOCK, off, partial(clock_text, self._assignment.names, state.ahead)))
        if state.attitude is not None:
            leans = tilted(state.attitude, limits.tilt)
            if some(leans) and some(leans := leans & self._flies & state.flying):
                attitude = state.attitude
                seen.append(
                    Observation(
                        Cause.TILT,
                        leans,
                        lambda row: (
                            f"it leans {degrees(tilt_angle(attitude, row)):.0f}° (limit {degrees(limits.tilt):.0f}°)"
                        ),
                    )
                )
        if some(rows.landing):
            late = rows.landing & self._flies & state.flying
            seen.append(Observation(Cause.LANDING, late, lambda _: f"more than {limits.landing_s:g} s"))
            if some(rows.landing_places.aside):
                seen.append(Observation(Cause.BELOW, rows.landing_places.aside, rows.landing_places.robot_below))

    def _near(self, t: float, state: BodyState, hearing: NeighbourStates, seen: list[Observation]) -> None:
        """Other robots, where they are believed to be."""
        limit = self._limits.separation
        assert limit is not None
        apart = self._separation.distances(t, state.position, hearing)
        near = apart < limit
        if not some(near):
            return

        def say(row: int) -> str:
            distance, other = self._separation.nearest_robot(row, apart)
            return f"{distance:.2f} m from {other} (limit {limit:g} m)"

        inner = apart < np.maximum(0.5 * limit, self._separation.touching)
        seen.append(Observation(Cause.SEPARATION, self._separation.receivers_of(near), say))
        seen.append(Observation(Cause.TOUCHING, self._separation.receivers_of(inner), say))

    def _missed(self, t: float, hearing: NeighbourStates, rows: RowStatus, seen: list[Observation]) -> None:
        """Neighbours that are gone."""
        links, assignment = self._assignment.links, self._assignment
        since = hearing.poses.lost_since
        gone = self._lawful & np.isfinite(since) & (t - since > self._limits.link_silence_s)

        def names(row: int) -> str:
            return ", ".join(assignment.robots[s] for s in links.sender[gone & (links.receiver == row)].tolist())

        if some(gone):
            without = np.zeros(len(self._flies), dtype=bool)
            without[links.receiver[gone]] = True
            seen.append(Observation(Cause.NEIGHBOUR, without & rows.cruising, names))
        if rows.without_neighbours is not None and some(rows.without_neighbours):
            seen.append(
                Observation(
                    Cause.ALONE, rows.without_neighbours & rows.cruising, lambda row: names(row) or "none was heard"
                )
            )

    def _behind(self, hearing: NeighbourStates, behind: Array, seen: list[Observation]) -> None:
        """Neighbours whose clocks are behind."""
        links = self._assignment.links
        late = (behind > 0.0) & (hearing.poses.lost_since == np.inf)

        def names(row: int) -> str:
            mine = np.flatnonzero(late & (links.receiver == row))
            return ", ".join(
                f"the poses of {self._assignment.robots[links.sender[link]]} are "
                f"{behind[link]:.1f} s old when they arrive"
                for link in mine.tolist()
            )

        if some(late):
            rows = np.zeros(len(self._flies), dtype=bool)
            rows[links.receiver[late]] = True
            seen.append(Observation(Cause.BEHIND, rows, names))

    def _surroundings(self, t: float, outside: ProcessHealth, seen: list[Observation]) -> None:
        """The process, and who is on the network."""
        everybody = self._everybody
        if outside.offline_since < np.inf:
            gone = t - outside.offline_since
            seen.append(Observation(Cause.ROUTER, everybody, lambda _: f"for {gone:.1f} s"))
        elif outside.conductor_lost_since < np.inf:
            since = t - outside.conductor_lost_since
            seen.append(Observation(Cause.CONDUCTOR, everybody, lambda _: f"for {since:.1f} s"))
        if outside.loop_failing:
            seen.append(
                Observation(Cause.LATE, everybody, lambda _: f"{outside.missed_share:.0%} of the last second's")
            )


def clock_off(ahead: Array, silence_s: float) -> Mask:
    """Rows whose positions come from a clock that is off; `ahead` (N,) as in `BodyState`, blind after `silence_s`."""
    return np.asarray((ahead > AHEAD_S) | (ahead < -BEHIND * silence_s))


def clock_text(names: Sequence[str], ahead: Array, row: int) -> str:
    """How far off the stamps of a row's positions are, in words; `ahead` (N,) as in `BodyState`."""
    seconds = float(ahead[row])
    return f"positions of {names[row]} are stamped {abs(seconds):.3g} s {'ahead' if seconds > 0.0 else 'behind'}"


def tilted(attitude: Array, limit: float) -> Mask:
    """Rows that lean more than `limit` [rad]; `attitude` (N, 4) as in `BodyState`, unknown ones do not."""
    around = attitude[:, 1:3]  # a turn about the vertical has neither; sin² of half the angle, else
    return np.asarray(np.vecdot(around, around) > sin(0.5 * limit) ** 2)


def tilt_angle(attitude: Array, row: int) -> float:
    """How far a row leans [rad]: the angle between its own upward axis and the room's."""
    _, x, y, _ = attitude[row].tolist()
    return 2.0 * asin(min(1.0, hypot(x, y)))
