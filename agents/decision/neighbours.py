"""What rows have heard of their neighbours, who takes part in the law, and where neighbours are believed to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.arrays import Array, Index, Mask, every, some
from agents.formation.graph import Links
from agents.plugins.predictors import HOLD, Predictor


@dataclass
class NeighbourPoses:
    """What was last heard on each link (E): positions and velocities (E, 3), sample and arrival times (E,) [s].

    A sample time is when the pose was measured as far as its stamp can be true, see `agents.runtime.pose_inbox.Said`.

    `gone` is the time since which the speaker is known to be dead, infinity while it lives, and minus infinity before
    its liveliness token was seen: a pose alone is no sign of life.
    """

    position: Array
    velocity: Array
    stamp: Array
    arrival: Array
    lost_since: Array

    @classmethod
    def none_received(cls, count: int) -> NeighbourPoses:
        """Before anything was heard."""
        never = np.full(count, -np.inf)
        return cls(np.full((count, 3), np.nan), np.zeros((count, 3)), never, never.copy(), never.copy())

    def extrapolate_position(self, predictor: Predictor, t: float, which: Index) -> Array:
        """Where (K, 3) [m] the speakers of links `which` (K,), all heard once, are believed to be at `t` [s]."""
        if predictor is HOLD:
            return self.position if len(which) == len(self.position) else self.position[which]
        position = self.position[which]
        return predictor.position(position, self.velocity[which], t - self.stamp[which])

    def extrapolate_velocity(self, predictor: Predictor, t: float, which: Index) -> Array:
        """How fast (K, 3) [m/s] these beliefs move."""
        return predictor.velocity(self.velocity[which], t - self.stamp[which])


class NeighbourStates:
    """The links on which rows listen.

    Attributes:
        poses: What was heard on each link (E).
        active: Links that take part in the law: heard once, the speaker lives or is not gone for long, not only for
            avoidance, and there at all in a formation whose links come and go.
        links: Those, with what they ask for now.
        clock_lag: (E,) age of poses on arrival [s] where clocks of senders are behind, else 0; None: none is.
        incomplete: Some speaker was never heard or is gone, so that time alone can change what is live.
    """

    def __init__(self, links: Links, watched: Mask | None, silence_s: float) -> None:
        """Before anything was heard.

        Args:
            links: All (E).
            watched: (E,) those that only avoidance needs; None: there are none.
            silence_s: A speaker that is gone for this long is left out [s].
        """
        self.poses = NeighbourPoses.none_received(len(links))
        self.incomplete = True
        self.clock_lag: Array | None = None
        self._all, self._watched, self._silence_s = links, watched, silence_s
        self._there: Mask = np.ones(len(links), dtype=bool) if watched is None else ~watched
        self._taking_part = self._heard_of = np.zeros(len(links), dtype=bool)
        self.active: Index = np.zeros(0, dtype=np.intp)
        self.links = links.select(self.active)

    def receive(self, at: Index, position: Array, velocity: Array, stamp: Array, arrived: Array) -> None:
        """Poses that arrived on links `at` (H,), in order of arrival; older samples than known are left out."""
        heard = self.poses
        if some(stamp[1:] < stamp[:-1]):  # of several on one link the newest stays, whichever came last
            order = np.argsort(stamp, kind="stable")
            at, position, velocity = at[order], position[order], velocity[order]
            stamp, arrived = stamp[order], arrived[order]
        newer = stamp > heard.stamp[at]
        if not every(newer):
            at, position, velocity = at[newer], position[newer], velocity[newer]
            stamp, arrived = stamp[newer], arrived[newer]
        heard.position[at], heard.velocity[at] = position, velocity
        heard.stamp[at], heard.arrival[at] = stamp, arrived

    def mark_lost(self, at: Index, t: float) -> None:
        """The tokens of the speakers of links `at` are gone since `t` [s]."""
        self.poses.lost_since[at] = np.minimum(self.poses.lost_since[at], t)
        self.incomplete = True

    def mark_alive(self, at: Index) -> None:
        """The tokens of the speakers of links `at` are there: these live, whether or not they have something to say."""
        self.poses.lost_since[at] = np.inf
        self.incomplete = True

    def discard_poses(self, at: Index) -> None:
        """The speakers of links `at` begin a new life: poses of the one before are of another robot."""
        heard = self.poses
        heard.position[at], heard.velocity[at] = np.nan, 0.0
        heard.stamp[at] = heard.arrival[at] = -np.inf
        self.incomplete = True

    def mark_clock_lag(self, at: Index, behind: float) -> None:
        """The clocks of the speakers of links `at` are behind, poses `behind` [s] old on arrival; 0: no longer."""
        age = np.zeros(len(self._all)) if self.clock_lag is None else self.clock_lag
        age[at] = behind
        self.clock_lag = age if age.any() else None

    @property
    def stamp_once_alive(self) -> Array:
        """(E,) time of the last sample on links whose speaker was there once [s]; minus infinity on the others."""
        return np.where(self.poses.lost_since == -np.inf, -np.inf, self.poses.stamp)

    def missing_senders(self, row: int) -> Index:
        """Speakers that a row has never heard, or that are gone."""
        lacks = ~np.isfinite(self.poses.stamp) | (self.poses.lost_since < np.inf)
        return np.asarray(self._all.sender[(self._all.receiver == row) & lacks])

    def update_active(self, t: float) -> Index:
        """Decides at `t` [s] which links are live; gives the rows for which that has changed."""
        heard = self.poses
        known, here = np.isfinite(heard.stamp), heard.lost_since == np.inf
        self.incomplete = not (known & here).all()
        self._heard_of = known & (t - heard.lost_since <= self._silence_s)
        return self._select()

    def set_targets(self, links: Links, there: Mask) -> Index:
        """All `links` with what they ask for from now on, and which are `there` (E,); rows for which that is new."""
        before = self._all
        self._all, self._there = links, there if self._watched is None else there & ~self._watched
        asks = np.zeros(len(links), dtype=bool)
        for old, new in zip((before.distance, before.relative, before.bearing),
                            (links.distance, links.relative, links.bearing), strict=True):  # fmt: skip
            if old is not None and new is not None and old is not new:
                same = (old == new) | (np.isnan(old) & np.isnan(new))
                asks |= ~same.reshape(len(links), -1).all(axis=1)
        return np.concatenate([self._select(), links.receiver[asks]])

    def extrapolate_all(self, predictor: Predictor, t: float) -> Array:
        """Where (E, 3) [m] the speakers of all links are believed to be at `t` [s], NaN where nothing was heard."""
        heard = self.poses
        age = np.where(np.isfinite(heard.stamp), t - heard.stamp, 0.0)
        return predictor.position(heard.position, heard.velocity, age)

    def _select(self) -> Index:
        live = self._heard_of & self._there
        changed: Index = self._all.receiver[live != self._taking_part]
        self._taking_part, self.active = live, np.flatnonzero(live)
        self.links = self._all if live.all() else self._all.select(live)
        return changed
