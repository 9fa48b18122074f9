"""Perception: things near rows, from their own range readings and from received poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from agents.arrays import Array, Columns, Index, Mask, clamp, every, some
from agents.body.interface import BodyState, Rays
from agents.body.kinds import Kind
from agents.decision.assignment import Assignment
from agents.network.validation import MAX_SPEED
from agents.plugins.avoidance import Nearby, OwnState

if TYPE_CHECKING:
    from agents.decision.neighbours import NeighbourPoses

REACH: Final = 3.0  # [m] between axes; farther things are ignored
AHEAD_S: Final = 0.1  # received positions are extrapolated for this long: a silent robot may have stopped
BELIEVED_S: Final = 0.5  # and received velocities are used for this long
SCAN_S: Final = 1.0  # readings older than this are dropped
DESCENT: Final = 0.1  # [m/s] a robot that sinks faster may be landing,
DESCENT_S: Final = 2.0  # and is in the way wherever it can be within this time
OUTLINE: Final = 0.05  # [m] a reading that ends this near to a received robot has hit that robot,
OUTLINE_SHARE: Final = 0.05  # and this share of its length, as long ones are measured worse
INSIDE: Final = 0.5  # share of its radius: a shorter reading of a robot is none
STEEP: Final = 0.5  # cosine of the elevation above which a ray looks up or down, not around


class Perception:
    """Collects the inputs of `Avoidance`."""

    def __init__(self, assignment: Assignment) -> None:
        assert assignment.avoidance is not None
        kinds, robot_kinds, links = assignment.kinds, assignment.robot_kinds, assignment.links
        self._limits, self._avoids = assignment.limits, assignment.avoids
        self._clearance = assignment.avoidance.clearance  # things farther above or below are ignored [m]
        self._takes = tuple(kind.takes for kind in kinds)
        takes = np.array(self._takes)
        self._by_position, self._by_twist = takes == "position", takes == "twist"
        self._radius, self._height = _column(kinds, "radius"), _column(kinds, "height")
        self._speed = np.minimum(_column(kinds, "speed"), self._limits.top_speed)
        self._turn_rate, self._response = _column(kinds, "turn_rate"), _column(kinds, "response")
        self._lag = _column(kinds, "lag")
        self._flies = np.array([kind.flies for kind in kinds], dtype=bool)
        self._receiver = links.receiver
        senders = [robot_kinds[sender] for sender in links.sender.tolist()]
        self._their_radius, self._their_lag = _column(senders, "radius"), _column(senders, "lag")
        self._their_height = _column(senders, "height")
        self._rays: Rays | None = None
        self._points = _no_points()

    def sense(self, t: float, state: BodyState, poses: NeighbourPoses) -> tuple[OwnState, Nearby]:
        """Own state and near things of the rows at `t` [s].

        Rows whose own position is missing or old get no things. A received robot is extrapolated with its velocity; a
        range reading on a received robot is not counted a second time.
        """
        velocity = state.velocity
        if not every(known := np.abs(velocity) <= MAX_SPEED):  # diverged estimator, or NaN
            velocity = np.where(known, velocity, 0.0)
        own = OwnState(
            state.position, velocity, state.yaw, self._radius, self._height, self._speed, self._turn_rate,
            self._response, self._lag, self._takes, self._by_position, self._by_twist, self._flies,
        )  # fmt: skip
        aware = np.isfinite(state.yaw) & (t - state.time <= self._limits.own_silence_s)
        if self._avoids is not None:
            aware &= self._avoids
        near = self._nearby_robots(t, state, poses, aware)
        if state.rays is not self._rays:
            self._update_points(state, poses)
        if state.rays is not None:
            near = near.append(self._near_points(t, state, aware))
        return own, near

    def _nearby_robots(self, t: float, state: BodyState, poses: NeighbourPoses, aware: Mask) -> Nearby:
        """Received robots that are near; lost ones stay at their last received place."""
        row = self._receiver
        age = np.maximum(t - poses.stamp, 0.0)
        position = poses.position + poses.velocity * np.minimum(age, AHEAD_S)[:, None]
        apart = state.position[row] - position
        near = (np.vecdot(apart[:, :2], apart[:, :2]) <= REACH**2) & aware[row]
        # a lost drone still hovers, has landed, or falls: it is in the way from the floor up
        lost = (t - poses.lost_since > self._limits.link_silence_s) | (poses.stamp == -np.inf)
        sinking = np.where((poses.velocity[:, 2] < -DESCENT) & (age <= BELIEVED_S), poses.velocity[:, 2], 0.0)
        low = position[:, 2] + DESCENT_S * sinking
        # their lower end under the own upper one, and the other way round; `apart` is the own height above them
        near &= (state.position[row, 2] + self._height[row] + self._clearance > low) | lost
        near &= apart[:, 2] - self._their_height - self._clearance < 0.0
        which = np.flatnonzero(near)
        z, believed = position[which, 2], age[which] <= BELIEVED_S
        return Nearby(
            row[which],
            position[which, :2],
            np.where(believed[:, None], poses.velocity[which, :2], 0.0),
            self._their_radius[which],
            np.where(lost[which], np.minimum(z, 0.0), low[which]),
            z + self._their_height[which],
            np.ones(len(which), dtype=bool),
            self._their_lag[which],
        )

    def _update_points(self, state: BodyState, poses: NeighbourPoses) -> None:
        """Update the end points of new range readings, by the pose of the robot at their measurement."""
        before, rays = self._rays, state.rays
        self._rays = rays
        if rays is None:
            self._points = _no_points()
            return
        fresh = np.ones(len(rays.row), dtype=bool)
        if before is not None and len(before.time) == len(rays.time) and (before.row == rays.row).all():
            fresh = rays.time != before.time
            if not some(fresh):
                return
        found = self._ends(rays, fresh, state)
        found = found.take(~self._known(found, poses, state.position))
        if not every(fresh):
            found = _Points.joined([self._points.take(~fresh[self._points.ray]), found])
            found = found.take(np.argsort(found.ray))  # in the order of the readings
        self._points = found

    def _ends(self, rays: Rays, fresh: Mask, state: BodyState) -> _Points:
        """End points of the fresh readings that hit something near."""
        # NaN: nothing was hit; nothing is inside the robot either
        hit = fresh & (rays.distance <= REACH) & (rays.distance > INSIDE * self._radius[rays.row])
        # one point that is not finite would spoil the sum over all things near its row
        hit &= np.isfinite(rays.bearing) & np.isfinite(rays.elevation)
        hit &= np.isfinite(state.position[rays.row]).all(axis=1) & np.isfinite(state.yaw[rays.row])
        flat = np.cos(np.where(hit, rays.elevation, 0.0))
        ray = np.flatnonzero(hit & (flat > STEEP))
        row, distance, time = rays.row[ray], rays.distance[ray], rays.time[ray]
        then = clamp(state.time[row] - time, 0.0, SCAN_S)[:, None]
        velocity = np.where(np.isfinite(state.velocity), state.velocity, 0.0)
        eye = state.position[row] - velocity[row] * then
        bearing = state.yaw[row] + rays.bearing[ray]
        out = distance * flat[ray]
        place = eye[:, :2] + out[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        height = eye[:, 2] + 0.5 * self._height[row] + distance * np.sin(rays.elevation[ray])
        return _Points(ray, row, time, distance, place, height)

    def _known(self, found: _Points, poses: NeighbourPoses, position: Array) -> Mask:
        """Points (P,) that lie on a received robot, for rows at `position` (N, 3)."""
        known = np.zeros(len(found.ray), dtype=bool)
        if not len(found.ray) or not len(self._receiver):
            return known
        order = np.argsort(found.row, kind="stable")
        begin = np.searchsorted(found.row, self._receiver, side="left", sorter=order)
        count = np.searchsorted(found.row, self._receiver, side="right", sorter=order) - begin
        apart = poses.position[:, :2] - position[self._receiver, :2]
        count[~(np.vecdot(apart, apart) <= (REACH + 1.0) ** 2)] = 0  # never received: NaN
        link = np.repeat(np.arange(len(count)), count)
        point = order[np.arange(len(link)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)]
        late = clamp(found.time[point] - poses.stamp[link], 0.0, AHEAD_S)[:, None]
        place = poses.position[link] + poses.velocity[link] * late
        apart = found.place[point] - place[:, :2]
        outline = self._their_radius[link] + OUTLINE + OUTLINE_SHARE * found.distance[point]
        up = found.height[point] - place[:, 2]
        beside = (up > -OUTLINE) & (up < self._their_height[link] + OUTLINE)
        known[point[(np.vecdot(apart, apart) <= outline**2) & beside]] = True
        return known

    def _near_points(self, t: float, state: BodyState, aware: Mask) -> Nearby:
        points = self._points
        row = points.row
        up = points.height - state.position[row, 2]
        near = (up < self._height[row] + self._clearance) & (up > -self._clearance)
        near &= aware[row] & (t - points.time <= SCAN_S)
        if not every(near):
            points = points.take(near)
        many = len(points.ray)
        nothing = np.zeros(many)
        return Nearby(
            points.row, points.place, np.zeros((many, 2)), nothing, points.height, points.height,
            np.zeros(many, dtype=bool), nothing,
        )  # fmt: skip


class _Points(Columns, frozen=True):
    """End points of range readings in the room (P)."""

    ray: Index  # (P,) number of the reading
    row: Index  # (P,)
    time: Array  # (P,) [s]
    distance: Array  # (P,) [m]
    place: Array  # (P, 2) [m]
    height: Array  # (P,) [m]


def _no_points() -> _Points:
    none, no_row = np.zeros(0), np.zeros(0, dtype=np.intp)
    return _Points(no_row, no_row, none, none, np.zeros((0, 2)), none)


def _column(kinds: Sequence[Kind], name: str) -> Array:
    return np.array([getattr(kind, name) for kind in kinds], dtype=float)
