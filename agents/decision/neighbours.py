"""Poses received from neighbours, the links that enter the law, and extrapolated positions."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from agents.arrays import Array, Index, Mask, PoseTable, every, some
from agents.formation.graph import Links
from agents.plugins.predictors import HOLD, Predictor


class NeighbourPoses:
    """Last pose received on each link (E), and liveliness of its sender."""

    def __init__(self, links: int) -> None:
        # (E, 3) [m], NaN before the first pose; that of a former process until its successor has sent one
        self.position: Array = np.full((links, 3), np.nan)
        self.velocity: Array = np.zeros((links, 3))  # (E, 3) [m/s]
        # (E,) time of measurement, limited to plausible values [s]; −inf before the first pose
        self.stamp: Array = np.full(links, -np.inf)
        self.arrival: Array = np.full(links, -np.inf)  # (E,) time of reception [s]
        # (E,) loss of the sender [s]; inf: alive; −inf: liveliness token never seen, a pose is no sign of life
        self.lost_since: Array = np.full(links, -np.inf)

    def receive(self, received: PoseTable) -> PoseTable:
        """Store poses received on links (H), in order of arrival; returns those that are newer than the known ones."""
        if len(received.link) > 1 and some(
            received.stamp[1:] < received.stamp[:-1]
        ):  # of several on one link the newest stays
            received = received.take(np.argsort(received.stamp, kind="stable"))
        newer = received.stamp > self.stamp[received.link]
        if not every(newer):
            received = received.take(newer)
        at = received.link
        self.position[at], self.velocity[at] = received.position, received.velocity
        self.stamp[at], self.arrival[at] = received.stamp, received.arrival
        return received

    def mark_lost(self, at: Index, t: float) -> None:
        """Liveliness tokens of the senders of links `at` lost at `t` [s]."""
        self.lost_since[at] = np.minimum(self.lost_since[at], t)

    def mark_alive(self, at: Index) -> None:
        """Liveliness tokens of the senders of links `at` seen, whether or not poses follow."""
        self.lost_since[at] = np.inf

    def discard(self, at: Index) -> None:
        """Discard the poses of the senders of links `at`, which were restarted: each stands where it was last."""
        self.velocity[at] = 0.0
        self.stamp[at] = self.arrival[at] = -np.inf

    @property
    def silent(self) -> Mask:
        """(E,) senders of which only the last place is known: lost, or restarted and without a pose since."""
        return np.asarray((self.lost_since < np.inf) | (self.stamp == -np.inf))

    def extrapolate_position(self, predictor: Predictor, t: float, which: Index) -> Array:
        """Positions (K, 3) [m] at `t` [s] of the senders of links `which` (K,), each received at least once."""
        if predictor is HOLD:
            return self.position if len(which) == len(self.position) else self.position[which]
        position = self.position[which]
        return predictor.position(position, self.velocity[which], t - self.stamp[which])

    def extrapolate_velocity(self, predictor: Predictor, t: float, which: Index) -> Array:
        """Velocities (K, 3) [m/s] of these extrapolations."""
        return predictor.velocity(self.velocity[which], t - self.stamp[which])


class NeighbourStates:
    """Neighbours of rows: received poses, and which links enter the law."""

    def __init__(self, links: Links, avoidance_only: Mask | None, silence_s: float) -> None:
        """Start without poses; `avoidance_only` (E,) links never enter the law, lost ones leave after `silence_s`."""
        self.poses = NeighbourPoses(len(links))  # of all links (E)
        self.incomplete = True  # a sender is missing or lost, so that time alone can change the active links
        # (E,) age of poses on arrival [s] where the sender's clock lags, else 0; None: nowhere
        self.clock_lag: Array | None = None
        self.refused: dict[int, str] = {}  # links of which all poses are refused, and why
        self.foreign: dict[int, int] = {}  # number of poses from another source than the sender, by link
        self.foreign_at = -np.inf  # time of the last of them [s]
        self._all, self._avoidance_only, self._silence_s = links, avoidance_only, silence_s
        self._present: Mask = np.ones(len(links), dtype=bool) if avoidance_only is None else ~avoidance_only
        self._in_law = self._available = np.zeros(len(links), dtype=bool)
        # (K,) links in the law: pose received, sender not lost for long, part of the formation now
        self.active: Index = np.zeros(0, dtype=np.intp)
        self.links = links.take(self.active)  # the active links with their current targets

    def receive(self, received: PoseTable) -> None:
        self.poses.receive(received)

    def mark_lost(self, at: Index, t: float) -> None:
        self.poses.mark_lost(at, t)
        self.incomplete = True

    def mark_alive(self, at: Index) -> None:
        self.poses.mark_alive(at)
        self.incomplete = True

    def discard_poses(self, at: Index) -> None:
        self.poses.discard(at)
        self.incomplete = True

    def mark_clock_lag(self, at: Index, lag: float) -> None:
        """Clocks of the senders of links `at` lag: poses are `lag` [s] old on arrival; 0: no longer."""
        age = np.zeros(len(self._all)) if self.clock_lag is None else self.clock_lag
        age[at] = lag
        self.clock_lag = age if age.any() else None

    def mark_refused(self, at: Collection[int], reason: str) -> None:
        """All poses on links `at` are refused for a `reason`; empty: they are not, or no longer."""
        refused = {link: why for link, why in self.refused.items() if link not in at}
        self.refused = refused | (dict.fromkeys(at, reason) if reason else {})

    def mark_foreign(self, at: Collection[int], count: int, t: float) -> None:
        """Poses on links `at` came from another source than the sender until `t` [s], `count` so far."""
        self.foreign.update(dict.fromkeys(at, count))
        self.foreign_at = t

    @property
    def stamp_once_alive(self) -> Array:
        """(E,) time of the last sample [s] on links whose sender was alive once, minus infinity on the others."""
        return np.where(self.poses.lost_since == -np.inf, -np.inf, self.poses.stamp)

    def missing_senders(self, row: int) -> Index:
        """Senders that a row has never received, or that are lost."""
        lacks = ~np.isfinite(self.poses.stamp) | (self.poses.lost_since < np.inf)
        return np.asarray(self._all.sender[(self._all.receiver == row) & lacks])

    def update_active(self, t: float) -> Index:
        """Update the active links at `t` [s]; returns the rows for which they changed."""
        poses = self.poses
        known, alive = np.isfinite(poses.stamp), poses.lost_since == np.inf
        self.incomplete = not (known & alive).all()
        self._available = known & (t - poses.lost_since <= self._silence_s)
        return self._select()

    def set_targets(self, links: Links, present: Mask) -> Index:
        """Set the targets of all `links` and which are `present` (E,); returns the rows for which that is new."""
        before = self._all
        self._all = links
        self._present = present if self._avoidance_only is None else present & ~self._avoidance_only
        changed = np.zeros(len(links), dtype=bool)
        for old, new in zip((before.distance, before.relative, before.bearing),
                            (links.distance, links.relative, links.bearing), strict=True):  # fmt: skip
            if old is not None and new is not None and old is not new:
                same = (old == new) | (np.isnan(old) & np.isnan(new))
                changed |= ~same.reshape(len(links), -1).all(axis=1)
        return np.concatenate([self._select(), links.receiver[changed]])

    def extrapolate_all(self, predictor: Predictor, t: float) -> Array:
        """Positions (E, 3) [m] of the senders of all links at `t` [s], NaN before the first pose.

        A lost sender has stopped where it was at its loss.
        """
        poses = self.poses
        known = np.isfinite(poses.stamp)
        stamp = np.where(known, poses.stamp, 0.0)
        until = np.where(poses.lost_since < np.inf, np.maximum(stamp, np.minimum(t, poses.lost_since)), t)
        age = np.where(known, until - stamp, 0.0)
        return predictor.position(poses.position, poses.velocity, age)

    def _select(self) -> Index:
        in_law = self._available & self._present
        changed: Index = self._all.receiver[in_law != self._in_law]
        self._in_law, self.active = in_law, np.flatnonzero(in_law)
        self.links = self._all if in_law.all() else self._all.take(in_law)
        return changed
