"""Range readings on the network: messages of sweeps, and reception for robots with simulated sensors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import isnan, nan

import zenoh

from agents.body.interface import BodyState, RangeScan
from agents.network import messages, pubsub, validation
from agents.network.keys import Keys

OLD_S = 1.0  # older readings are dropped: objects may have moved


def message(robot: str, utc: float, scan: RangeScan) -> messages.Ranges:
    """A sweep to send, rounded to micrometres and microradians; `utc` is when the scan's clock was 0 [s]."""
    return messages.Ranges(
        robot,
        round(utc + scan.time, 6),
        [round(each, 6) for each in scan.bearing],
        [round(each, 6) for each in scan.elevation],
        [None if isnan(each) else round(each, 6) for each in scan.distance],
    )


class RangeInbox:
    """The newest sweep of each of some robots, as received on their keys `ranges`."""

    def __init__(self, session: zenoh.Session, keys: Keys, names: Sequence[str], rows: Sequence[int]) -> None:
        self._scans: dict[int, RangeScan | None] = dict.fromkeys(rows)
        self._inboxes = {
            row: pubsub.Inbox(pubsub.subscriber(session, keys.ranges(names[row]), 4), messages.Ranges, keys=keys)
            for row in rows
        }

    @property
    def malformed(self) -> int:
        return sum(inbox.malformed for inbox in self._inboxes.values())

    @property
    def trouble(self) -> str:
        """Reason why the last payload of a robot was refused."""
        return next((inbox.trouble for inbox in self._inboxes.values() if inbox.trouble), "")

    def read(self, utc: float, now: float) -> dict[int, RangeScan | None]:
        """The newest sweeps, by row, at `now` [s] of a clock that was 0 at `utc`; those older than `OLD_S` are None."""
        for row, inbox in self._inboxes.items():
            for ranges in inbox.read(partial(validation.check_ranges, now=utc + now)):
                self._store(row, ranges, utc, now)
            scan = self._scans[row]
            if scan is not None and now - scan.time > OLD_S:
                self._scans[row] = None
        return self._scans

    def replace_scans(self, states: Sequence[BodyState], utc: float, now: float) -> None:
        """Write the newest sweeps to the states of the bodies, in place of their own."""
        for row, scan in self.read(utc, now).items():
            states[row].scan = scan

    def _store(self, row: int, ranges: messages.Ranges, utc: float, now: float) -> None:
        """Stores a sweep unless a newer one is known."""
        time, known = validation.taken(ranges.stamp - utc, now), self._scans[row]
        if known is None or time > known.time:
            distance = tuple(nan if value is None else value for value in ranges.distance)
            self._scans[row] = RangeScan(time, tuple(ranges.bearing), tuple(ranges.elevation), distance)
