"""Detection of hazards: the causes of `agents.safety.hazards` that are present on a tick. Pure and row-wise."""

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
from agents.safety.obedience import Obedience
from agents.safety.setpoint_filter import OUTSIDE_M, PoseValidity


class Separation:
    """Distances on all links (E) of rows to the senders, whether used by the law or only by avoidance."""

    touching: Array  # (E,) distance of the axes at which two upright robots side by side touch [m]

    def __init__(self, assignment: Assignment) -> None:
        self._assignment, links = assignment, assignment.links
        own = np.array([kind.radius for kind in assignment.kinds])
        theirs = np.array([kind.radius for kind in assignment.robot_kinds])
        self.touching = own[links.receiver] + (theirs[links.sender] if len(theirs) else 0.0)

    def distances(self, t: float, position: Array, neighbours: NeighbourStates) -> Array:
        """Distances (E,) [m] from rows at `position` (N, 3) to the extrapolated senders at `t` [s].

        Infinite where nothing was received, the own position is unknown, or the sender is lost for long.
        """
        assignment = self._assignment
        believed = neighbours.extrapolate_all(assignment.predictor, t)
        apart = norm(position[assignment.links.receiver] - believed)
        there = np.isfinite(apart) & (t - neighbours.poses.lost_since <= assignment.limits.link_silence_s)
        return np.where(there, apart, np.inf)

    def receivers_of(self, which: Mask) -> Mask:
        """Rows (N,) that receive on a link of `which` (E,)."""
        rows = np.zeros(len(self._assignment.names), dtype=bool)
        rows[self._assignment.links.receiver[which]] = True
        return rows

    def nearest_robot(self, row: int, distances: Array) -> tuple[float, str]:
        """Distance of the nearest robot from a row [m], and its name."""
        links = self._assignment.links
        mine: Index = np.flatnonzero(links.receiver == row)
        at = int(mine[distances[mine].argmin()])
        return float(distances[at]), self._assignment.robots[links.sender[at]]


SUNK: Final = 0.15  # [m] below its goal
SINKS: Final = 0.15  # [m/s] and downward: the row does not fly to its goal
AHEAD_S: Final = 0.1  # no network here is later than this: stamps further ahead come from a clock that is ahead
BEHIND: Final = 0.5  # share of the age at which a position is invalid: stamps this far behind give a warning
# a neighbour silent for this long after a suspension had nothing new: missed poses come with the next heartbeat of its
# publisher, 0.5 s after its last pose, or with the history that is requested after a reconnection
SILENT_S: Final = 1.0
LATE_WINDOW_S: Final = 1.0  # window in which missed ticks are counted
LATE_SHARE: Final = 0.9  # with a larger share of missed ticks the control loop fails


@dataclass
class ProcessHealth:
    """State of the process around a decision, set by the process."""

    offline_since: float = np.inf  # loss of the router [s]; infinity while connected
    conductor_lost_since: float = np.inf  # loss of the conductor [s]; infinity while alive, or never seen
    missed_share: float = 0.0  # of the last ticks, 0 to 1
    resumed_at: float = -np.inf  # end of the last suspension [s]
    suspended_s: float = 0.0  # its duration [s]
    connected_since: float = -np.inf  # begin of the connection to a router after it [s]

    def mark_resumed(self, t: float, slept: float) -> None:
        """The process resumed at `t` [s] after a suspension of `slept` [s]."""
        self.resumed_at, self.suspended_s, self.connected_since = t, slept, t

    def just_resumed(self, t: float) -> bool:
        """Whether poses missed in a suspension may still be on their way at `t` [s]; call it on every tick."""
        recent = t < self.connected_since + SILENT_S
        if recent and self.offline_since < np.inf:
            self.connected_since = t
        return recent

    @property
    def loop_failing(self) -> bool:
        """Whether the control loop misses so many ticks that it controls nothing."""
        return self.missed_share > LATE_SHARE

    def count_tick(self, missed: int, period: float) -> None:
        """Count a tick after `missed` ones that did not take place; they are `period` apart [s]."""
        if missed or self.missed_share > 0.0:
            forget = -expm1(-period * (1 + missed) / LATE_WINDOW_S)
            self.missed_share += forget * (missed / (1 + missed) - self.missed_share)
            if self.missed_share < 1e-3:
                self.missed_share = 0.0


