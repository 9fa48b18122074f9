"""The network of a run in virtual time: delay, jitter and loss on each link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.graph import Links
from agents.rows import Array, Index, Mask, every, some
from experiments.experiment import Channel as Parameters

ROUNDING_S = 1e-9  # sums of binary fractions miss the ticks by less than this
BETWEEN_ROBOTS, TO_CENTRE, FROM_CENTRE = 0x636861, 0x746F63, 0x66726F  # streams of chances


@dataclass(frozen=True)
class Samples:
    """Poses on their way (M): link, arrival time, sample time [s], number, position and velocity (M, 3).

    `extra` (M, k) is what else is told with them, for those who need it.
    """

    link: Index
    arrival: Array
    stamp: Array
    seq: Index
    position: Array
    velocity: Array
    extra: Array | None = None

    def take(self, which: Index | Mask) -> Samples:
        """Some of them."""
        return Samples(
            self.link[which],
            self.arrival[which],
            self.stamp[which],
            self.seq[which],
            self.position[which],
            self.velocity[which],
            None if self.extra is None else self.extra[which],
        )


class Channel:
    """Carries what rows say to whoever listens; each repetition has a random stream of its own.

    Attributes:
        ideal: Without any delay: what is said on a tick is known to all before they decide on it.
        lost: (E,) samples lost on each link.
    """

    def __init__(
        self, links: Links, parameters: Parameters, seeds: Sequence[int], *, stream: int = BETWEEN_ROBOTS
    ) -> None:
        """`links` of all repetitions, those of the first seed first; each `stream` has chances of its own."""
        self._links = links
        self.ideal = parameters.delay_s == parameters.jitter_s == 0.0
        self._delay, self._jitter, self._loss = parameters.delay_s, parameters.jitter_s, parameters.loss
        self._generators = [np.random.default_rng([seed, stream]) for seed in seeds]
        self._per_copy = len(links) // len(seeds)
        self._flying: list[Samples] = []
        self.lost = np.zeros(len(links), dtype=np.intp)

    def send(
        self,
        t: float,
        rows: Index,
        seq: Index,
        position: Array,
        velocity: Array,
        *,
        surely: bool = False,
        extra: Array | None = None,
    ) -> None:
        """Rows say where they are: `position`, `velocity` (N, 3) and `seq` (N,) of all rows, of which `rows` speak.

        `extra` (N, k) goes along.

        Before the common start nothing is lost (`surely`): no run begins before everybody has heard his neighbours, and
        the real network repeats a first pose until it arrives.
        """
        spoke = np.zeros(len(position), dtype=bool)
        spoke[rows] = True
        speaker = self._links.speaker
        at = np.flatnonzero(spoke[speaker])
        delay = np.full(len(at), self._delay)
        if self._loss or self._jitter:
            chance = np.zeros((2, len(speaker)))
            for copy in np.unique(at // max(self._per_copy, 1)):  # only of those that speak: as if it were alone
                mine = slice(copy * self._per_copy, (copy + 1) * self._per_copy)
                chance[:, mine] = self._generators[copy].random((2, self._per_copy))
            chance = chance[:, at]
            delay -= self._jitter * np.log1p(-chance[1])
            arrives = (chance[0] >= self._loss) | surely
            self.lost[at[~arrives]] += 1
            at, delay = at[arrives], delay[arrives]
        if len(at):
            who = speaker[at]
            stamp = np.full(len(at), t)
            more = None if extra is None else extra[who]
            self._flying.append(Samples(at, t + delay, stamp, seq[who], position[who], velocity[who], more))

    def due(self, t: float) -> Samples | None:
        """What has arrived by `t` [s], in order of arrival."""
        if not self._flying:
            return None
        if len(self._flying) == 1:
            pool = self._flying[0]
        else:
            columns = ("link", "arrival", "stamp", "seq", "position", "velocity")
            told = [s.extra for s in self._flying if s.extra is not None]
            link, arrival, stamp, seq, position, velocity = (
                np.concatenate([getattr(s, c) for s in self._flying]) for c in columns
            )
            extra = np.concatenate(told) if told else None
            pool = Samples(link, arrival, stamp, seq, position, velocity, extra)
        here = pool.arrival <= t + ROUNDING_S
        if every(here):
            self._flying = []
            return pool if not self._jitter else pool.take(np.argsort(pool.arrival, kind="stable"))
        self._flying = [pool.take(~here)]
        if not some(here):
            return None
        arrived = pool.take(here)
        return arrived.take(np.argsort(arrived.arrival, kind="stable"))
