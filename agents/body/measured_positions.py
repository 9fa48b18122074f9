"""Positions of robots measured from outside (motion capture, a world), as received over the network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
# note of a robot with a frozen or rounded position
FROZEN: Final = "its measured position repeats itself to the last bit (frozen, or rounded? pass on all digits)"
LATE: Final = "its measured positions are too late, and are refused: {:.2f} s from their stamps to here (limit {:g} s)"


NOTHING_S: Final = 3.0  # time without any sample that makes the note [s]
NOTHING: Final = "nothing has come on {0}: does anything publish there? `./zenpark echo {0}` at its router shows it"
UNUSED: Final = "what comes on {} is refused: {}"


@dataclass(eq=False)
class PositionSource:
    """Source of the positions of one robot."""

    key: str
    inbox: pubsub.Inbox[messages.Position]
    exact: bool  # noise-free positions from a simulation, which may repeat
    late_s: float  # later ones are refused [s]
    session: str | None = None  # session that its samples name, if they do
    alive_at: float = -inf  # arrival of its last position that was new [s]; minus infinity: none yet
    foreign_at: float = -inf  # arrival of the last position from a second source [s]
    # stamp of the last position less the time of its arrival [s]: the clock of the source is ahead by at least this
    # value, or, if it is negative, behind or late; NaN before the first
    ahead: float = nan
    refused_at: float = -inf  # arrival of the last position that cannot be true [s]
    used_at: float = -inf  # arrival of the last position that was new and not late [s]
    last: tuple[Vector, float | None] | None = None  # position [m] and yaw [rad]
    new_at: float = -inf  # arrival of the last pose that was new [s],
    repeats: bool = False  # True if other positions came since

    def measures(self, session: str | None, pose: tuple[Vector, float | None], now: float) -> bool:
        """Whether a pose was measured; of the first one of a session that is known when the next one differs."""
        if session != self.session or self.alive_at == -inf:
            self.session, self.last = session, None
            self.alive_at = now
        elif self.exact or pose != self.last:  # a frozen source is not alive
            self.alive_at = now
        if self.exact:
            return True
        before, self.last = self.last, pose
        self.repeats = pose == before
        if not self.repeats:
            self.new_at = now
        return before is not None and not self.repeats


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
        late_s: Sequence[float] = (),
        silence_s: float,
    ) -> None:
        """Subscribe for `rows` of the robots `names`; positions beyond `valid_box` [m] are refused.

        Args:
            exact: Rows with noise-free positions from a simulation, which may repeat.
            late_s: Delay beyond which the positions of a robot are refused, for all robots [s]; left out: any delay.
            silence_s: Time without a new position after which another source takes over [s].
        """
        self._valid_box, self._silence_s = valid_box, silence_s
        self._received_at, self._begun = -inf, inf  # the last call and the first one [s]
        self.sources: dict[int, PositionSource] = {}  # sources by row
        for row in rows:
            key = keys.position(names[row])
            inbox = pubsub.Inbox(pubsub.subscriber(session, key, 32), messages.Position, keys=keys)
            self.sources[row] = PositionSource(key, inbox, row in exact, late_s[row] if late_s else inf)

    @property
    def malformed(self) -> int:
        """Refused positions."""
        return sum(source.inbox.malformed for source in self.sources.values())

    def receive(self, utc: float, now: float) -> Iterator[tuple[int, float, Vector, float]]:
        """Positions received until `now` [s] of a clock that was 0 at `utc`.

        Yields row, time of measurement [s], position [m], and yaw [rad], NaN if unknown.
        """
        slept, self._received_at = now - self._received_at > self._silence_s, now
        self._begun = min(self._begun, now)
        for row, source in self.sources.items():
            if slept and source.alive_at > -inf:  # a standstill here is no silence of a source
                source.alive_at = now
            for measured, sample in source.inbox.read_samples():
                session = pubsub.session_of(sample)
                if session != source.session and now - source.alive_at <= self._silence_s:
                    source.foreign_at = now
                    source.inbox.refuse(SECOND)
                    continue
                source.ahead = measured.stamp - utc - now  # also of a stamp that is refused
                try:
                    validation.check_position(measured, now=utc + now, valid_box=self._valid_box)
                except messages.Malformed as error:
                    source.inbox.refuse(str(error))
                    source.refused_at = now
                    continue
                new = source.measures(session, (measured.position, measured.yaw), now)
                if new and source.ahead < -source.late_s:
                    source.inbox.refuse(LATE.format(-source.ahead, source.late_s))
                elif new:
                    source.used_at = now
                    yaw = nan if measured.yaw is None else measured.yaw
                    yield row, validation.taken(measured.stamp - utc, now), measured.position, yaw

    def annotate(self, states: Sequence[BodyState], now: float) -> None:
        """Write to the states of the bodies at `now` [s] how far stamps are ahead, and what is wrong with sources."""
        for row, source in self.sources.items():
            state = states[row]
            if not isnan(source.ahead):
                state.ahead = source.ahead
            for fault in self._faults(source, now):
                state.note = f"{fault}; {state.note}" if state.note else fault

    def _faults(self, source: PositionSource, now: float) -> Iterator[str]:
        """Faults of a source at `now` [s], in words."""
        unused_s = now - source.used_at
        if source.repeats and now - source.new_at > REPEATED_S:
            yield FROZEN
        if now - source.foreign_at <= SECOND_S:
            yield SECOND
        if source.ahead < -source.late_s and unused_s > REPEATED_S:
            yield LATE.format(-source.ahead, source.late_s)
        elif unused_s > REPEATED_S and now - source.refused_at <= SECOND_S:
            yield UNUSED.format(source.key, source.inbox.trouble)
        elif unused_s == inf and now - self._begun > NOTHING_S and not source.repeats:
            refused = source.inbox.malformed > 0
            yield UNUSED.format(source.key, source.inbox.trouble) if refused else NOTHING.format(source.key)
