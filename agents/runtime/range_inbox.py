"""Range readings on the network: messages of sweeps, and reception for robots with simulated sensors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import zenoh

from agents.arrays import Index
from agents.body.interface import RangeScan, Rays
from agents.network import messages, pubsub, validation
from agents.network.keys import Keys

OLD_S = 1.0  # older readings are dropped: objects may have moved


def message(robot: str, utc: float, scan: RangeScan) -> messages.Ranges:
    """A sweep to send, rounded to micrometres and microradians; `utc` is when the scan's clock was 0 [s]."""
    distance = [value if value == value else None for value in scan.distance.round(6).tolist()]  # noqa: PLR0124 - NaN
    return messages.Ranges(
        robot, round(utc + scan.time, 6), scan.bearing.round(6).tolist(), scan.elevation.round(6).tolist(), distance
    )


def replace_rows(own: Rays | None, received: Rays | None, rows: Index) -> Rays | None:
    """The readings of the bodies, with those of `rows` replaced by received ones, or removed."""
    if own is None:
        return received
    parts = [own.take(~np.isin(own.row, rows)), *([received] if received is not None else [])]
    rays = Rays.joined(parts)
    # rays of one row follow one another
    return rays.take(np.argsort(rays.row, kind="stable")) if len(rays) else None


class RangeInbox:
    """The newest sweep of each of some rows, as received on their keys `ranges`."""

    def __init__(self, session: zenoh.Session, keys: Keys, names: Sequence[str], rows: Sequence[int]) -> None:
        self._scans: list[RangeScan | None] = [None] * len(names)
        self._inboxes = {
            row: pubsub.Inbox(pubsub.subscriber(session, keys.ranges(names[row]), 4), messages.Ranges, keys=keys)
            for row in rows
        }
        self._rays: Rays | None = None

    @property
    def malformed(self) -> int:
        return sum(inbox.malformed for inbox in self._inboxes.values())

    @property
    def trouble(self) -> str:
        """Why the last payload of a row was refused."""
        return next((inbox.trouble for inbox in self._inboxes.values() if inbox.trouble), "")

    def read(self, utc: float, now: float) -> Rays | None:
        """The newest sweeps at `now` [s] of a clock that was 0 at `utc`; those older than `OLD_S` are dropped."""
        changed = False
        for row, inbox in self._inboxes.items():
            for ranges in inbox.read(partial(validation.check_ranges, now=utc + now)):
                changed |= self._store(row, ranges, utc, now)
            scan = self._scans[row]
            if scan is not None and now - scan.time > OLD_S:
                self._scans[row], changed = None, True
        if changed:
            self._rays = Rays.gather(self._scans)
        return self._rays

    def _store(self, row: int, ranges: messages.Ranges, utc: float, now: float) -> bool:
        """Stores a sweep unless a newer one is known; returns whether it was stored."""
        time = validation.taken(ranges.stamp - utc, now)
        known = self._scans[row]
        if known is not None and time <= known.time:
            return False
        distance = np.array([np.nan if value is None else value for value in ranges.distance])
        self._scans[row] = RangeScan(time, np.array(ranges.bearing), np.array(ranges.elevation), distance)
        return True
