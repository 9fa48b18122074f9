"""Positions of robots measured from outside (motion capture, a world), as received over the network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from math import nan

import numpy as np
import zenoh

from agents.arrays import Array
from agents.network import messages, pubsub, validation
from agents.network.keys import Keys


class MeasuredPositions:
    """Subscriptions to the keys `position` of some rows; polled."""

    def __init__(
        self, session: zenoh.Session, keys: Keys, names: Sequence[str], rows: Sequence[int], reach: messages.Vector
    ) -> None:
        """Subscribes for `rows` of the robots `names`; positions beyond `reach` [m] are refused."""
        self._names, self._reach = tuple(names), reach
        # (N,) [s] stamp of the last position of each row less the time of its arrival: the clock of its source is ahead
        # by at least so much, or, where negative, behind or late; NaN before the first
        self.ahead: Array = np.full(len(self._names), nan)
        self.malformed = [0] * len(self._names)  # (N,) refused positions
        self.trouble = [""] * len(self._names)  # (N,) reason of the last refusal
        self._inboxes = {
            row: pubsub.Inbox(
                pubsub.subscriber(session, keys.position(self._names[row]), 32),
                messages.Position,
                keys=keys,
                on_refusal=partial(self._note_refusal, row),
            )
            for row in rows
        }

    def receive(self, utc: float, now: float) -> Iterator[tuple[int, float, Array, float]]:
        """Positions received until `now` [s] of a clock that was 0 at `utc`.

        Yields row, time of measurement [s], position (3,) [m], and yaw [rad], NaN if unknown.
        """
        for row, inbox in self._inboxes.items():
            for measured in inbox.read(partial(self._check, row, utc, now)):
                yaw = nan if measured.yaw is None else measured.yaw
                yield row, validation.taken(measured.stamp - utc, now), np.array(measured.position), yaw

    def _check(self, row: int, utc: float, now: float, measured: messages.Position) -> None:
        self.ahead[row] = measured.stamp - utc - now  # also of a stamp that is refused
        validation.check_position(measured, now=utc + now, reach=self._reach)

    def _note_refusal(self, row: int, _key: str, reason: str) -> None:
        self.malformed[row] += 1
        self.trouble[row] = reason