class RowStatus(msgspec.Struct, frozen=True):
    """Status of rows (N,) in the experiment on a tick, for `Detector.detect`."""

    ordered: Mask  # hold by order
    cruising: Mask  # at their height or running: their setpoints are followed
    landing: Mask  # descending
    without_neighbours: Mask | None  # the law has no input; None: nowhere
    unguided: Mask | None  # running without guidance; None: no row is guided
    goal_stamp: Array | None  # decision time of the goals of guided rows [s], −inf for others; None: no row is guided
    goal_height: Array  # [m]
    setpoint: Array  # (N, 4) of the tick before, NaN for rows that their bodies drive by themselves
    not_finite: Mask  # the last setpoint was not finite
    landing_places: Landing  # of rows that land


class Detector:
    """Detects causes of hazards on N rows."""

    def __init__(self, assignment: Assignment) -> None:
        self._assignment, self._limits = assignment, assignment.limits
        self._flies = np.array([kind.flies for kind in assignment.kinds])
        self._every_row: Mask = np.ones(len(self._flies), dtype=bool)
        speed = np.array([kind.speed for kind in assignment.kinds])
        # the speed of flying kinds is per axis
        self._fastest = assignment.limits.overspeed * np.where(self._flies, np.sqrt(3.0), 1.0) * speed
        self._fastest_squared = self._fastest**2
        self._slow_squared = np.minimum(self._fastest_squared, SINKS**2)  # slower: neither sinks nor races
        self._all_fly = self._flies.tobytes()
        links, avoidance_only = assignment.links, assignment.avoidance_only
        self._in_law = np.ones(len(links), dtype=bool) if avoidance_only is None else ~avoidance_only
        self._separation = Separation(assignment)
        self._obedience = Obedience(assignment.kinds)

    def detect(  # noqa: PLR0917 - what there is to look at
        self,
        t: float,
        state: BodyState,
        where: PoseValidity,
        neighbours: NeighbourStates,
        rows: RowStatus,
        health: ProcessHealth,
    ) -> list[Observation]:
        """Causes present at `t` [s]."""
        seen: list[Observation] = []
        if not where.all_valid:
            self._outside(t, state, where, seen)
        if some(rows.ordered):
            seen.append(Observation(Cause.ORDERED, rows.ordered, lambda _: "by an operator"))
        if some(rows.not_finite):
            seen.append(
                Observation(Cause.SETPOINT, rows.not_finite & rows.cruising, lambda _: "not made of finite numbers")
            )
        self._measured(state, rows, seen)
        self._disobedient(t, state, where, rows, seen)
        if self._limits.separation is not None:
            self._near(t, state, neighbours, seen)
        if neighbours.incomplete:
            self._lost_neighbours(t, neighbours, rows, seen)
        if neighbours.clock_lag is not None:
            self._lagging(neighbours, neighbours.clock_lag, seen)
        if rows.unguided is not None and some(rows.unguided):
            seen.append(Observation(Cause.CENTRE, rows.unguided, lambda _: "its centre is gone, or its goals are old"))
        if health.just_resumed(t):
            self._not_refreshed(neighbours, rows, health, seen)
        self._surroundings(t, health, seen)
        return seen

    def _not_refreshed(
        self, neighbours: NeighbourStates, rows: RowStatus, health: ProcessHealth, seen: list[Observation]
    ) -> None:
        """Rows without a new pose of every alive neighbour, or a new goal, since the process was suspended."""
        poses, links = neighbours.poses, self._assignment.links
        silent = (poses.stamp < health.resumed_at) & np.isfinite(poses.stamp) & np.isinf(poses.lost_since)
        waits = np.zeros(len(self._flies), dtype=bool)
        waits[links.receiver[silent]] = True
        if rows.goal_stamp is not None:
            waits |= (rows.goal_stamp < health.resumed_at) & np.isfinite(rows.goal_stamp)
        if some(waits):
            seen.append(
                Observation(
                    Cause.STANDSTILL, waits, lambda _: f"for {health.suspended_s:.1f} s; it waits for its neighbours"
                )
            )

    def _outside(self, t: float, state: BodyState, where: PoseValidity, seen: list[Observation]) -> None:
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
        """Speed, battery, motors, sinking, clock, tilt and landing, as the body measures them."""
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

    def _disobedient(
        self, t: float, state: BodyState, where: PoseValidity, rows: RowStatus, seen: list[Observation]
    ) -> None:
        """Rows whose devices do not answer, that do not move as they are told, or move otherwise."""
        if state.heard is not None and some(gone := t - state.heard > self._limits.own_silence_s):
            heard = state.heard
            seen.append(Observation(Cause.UNREACHABLE, gone, lambda row: f"for {t - heard[row]:.1f} s"))
        obedience = self._obedience
        obedience.update(t, rows.setpoint, state.position, state.yaw, rows.cruising & ~where.invalid)
        if some(obedience.still):
            seen.append(
                Observation(Cause.STILL, obedience.still, lambda row: f"told {obedience.told[row]:.2f} m in vain")
            )
        if some(obedience.strays):
            seen.append(
                Observation(Cause.STRAYING, obedience.strays, lambda row: f"{obedience.strayed[row]:.2f} m lately")
            )

    def _near(self, t: float, state: BodyState, neighbours: NeighbourStates, seen: list[Observation]) -> None:
        """Separation from other robots at their extrapolated places."""
        limit = self._limits.separation
        assert limit is not None
        apart = self._separation.distances(t, state.position, neighbours)
        near = apart < limit
        if not some(near):
            return

        def detail(row: int) -> str:
            distance, other = self._separation.nearest_robot(row, apart)
            return f"{distance:.2f} m from {other} (limit {limit:g} m)"

        inner = apart < np.maximum(0.5 * limit, self._separation.touching)
        seen.append(Observation(Cause.SEPARATION, self._separation.receivers_of(near), detail))
        seen.append(Observation(Cause.TOUCHING, self._separation.receivers_of(inner), detail))

    def _lost_neighbours(self, t: float, neighbours: NeighbourStates, rows: RowStatus, seen: list[Observation]) -> None:
        """Lost neighbours."""
        links, assignment = self._assignment.links, self._assignment
        since = neighbours.poses.lost_since
        gone = self._in_law & np.isfinite(since) & (t - since > self._limits.link_silence_s)

        def names(row: int) -> str:
            return ", ".join(assignment.robots[s] for s in links.sender[gone & (links.receiver == row)].tolist())

        if some(gone):
            without = np.zeros(len(self._flies), dtype=bool)
            without[links.receiver[gone]] = True
            seen.append(Observation(Cause.NEIGHBOUR, without & rows.cruising, names))
        if rows.without_neighbours is not None and some(rows.without_neighbours):
            seen.append(
                Observation(
                    Cause.ALONE, rows.without_neighbours & rows.cruising, lambda row: names(row) or "none was received"
                )
            )

    def _lagging(self, neighbours: NeighbourStates, behind: Array, seen: list[Observation]) -> None:
        """Neighbours whose clocks lag."""
        links = self._assignment.links
        late = (behind > 0.0) & (neighbours.poses.lost_since == np.inf)

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

    def _surroundings(self, t: float, health: ProcessHealth, seen: list[Observation]) -> None:
        """Router, conductor and control loop."""
        every_row = self._every_row
        if health.offline_since < np.inf:
            gone = t - health.offline_since
            seen.append(Observation(Cause.ROUTER, every_row, lambda _: f"for {gone:.1f} s"))
        elif health.conductor_lost_since < np.inf:
            since = t - health.conductor_lost_since
            seen.append(Observation(Cause.CONDUCTOR, every_row, lambda _: f"for {since:.1f} s"))
        if health.loop_failing:
            seen.append(Observation(Cause.LATE, every_row, lambda _: f"{health.missed_share:.0%} of the last second's"))


def clock_off(ahead: Array, silence_s: float) -> Mask:
    """Rows whose positions come from a wrong clock; `ahead` (N,) as in `BodyState`, invalid after `silence_s`."""
    return np.asarray((ahead > AHEAD_S) | (ahead < -BEHIND * silence_s))


def clock_text(names: Sequence[str], ahead: Array, row: int) -> str:
    """Clock error of the positions of a row, in words; `ahead` (N,) as in `BodyState`."""
    seconds = float(ahead[row])
    return f"positions of {names[row]} are stamped {abs(seconds):.3g} s {'ahead' if seconds > 0.0 else 'behind'}"


def tilted(attitude: Array, limit: float) -> Mask:
    """Rows that lean more than `limit` [rad]; `attitude` (N, 4) as in `BodyState`, unknown ones do not."""
    around = attitude[:, 1:3]  # a turn about the vertical has neither; sin² of half the angle, else
    return np.asarray(np.vecdot(around, around) > sin(0.5 * limit) ** 2)


def tilt_angle(attitude: Array, row: int) -> float:
    """Angle [rad] between the upward axis of a row and that of the room."""
    _, x, y, _ = attitude[row].tolist()
    return 2.0 * asin(min(1.0, hypot(x, y)))
