"""What rows know of the things around them: from their own range readings, and from whom they hear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final

import numpy as np

from agents.arrays import Array, Index, Mask, clamp, every, some
from agents.body.interface import BodyState, Rays
from agents.body.kinds import Kind
from agents.body.limits import Limits
from agents.formation.graph import Links
from agents.network.validation import MAX_SPEED
from agents.plugins.avoidance import Nearby, OwnState

if TYPE_CHECKING:
    from agents.decision.neighbours import NeighbourPoses

REACH: Final = 3.0  # [m] between axes; what is farther away is nobody's concern yet
AHEAD_S: Final = 0.1  # heard positions are carried on for so long: who is silent for longer may as well have stopped
BELIEVED_S: Final = 0.5  # and so long a heard velocity is believed
SCAN_S: Final = 1.0  # readings older than this are none
DESCENT: Final = 0.1  # [m/s] who sinks faster than this may be coming down,
DESCENT_S: Final = 2.0  # and is in the way wherever it can be within so long
OUTLINE: Final = 0.05  # [m] a ray that ends this near to a robot that was heard has seen that robot,
OUTLINE_SHARE: Final = 0.05  # and this share of its length, as long ones are measured worse
STEEP: Final = 0.5  # cosine of the elevation above which a ray looks up or down, not around


class Perception:
    """Puts together what `Avoidance` decides on."""

    def __init__(  # noqa: PLR0917
        self,
        kinds: Sequence[Kind],
        speaker_kinds: Sequence[Kind],
        links: Links,
        limits: Limits,
        clearance: float,
        avoids: Mask | None = None,
    ) -> None:
        """Of rows of `kinds` that listen on `links`.

        Args:
            kinds: Of the rows (N).
            speaker_kinds: Of all robots of the experiment; `links.speaker` points here.
            links: On which the rows hear, for the formation or only for this (E).
            limits: Of safety: speed, and how long silence is borne.
            clearance: What is farther above or below than this is not seen [m].
            avoids: (N,) rows that keep clear at all; None: all.
        """
        self._limits, self._clearance, self._avoids = limits, clearance, avoids
        self._takes = tuple(kind.takes for kind in kinds)
        takes = np.array(self._takes)
        self._by_position, self._by_twist = takes == "position", takes == "twist"
        self._radius, self._height = _column(kinds, "radius"), _column(kinds, "height")
        self._speed = np.minimum(_column(kinds, "speed"), limits.top_speed)
        self._turn_rate, self._response = _column(kinds, "turn_rate"), _column(kinds, "response")
        self._lag = _column(kinds, "lag")
        self._flies = np.array([kind.flies for kind in kinds], dtype=bool)
        self._listener = links.receiver
        speaks = [speaker_kinds[speaker] for speaker in links.sender.tolist()]
        self._their_radius, self._their_lag = _column(speaks, "radius"), _column(speaks, "lag")
        self._their_height = _column(speaks, "height")
        self._rays: Rays | None = None
        self._points = _Points.nothing()

    def sense(self, t: float, state: BodyState, heard: NeighbourPoses) -> tuple[OwnState, Nearby]:
        """What rows know of themselves and of what is near at `t` [s].

        Rows whose own position is missing or old know of nothing. A robot that was heard is where it was then, carried
        on with its velocity; a ray that ended on one that was heard is not counted a second time.
        """
        velocity = state.velocity
        if not every(known := np.abs(velocity) <= MAX_SPEED):  # of an estimator that diverged, or not a number
            velocity = np.where(known, velocity, 0.0)
        own = OwnState(
            state.position, velocity, state.yaw, self._radius, self._height, self._speed, self._turn_rate,
            self._response, self._lag, self._takes, self._by_position, self._by_twist, self._flies,
        )  # fmt: skip
        aware = np.isfinite(state.yaw) & (t - state.time <= self._limits.own_silence_s)
        if self._avoids is not None:
            aware &= self._avoids
        near = self._others(t, state, heard, aware)
        if state.rays is not self._rays:
            self._look(state, heard)
        if state.rays is not None:
            near = near.append(self._seen(t, state, aware))
        return own, near

    def _others(self, t: float, state: BodyState, heard: NeighbourPoses, aware: Mask) -> Nearby:
        """The robots that were heard, where they are near; those that are gone stay where they were heard last."""
        row = self._listener
        age = np.maximum(t - heard.stamp, 0.0)
        position = heard.position + heard.velocity * np.minimum(age, AHEAD_S)[:, None]
        apart = state.position[row] - position
        near = (np.vecdot(apart[:, :2], apart[:, :2]) <= REACH**2) & aware[row]
        # who is gone hangs there still, has come down, or falls: it is in the way from the floor up
        lost = t - heard.lost_since > self._limits.link_silence_s
        sinking = np.where((heard.velocity[:, 2] < -DESCENT) & (age <= BELIEVED_S), heard.velocity[:, 2], 0.0)
        low = position[:, 2] + DESCENT_S * sinking
        # their lower end under my upper one, and the other way round; `apart` is how much higher I am
        near &= (state.position[row, 2] + self._height[row] + self._clearance > low) | lost
        near &= apart[:, 2] - self._their_height - self._clearance < 0.0
        which = np.flatnonzero(near)
        z, believed = position[which, 2], age[which] <= BELIEVED_S
        return Nearby(
            row[which],
            position[which, :2],
            np.where(believed[:, None], heard.velocity[which, :2], 0.0),
            self._their_radius[which],
            np.where(lost[which], np.minimum(z, 0.0), low[which]),
            z + self._their_height[which],
            np.ones(len(which), dtype=bool),
            self._their_lag[which],
        )

    def _look(self, state: BodyState, heard: NeighbourPoses) -> None:
        """Where in the room the rays ended that are new: by the pose that the robot had when they were measured."""
        before, rays = self._rays, state.rays
        self._rays = rays
        if rays is None:
            self._points = _Points.nothing()
            return
        fresh = np.ones(len(rays.row), dtype=bool)
        if before is not None and len(before.time) == len(rays.time) and (before.row == rays.row).all():
            fresh = rays.time != before.time
            if not some(fresh):
                return
        found = self._ends(rays, fresh, state)
        found = found.of(~self._known(found, heard, state.position))
        self._points = found if every(fresh) else self._points.of(~fresh[self._points.ray]).and_then(found)

    def _ends(self, rays: Rays, fresh: Mask, state: BodyState) -> _Points:
        """The ends of the fresh rays that hit something near."""
        hit = fresh & (rays.distance <= REACH)  # not a number: nothing was hit
        flat = np.cos(rays.elevation)
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

    def _known(self, found: _Points, heard: NeighbourPoses, position: Array) -> Mask:
        """Which points (P,) lie on a robot that was heard, for rows at `position` (N, 3)."""
        known = np.zeros(len(found.ray), dtype=bool)
        if not len(found.ray) or not len(self._listener):
            return known
        order = np.argsort(found.row, kind="stable")
        begin = np.searchsorted(found.row, self._listener, side="left", sorter=order)
        count = np.searchsorted(found.row, self._listener, side="right", sorter=order) - begin
        apart = heard.position[:, :2] - position[self._listener, :2]
        count[~(np.vecdot(apart, apart) <= (REACH + 1.0) ** 2)] = 0  # never heard: not a number
        link = np.repeat(np.arange(len(count)), count)
        point = order[np.arange(len(link)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)]
        late = clamp(found.time[point] - heard.stamp[link], 0.0, AHEAD_S)[:, None]
        place = heard.position[link] + heard.velocity[link] * late
        apart = found.place[point] - place[:, :2]
        outline = self._their_radius[link] + OUTLINE + OUTLINE_SHARE * found.distance[point]
        up = found.height[point] - place[:, 2]
        beside = (up > -OUTLINE) & (up < self._their_height[link] + OUTLINE)
        known[point[(np.vecdot(apart, apart) <= outline**2) & beside]] = True
        return known

    def _seen(self, t: float, state: BodyState, aware: Mask) -> Nearby:
        """What the rays ended on, where it is near."""
        points = self._points
        row = points.row
        up = points.height - state.position[row, 2]
        near = (up < self._height[row] + self._clearance) & (up > -self._clearance)
        near &= aware[row] & (t - points.time <= SCAN_S)
        if not every(near):
            points = points.of(near)
        many = len(points.ray)
        nothing = np.zeros(many)
        return Nearby(
            points.row, points.place, np.zeros((many, 2)), nothing, points.height, points.height,
            np.zeros(many, dtype=bool), nothing,
        )  # fmt: skip


@dataclass(frozen=True)
class _Points:
    """Ends of rays in the room (P): number of the ray, row, time [s], length [m], place (P, 2) and height [m]."""

    ray: Index
    row: Index
    time: Array
    distance: Array
    place: Array
    height: Array

    @classmethod
    def nothing(cls) -> _Points:
        none, nobody = np.zeros(0), np.zeros(0, dtype=np.intp)
        return cls(nobody, nobody, none, none, np.zeros((0, 2)), none)

    def of(self, which: Mask | Index) -> _Points:
        return _Points(*(getattr(self, field.name)[which] for field in fields(_Points)))

    def and_then(self, others: _Points) -> _Points:
        """These and others, sorted as the rays are."""
        pairs = ((getattr(self, field.name), getattr(others, field.name)) for field in fields(_Points))
        both = _Points(*(np.concatenate(pair) for pair in pairs))
        return both.of(np.argsort(both.ray))


def _column(kinds: Sequence[Kind], name: str) -> Array:
    return np.array([getattr(kind, name) for kind in kinds], dtype=float)
