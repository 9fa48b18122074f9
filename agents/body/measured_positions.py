"""Positions of robots that something outside of them measures, as they come over the network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import nan

import numpy as np
import zenoh

from agents.arrays import Array
from agents.network import messages, pubsub, validation
from agents.network import session as network
from agents.network.keys import Keys


class MeasuredPositions:
    """Subscriptions to the keys `position` of some rows; polled.

    Attributes:
        ahead: (N,) stamp of the last position of each row less the time of its arrival [s]: the clock of its source is
            ahead by at least so much, or, where negative, behind or late. NaN before the first.
        malformed: Positions of each row (N,) that were refused.
        trouble: Why the last of them was, for each row.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, names: Sequence[str], rows: Sequence[int], reach: messages.Vector
    ) -> None:
        """Listens for `rows` of those called `names`; no position beyond `reach` [m] is believed."""
        self._names, self._reach = tuple(names), reach
        self._subscribers = [(row, pubsub.subscriber(session, keys.position(self._names[row]), 32)) for row in rows]
        self.ahead = np.full(len(self._names), nan)
        self.malformed = [0] * len(self._names)
        self.trouble = [""] * len(self._names)

    def take(self, utc: float, now: float) -> Iterator[tuple[int, float, Array, float]]:
        """What has come until `now` [s] of a clock that was 0 at `utc`: row, when it was measured [s], position (3,)
        [m], and yaw [rad], NaN if unknown."""
        for row, subscriber in self._subscribers:
            name = self._names[row]
            for sample in network.received(subscriber.handler):
                try:
                    said = messages.decode(sample.payload.to_bytes(), str(sample.encoding), messages.Position)
                    if said.robot == name:  # a stamp that is refused is told of as well
                        self.ahead[row] = said.stamp - utc - now
                    validation.check_position(said, robot=name, now=utc + now, reach=self._reach)
                except messages.Malformed as error:
                    self.malformed[row] += 1
                    self.trouble[row] = str(error)
                    continue
                yaw = nan if said.yaw is None else said.yaw
                yield row, validation.taken(said.stamp - utc, now), np.array(said.position), yaw
