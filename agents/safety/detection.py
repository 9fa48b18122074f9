"""Detection of hazards: the causes of `agents.safety.hazards` that are present on a tick. Pure and row-wise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from math import asin, degrees, hypot, sin
from typing import Final

import msgspec
import numpy as np

from agents.arrays import Array, Index, Mask, clamp, every, norm, some
from agents.body.interface import BodyState, Rays
from agents.body.kinds import Kind
from agents.decision.assignment import Assignment
from agents.decision.neighbours import NeighbourStates
from agents.decision.perception import SCAN_S
from agents.safety.hazards import Cause, Observation
from agents.safety.landing import LOW, SLOW, Landing
from agents.safety.obedience import RUSH_S, Obedience
from agents.safety.setpoint_filter import OUTSIDE_M
from agents.safety.situation import ProcessHealth, Situation


class Separation:
    """Distances on all links (E) of rows to the senders, whether used by the law or only by avoidance."""

    def __init__(self, assignment: Assignment) -> None:
        self._assignment, links = assignment, assignment.links
        own = np.array([kind.radius for kind in assignment.kinds])
        theirs = np.array([kind.radius for kind in assignment.robot_kinds])
        # (E,) distance of the axes at which two upright robots side by side touch [m]
        self.touching = own[links.receiver] + (theirs[links.sender] if len(theirs) else 0.0)

    def distances(self, t: float, position: Array, neighbours: NeighbourStates) -> Array:
        """Distances (E,) [m] from rows at `position` (N, 3) to the extrapolated senders at `t` [s].

        Infinite where nothing was received, the own position is unknown, or the sender is lost for long, or restarted
        and without a pose since.
        """
        assignment, poses = self._assignment, neighbours.poses
        believed = neighbours.extrapolate_all(assignment.predictor, t)
        apart = norm(position[assignment.links.receiver] - believed)
        there = np.isfinite(apart) & np.isfinite(poses.stamp)
        there &= t - poses.lost_since <= assignment.limits.link_silence_s
        return np.where(there, apart, np.inf)

    def nearest_robot(self, row: int, distances: Array) -> tuple[float, str]:
        """Distance of the nearest robot from a row [m], and its name."""
        links = self._assignment.links
        mine: Index = np.flatnonzero(links.receiver == row)
        at = int(mine[distances[mine].argmin()])
        return float(distances[at]), self._assignment.robots[links.sender[at]]


SUNK: Final = 0.15  # [m] below its goal
SLOWEST: Final = 0.2  # [m/s] no device lands more slowly,
CREEPS: Final = 0.025  # [m/s] or more slowly than this for
STEP: Final = 0.05  # [m]
STALLS_S: Final = 4.0  # a climb without that much more height for this long does not follow; one of
STALLS_VELOCITY_S: Final = 10.0  # a device that is told velocities, and may need a second order to take off
SINKS: Final = 0.15  # [m/s] and downward: the row does not fly to its goal
AHEAD_S: Final = 0.1  # no network here is later than this: stamps further ahead come from a clock that is ahead
FOREIGN_S: Final = 0.5  # a gap in the poses from another source does not end their hazard before
NOT_UNIT: Final = 0.1  # quaternions whose squared norm is further than this from 1 are no attitude
BEHIND: Final = 0.5  # share of the age at which a position is invalid: stamps this far behind give a warning


class RowStatus(msgspec.Struct, frozen=True):
    """Status of rows (N,) in the experiment on a tick, for `Detector.detect`."""

    ordered: Mask  # hold by order
    cruising: Mask  # at their height or running: their setpoints are followed
    climbing: Mask | None  # on their way up; None: no row is
    landing: Mask  # descending
    without_neighbours: Mask | None  # the law has no input; None: nowhere
    unguided: Mask | None  # running without guidance; None: no row is guided
    goal_stamp: Array | None  # decision time of the goals of guided rows [s], −inf for others; None: no row is guided
    unstarted: Mask  # on their way up, or in the air, without a start order
    goal_height: Array  # [m]
    setpoint: Array  # (N, 4) of the tick before, NaN for rows that their bodies drive by themselves
    not_finite: Mask  # the last setpoint was not finite
    landing_places: Landing  # of rows that land


class Ascent:
    """Progress of N rows that climb: straight up, as their bodies do by themselves.

    A row whose measured height does not follow flies by a wrong one, higher and higher: its markers lie on the floor.
    """

    def __init__(self, kinds: Sequence[Kind], hover: Array) -> None:
        """Of rows of these kinds that climb to `hover` (N,) [m]."""
        self._climbing: Mask = np.zeros(len(kinds), dtype=bool)
        self._begin = np.full((len(kinds), 2), np.nan)
        self._free = RUSH_S * np.array([kind.speed for kind in kinds]) + np.array([kind.radius for kind in kinds])
        self.aside = np.zeros(len(kinds))  # (N,) distance from there, seen from above [m]
        self.carried: Mask = self._climbing  # (N,) rows that are carried aside
        self._hover = hover
        self._patience = np.where([kind.takes == "velocity" for kind in kinds], STALLS_VELOCITY_S, STALLS_S)
        self._highest, self._risen_at = np.zeros(len(kinds)), np.zeros(len(kinds))  # [m], [s]
        self.stalled: Mask = self._climbing  # (N,) rows that are measured to stay low
        self.amiss = False  # whether a row is carried aside or stays low

    def update(self, t: float, climbing: Mask, flying: Mask, position: Array) -> None:
        """Look at rows that are `climbing` and `flying` (N,) at `t` [s], at `position` (N, 3) [m]."""
        begins, self._climbing = climbing & ~self._climbing, climbing.copy()
        self._begin = np.where(begins[:, None], position[:, :2], self._begin)
        self.aside = norm(position[:, :2] - self._begin)
        self.carried = climbing & (self.aside > self._free)
        height = position[:, 2]
        rises = begins | ~flying | ~(height <= self._highest + STEP)
        self._highest = np.where(rises, height, self._highest)
        self._risen_at = np.where(rises, t, self._risen_at)
        self.stalled = climbing & (self._hover - height > SUNK) & (t - self._risen_at > self._patience)
        self.amiss = some(self.carried) or some(self.stalled)


class Descent:
    """Progress of N rows that land."""

    def __init__(self, rows: int, highest: float) -> None:
        """A row whose height is unknown is given the time for `highest` [m]."""
        self._highest = highest
        self._landing: Mask = np.zeros(rows, dtype=bool)
        self._due = np.zeros(rows)  # when they are down, at the slowest [s]
        self._lowest, self._lowered_at = np.zeros(rows), np.zeros(rows)  # [m], [s]

    def update(self, t: float, landing: Mask, valid: Mask, state: BodyState) -> tuple[Mask, Mask]:
        """Rows (N,) whose motors do no good, and rows that hover, of those that are `landing` with a `valid` pose.

        A row that comes down is given its time, and one that hovers level is never cut: it would fall.
        """
        height = state.position[:, 2]
        begins, self._landing = landing & ~self._landing, landing
        lower = begins | (valid & (height < self._lowest - STEP))
        self._lowest = np.where(lower, height, self._lowest)
        self._lowered_at = np.where(lower, t, self._lowered_at)
        self._due = np.where(begins, t + np.where(valid, height, self._highest) / SLOWEST, self._due)
        still = landing & (t - self._lowered_at > STEP / CREEPS)
        level = valid & (height > LOW) & (norm(state.velocity) < SLOW)
        return still & ~level & (t > self._due), still & level


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
        avoids = self._every_row if assignment.avoids is None else assignment.avoids
        self._avoids = avoids & (assignment.avoidance is not None)
        self._rays: Rays | None = None
        # (N,) time of the newest range readings [s]; infinity before the first, and of rows that do not avoid
        self._scanned = np.full(len(self._flies), np.inf)
        self._separation = Separation(assignment)
        self._obedience = Obedience(assignment.kinds)
        self._ascent = Ascent(assignment.kinds, assignment.hover)
        self._climbed: Mask | None = None
        self._none: Mask = ~self._every_row
        self._descent = Descent(len(self._flies), float(self._limits.high[2]))
        # (N,) rows that leaned on the tick before, and the time of the first sample of that [s]
        self._leaned, self._leans_since = self._none, np.zeros(len(self._flies))

    def detect(self, now: Situation, rows: RowStatus) -> list[Observation]:
        """Causes that are present."""
        state = now.state
        found = self._in_surroundings(now, rows)
        squared = np.vecdot(state.velocity, state.velocity)
        if not every(squared < self._slow_squared):
            found.append(self._moving(state, squared, rows))
        if some(low := state.battery < self._limits.battery_low) or state.flying.tobytes() != self._all_fly:
            found.append(self._spent(state, low, rows))
        if state.ahead is not None or state.attitude is not None or some(rows.landing):
            found.append(self._measured(now.t, state, rows, ~now.where.invalid))
        if some(rows.ordered) or some(rows.not_finite) or rows.unguided is not None:
            found.append(self._orders(rows))
        if state.heard is not None:
            found.append(self._silent_devices(now.t, state.heard))
        if state.rays is not self._rays:
            self._note_rays(state.rays)
        if some(unseeing := now.t - self._scanned > SCAN_S):
            found.append(self._silent_rays(now.t, unseeing & rows.cruising))
        watched = rows.cruising if now.where.all_valid else rows.cruising & ~now.where.invalid
        self._obedience.update(now.t, rows.setpoint, state.position, state.yaw, watched)
        if rows.climbing is not self._climbed:  # while no row climbs it is None
            self._climbed = rows.climbing
            climbing = self._none if rows.climbing is None else rows.climbing & self._flies
            self._ascent.update(now.t, climbing, state.flying, state.position)
        if some(self._obedience.still) or some(self._obedience.strays) or self._ascent.amiss:
            found.append(self._disobedient(self._obedience, self._ascent))
        if not now.where.all_valid:
            found.append(self._position_and_arena(now))
        if not found:  # as on most ticks
            return []
        return [each for each in chain.from_iterable(found) if some(each.rows)]

    def _in_surroundings(self, now: Situation, rows: RowStatus) -> list[Iterator[Observation]]:
        """Causes in other robots, the network and the process."""
        neighbours, health = now.neighbours, now.health
        found = []
        if self._limits.separation is not None:
            found.append(self._separation_of_robots(now, self._limits.separation))
        if neighbours.incomplete:
            found.append(self._lost_neighbours(now, rows))
        if neighbours.clock_lag is not None:
            found.append(self._lagging(neighbours, neighbours.clock_lag))
        if neighbours.refused:
            found.append(self._refused_poses(neighbours.refused))
        if now.t - neighbours.foreign_at < FOREIGN_S:
            found.append(self._foreign_poses(neighbours.foreign))
        if health.just_resumed(now.t):
            found.append(self._not_refreshed(now, rows))
        if health.troubled:
            found.append(self._surroundings(now.t, health, rows))
        return found

    def _receivers(self, links: Mask) -> Mask:
        """Rows (N,) that receive on `links` (E,)."""
        rows = np.zeros(len(self._flies), dtype=bool)
        rows[self._assignment.links.receiver[links]] = True
        return rows

    def _orders(self, rows: RowStatus) -> Iterator[Observation]:
        """Operator, decision and central controller."""
        yield Observation(Cause.ORDERED, rows.ordered, lambda _: "by an operator")
        yield Observation(Cause.SETPOINT, rows.not_finite & rows.cruising, lambda _: "not made of finite numbers")
        if rows.unguided is not None:
            yield Observation(Cause.CENTRE, rows.unguided, lambda _: "its centre is gone, or its goals are old")

    def _not_refreshed(self, now: Situation, rows: RowStatus) -> Iterator[Observation]:
        """Rows without a new pose of every alive neighbour, or a new goal, since the process was suspended."""
        poses, health = now.neighbours.poses, now.health
        silent = (poses.stamp < health.resumed_at) & np.isfinite(poses.stamp) & np.isinf(poses.lost_since)
        waits = self._receivers(silent)
        if rows.goal_stamp is not None:
            waits |= (rows.goal_stamp < health.resumed_at) & np.isfinite(rows.goal_stamp)
        text = f"for {health.suspended_s:.1f} s; it waits for its neighbours"
        yield Observation(Cause.STANDSTILL, waits, lambda _: text)

    def _position_and_arena(self, now: Situation) -> Iterator[Observation]:
        t, state, where, cut = now.t, now.state, now.where, self._limits.cut_outside

        def lost(row: int) -> str:
            if now.turned is not None and np.isfinite(now.turned[row]):
                return f"its yaw jumped by {now.turned[row]:.2f} rad"
            if now.jump is not None and np.isfinite(now.jump[row]):
                return f"it jumped by {now.jump[row]:.2f} m"
            if not np.isfinite(state.position[row]).all():
                return "none"
            age = t - state.time[row]
            return f"the last is {age:.2f} s old" if age >= 0.0 else f"it is stamped {-age:.3g} s ahead"

        def excess(limit: float, row: int) -> str:
            return f"{where.excess[row]:.2f} m outside (limit {limit:g} m)"

        yield Observation(Cause.POSITION, where.invalid, lost)
        yield Observation(Cause.MARGIN, where.outside_wall & ~where.outside, partial(excess, 0.0))
        yield Observation(Cause.OUTSIDE, where.outside, partial(excess, OUTSIDE_M))
        yield Observation(Cause.FAR_OUTSIDE, where.flyaway & self._flies, partial(excess, cut))

    def _measured(self, t: float, state: BodyState, rows: RowStatus, valid: Mask) -> Iterator[Observation]:
        """Clock, tilt and landing, as the body measures them."""
        limits = self._limits
        if state.ahead is not None:
            off = clock_off(state.ahead, limits.own_silence_s)
            yield Observation(Cause.CLOCK, off, partial(clock_text, self._assignment.names, state.ahead))
        if state.attitude is not None:
            attitude, leans = state.attitude, self._leaning(state, state.attitude)
            lean = f"it leans {{:.0f}}° (limit {degrees(limits.tilt):.0f}°)"
            yield Observation(Cause.TILT, leans, lambda row: lean.format(degrees(tilt_angle(attitude, row))))
        if some(rows.landing):
            late, hovers = self._descent.update(t, rows.landing & self._flies & state.flying, valid, state)
            yield Observation(Cause.LANDING, late, lambda _: f"more than {limits.landing_s:g} s without a descent")
            yield Observation(Cause.HOVERING, hovers, lambda row: f"at {state.position[row, 2]:.2f} m")
            yield Observation(Cause.BELOW, rows.landing_places.aside, rows.landing_places.robot_below)

    def _leaning(self, state: BodyState, attitude: Array) -> Mask:
        """Rows (N,) that lean, by a first sample or a newer one: the first one alone, repeated, proves nothing."""
        leans = tilted(attitude, self._limits.tilt) & self._flies & state.flying
        begins, self._leaned = leans & ~self._leaned, leans
        self._leans_since = np.where(begins, state.time, self._leans_since)
        return np.asarray(leans & (begins | (state.time > self._leans_since)))

    def _spent(self, state: BodyState, low: Mask, rows: RowStatus) -> Iterator[Observation]:
        """Battery, which is `low` (N,), and motors."""
        limit = self._limits.battery_low
        yield Observation(Cause.BATTERY, low, lambda row: f"{state.battery[row]:.0%} (limit {limit:.0%})")
        fallen = (self._flies > state.flying) & rows.cruising
        yield Observation(Cause.FALLEN, fallen, lambda _: "its motors are off")

    def _moving(self, state: BodyState, squared: Array, rows: RowStatus) -> Iterator[Observation]:
        """Speed and sinking, of rows that move."""
        speed, short = np.sqrt(squared), rows.goal_height - state.position[:, 2]
        yield Observation(
            Cause.OVERSPEED,
            squared > self._fastest_squared,
            lambda row: f"{speed[row]:.2f} m/s (limit {self._fastest[row]:.2f} m/s)",
        )
        sinks = (state.velocity[:, 2] < -SINKS) & rows.cruising & self._flies & (short > SUNK)
        text = "{:.2f} m below its goal, and sinks at {:.2f} m/s"
        yield Observation(Cause.SINKING, sinks, lambda row: text.format(short[row], -state.velocity[row, 2]))

    def _silent_devices(self, t: float, heard: Array) -> Iterator[Observation]:
        silent = t - heard > self._limits.own_silence_s
        yield Observation(Cause.UNREACHABLE, silent, lambda row: f"for {t - heard[row]:.1f} s")

    def _note_rays(self, rays: Rays | None) -> None:
        """Note the time of the newest readings of rows that avoid by them."""
        self._rays = rays
        if rays is not None:
            newest = np.full(len(self._flies), -np.inf)
            np.maximum.at(newest, rays.row, rays.time)
            self._scanned = np.where(np.isfinite(newest) & self._avoids, newest, self._scanned)

    def _silent_rays(self, t: float, rows: Mask) -> Iterator[Observation]:
        yield Observation(Cause.UNSEEING, rows, lambda row: f"for {t - self._scanned[row]:.1f} s")

    def _disobedient(self, obedience: Obedience, ascent: Ascent) -> Iterator[Observation]:
        """Rows that do not move as they are told, or move otherwise."""

        def astray(row: int) -> str:
            if ascent.carried[row]:
                return f"{ascent.aside[row]:.2f} m aside while it climbs"
            return f"{obedience.strayed[row]:.2f} m lately"

        def still(row: int) -> str:
            return "it does not rise" if ascent.stalled[row] else f"told {obedience.told[row]:.2f} m in vain"

        yield Observation(Cause.STILL, obedience.still | ascent.stalled, still)
        yield Observation(Cause.STRAYING, obedience.strays | ascent.carried, astray)

    def _separation_of_robots(self, now: Situation, limit: float) -> Iterator[Observation]:
        apart = self._separation.distances(now.t, now.state.position, now.neighbours)
        near = apart < limit
        if not some(near):
            return

        def detail(row: int) -> str:
            distance, other = self._separation.nearest_robot(row, apart)
            return f"{distance:.2f} m from {other} (limit {limit:g} m)"

        inner = apart < np.maximum(0.5 * limit, self._separation.touching)
        yield Observation(Cause.SEPARATION, self._receivers(near), detail)
        yield Observation(Cause.TOUCHING, self._receivers(inner), detail)

    def _lost_neighbours(self, now: Situation, rows: RowStatus) -> Iterator[Observation]:
        links, robots = self._assignment.links, self._assignment.robots
        since = now.neighbours.poses.lost_since
        lost = self._in_law & np.isfinite(since) & (now.t - since > self._limits.link_silence_s)

        def names(row: int) -> str:
            return ", ".join(robots[sender] for sender in links.sender[lost & (links.receiver == row)].tolist())

        yield Observation(Cause.NEIGHBOUR, self._receivers(lost) & rows.cruising, names)
        if rows.without_neighbours is not None:
            alone = rows.without_neighbours & rows.cruising
            yield Observation(Cause.ALONE, alone, lambda row: names(row) or "none was received")

    def _lagging(self, neighbours: NeighbourStates, behind: Array) -> Iterator[Observation]:
        links, robots = self._assignment.links, self._assignment.robots
        late = (behind > 0.0) & (neighbours.poses.lost_since == np.inf)

        def names(row: int) -> str:
            return ", ".join(
                f"the poses of {robots[links.sender[link]]} are {behind[link]:.1f} s old when they arrive"
                for link in np.flatnonzero(late & (links.receiver == row)).tolist()
            )

        yield Observation(Cause.BEHIND, self._receivers(late), names)

    def _refused_poses(self, refused: Mapping[int, str]) -> Iterator[Observation]:
        yield self._of_senders(Cause.REFUSED, {link: f"{{}}: {reason}" for link, reason in refused.items()})

    def _foreign_poses(self, foreign: Mapping[int, int]) -> Iterator[Observation]:
        text = "{} poses of {{}} came from another source, and were not used"
        yield self._of_senders(Cause.FOREIGN, {link: text.format(count) for link, count in foreign.items()})

    def _of_senders(self, cause: Cause, texts: Mapping[int, str]) -> Observation:
        """A cause in the senders on some links, each with its text, in which the name is left open."""
        links, robots = self._assignment.links, self._assignment.robots
        there = np.zeros(len(links), dtype=bool)
        there[list(texts)] = True

        def detail(row: int) -> str:
            of_row = np.flatnonzero(there & (links.receiver == row)).tolist()
            return ", ".join(texts[link].replace("{}", robots[links.sender[link]]) for link in of_row)

        return Observation(cause, self._receivers(there), detail)

    def _surroundings(self, t: float, health: ProcessHealth, rows: RowStatus) -> Iterator[Observation]:
        """Router, conductor and control loop."""
        if health.offline_since < np.inf:
            yield Observation(Cause.ROUTER, self._every_row, lambda _: f"for {t - health.offline_since:.1f} s")
        elif health.conductor_lost_since < np.inf:
            since = t - health.conductor_lost_since
            yield Observation(Cause.CONDUCTOR, self._every_row, lambda _: f"for {since:.1f} s")
            yield Observation(Cause.UNSTARTED, rows.unstarted, lambda _: f"the conductor is gone for {since:.1f} s")
        if health.loop_failing:
            text = f"{health.missed_share:.0%} of the last second's"
            yield Observation(Cause.LATE, self._every_row, lambda _: text)


def clock_off(ahead: Array, silence_s: float) -> Mask:
    """Rows whose positions come from a wrong clock; `ahead` (N,) as in `BodyState`, invalid after `silence_s`."""
    return np.asarray((ahead > AHEAD_S) | (ahead < -BEHIND * silence_s))


def clock_text(names: Sequence[str], ahead: Array, row: int) -> str:
    """Clock error of the positions of a row, in words; `ahead` (N,) as in `BodyState`."""
    seconds = float(ahead[row])
    return f"positions of {names[row]} are stamped {abs(seconds):.3g} s {'ahead' if seconds > 0.0 else 'behind'}"


def tilted(attitude: Array, limit: float) -> Mask:
    """Rows that lean more than `limit` [rad]; `attitude` (N, 4) as in `BodyState`, unknown ones do not."""
    squared = np.square(clamp(attitude, -2.0, 2.0))
    unit = np.abs(squared.sum(axis=1) - 1.0) < NOT_UNIT  # else it is no attitude
    # a turn about the vertical has neither of these; sin² of half the angle, else
    return np.asarray(unit & (squared[:, 1] + squared[:, 2] > sin(0.5 * limit) ** 2))


def tilt_angle(attitude: Array, row: int) -> float:
    """Angle [rad] between the upward axis of a row and that of the room."""
    _, x, y, _ = attitude[row].tolist()
    return 2.0 * asin(min(1.0, hypot(x, y)))
