"""Positions of robots measured from outside (motion capture, a world), as received over the network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from math import inf, isnan, nan
from typing import Final

import zenoh

from agents.body.interface import BodyState
from agents.network import messages, pubsub, validation
from agents.network.keys import Keys
from agents.vectors import Vector

REPEATED_S: Final = 0.3  # time without a new pose that makes the note [s]
SECOND_S: Final = 1.0  # time after the last sample of a second source for which the note stays [s]
SECOND: Final = "a second source sends its position, and is refused"  # note of such a robot
FROZEN: Final = "its measured position repeats itself to the last bit"  # note of such a robot


class MeasuredPositions:
    """Subscriptions to the keys `position` of some rows; polled.

    A pose that is equal to the one before to the last bit was not measured: its source is frozen, and it is left out.
    Of several sources, as their samples name them, the first stays until it is silent or frozen.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        names: Sequence[str],
        rows: Sequence[int],
        valid_box: Vector,
        *,
        exact: Sequence[int] = (),
        silence_s: float,
    ) -> None:
        """Subscribe for `rows` of the robots `names`; positions beyond `valid_box` [m] are refused.

        Args:
            exact: Rows with noise-free positions from a simulation, which may repeat.
            silence_s: Time without a new position after which another source takes over [s].
        """
        self._names, self._valid_box = tuple(names), valid_box
        # stamp of the last position of each robot less the time of its arrival [s]: the clock of its source is ahead by
        # at least this value, or, if it is negative, behind or late; NaN before the first
        self.ahead = [nan] * len(self._names)
        self.malformed = [0] * len(self._names)  # refused positions of each robot
        self.trouble = [""] * len(self._names)  # reason of the last refusal of each robot
        self._exact, self._silence_s = frozenset(exact), silence_s
        self._sources: dict[int, str | None] = {}  # session of the source of each row, None if it names none,
        self._alive_at: dict[int, float] = {}  # and the arrival of its last position that was new [s]
        self._foreign_at: dict[int, float] = {}  # arrival of the last position from a second source [s]
        self._received_at = -inf  # the last call [s]
        self._last: dict[int, tuple[Vector, float | None]] = {}
        self._new_at: dict[int, float] = {}  # arrival of the last pose that was new [s],
        self._repeats: dict[int, bool] = {}  # and whether others came since
        self._inboxes = {
            row: pubsub.Inbox(
                pubsub.subscriber(session, keys.position(self._names[row]), 32),
                messages.Position,
                keys=keys,
                on_refusal=partial(self._note_refusal, row),
            )
            for row in rows
        }

    def receive(self, utc: float, now: float) -> Iterator[tuple[int, float, Vector, float]]:
        """Positions received until `now` [s] of a clock that was 0 at `utc`.

        Yields row, time of measurement [s], position [m], and yaw [rad], NaN if unknown.
        """
        if now - self._received_at > self._silence_s:  # a standstill here is no silence of a source
            self._alive_at = dict.fromkeys(self._alive_at, now)
        self._received_at = now
        for row, inbox in self._inboxes.items():
            for measured, sample in inbox.read_samples():
                source = pubsub.session_of(sample)
                if self._is_foreign(row, source, now):
                    self._foreign_at[row] = now
                    self._note_refusal(row, "", SECOND)
                    continue
                try:
                    self._check(row, utc, now, measured)
                except messages.Malformed as error:
                    self._note_refusal(row, "", str(error))
                    continue
                self._note_source(row, source, (measured.position, measured.yaw), now)
                if not self._is_new(row, (measured.position, measured.yaw), now):
                    continue
                yaw = nan if measured.yaw is None else measured.yaw
                yield row, validation.taken(measured.stamp - utc, now), measured.position, yaw

    def _is_foreign(self, row: int, source: str | None, now: float) -> bool:
        """Whether another source than `source` is there for a row."""
        if row not in self._sources or source == self._sources[row]:
            return False
        return now - self._alive_at[row] <= self._silence_s

    def _note_source(self, row: int, source: str | None, pose: tuple[Vector, float | None], now: float) -> None:
        """A pose of a row from the source that is not foreign; a frozen source is not alive."""
        if row not in self._sources or source != self._sources[row]:
            self._sources[row] = source
            self._last.pop(row, None)
            self._alive_at[row] = now
        elif row in self._exact or pose != self._last.get(row):
            self._alive_at[row] = now

    def _is_new(self, row: int, pose: tuple[Vector, float | None], now: float) -> bool:
        """Whether a pose was measured; of the first one that is known when the next one differs."""
        if row in self._exact:
            return True
        before, self._last[row] = self._last.get(row), pose
        self._repeats[row] = pose == before
        if not self._repeats[row]:
            self._new_at[row] = now
        return before is not None and not self._repeats[row]

    def annotate(self, states: Sequence[BodyState], now: float) -> None:
        """Write to the states of the bodies at `now` [s] how far stamps are ahead, and what is wrong with sources."""
        for row, ahead in enumerate(self.ahead):
            if not isnan(ahead):
                states[row].ahead = ahead
        frozen = [row for row, repeats in self._repeats.items() if repeats and now - self._new_at[row] > REPEATED_S]
        second = [row for row, at in self._foreign_at.items() if now - at <= SECOND_S]
        for what, rows in ((FROZEN, frozen), (SECOND, second)):
            for row in rows:
                state = states[row]
                state.note = f"{what}; {state.note}" if state.note else what

    def _check(self, row: int, utc: float, now: float, measured: messages.Position) -> None:
        self.ahead[row] = measured.stamp - utc - now  # also of a stamp that is refused
        validation.check_position(measured, now=utc + now, valid_box=self._valid_box)

    def _note_refusal(self, row: int, _key: str, reason: str) -> None:
        self.malformed[row] += 1
        self.trouble[row] = reason
