"""The network of a run in virtual time: what rows say goes over each link as `agents.channel` has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from agents import channel, wire
from agents.channel import Samples
from agents.graph import Links
from agents.rows import Array, Index
from experiments import conditions
from experiments.experiment import Experiment

EPOCH: Final = 1_700_000_000.0  # UTC [s] of the common start in virtual time: any, but the same in every run


class Channel:
    """Carries what rows say to whoever listens; each repetition has its own luck.

    Attributes:
        instant: What is said on a tick is known to all, or lost, before they decide on it.
    """

    def __init__(self, experiment: Experiment, links: Links, seeds: Sequence[int], *, stream: str = "") -> None:
        """`links` of all repetitions, those of the first seed first; each `stream` has its own luck."""
        self._channel = channel.Channel(conditions.virtual(experiment, links, seeds, stream=stream))
        self.instant = self._channel.instant
        self._speaker = links.speaker
        self._names = tuple(experiment.robots)
        self._encoding: wire.Encoding = experiment.network.encoding

    @property
    def lost(self) -> Index:
        """(E,) samples that did not get through; none before the common start."""
        return self._channel.dropped

    def send(
        self,
        t: float,
        rows: Index,
        seq: Index,
        position: Array,
        velocity: Array,
        *,
        yaw: Array,
        start: float,
        extra: Array | None = None,
    ) -> None:
        """Rows say where they are: pose, `seq` and what goes along of all rows (N, ...), of which `rows` speak.

        `start` is the common start [s]; NaN or infinity as long as it is not known: nothing is lost before.
        """
        spoke = np.zeros(len(position), dtype=bool)
        spoke[rows] = True
        at = np.flatnonzero(spoke[self._speaker])
        if not len(at):
            return
        who = self._speaker[at]
        size = None
        if self._channel.limited:
            size = self._sizes(EPOCH + (t - start if t >= start else 0.0), rows, (seq, position, velocity, yaw))[who]
        self._channel.send(
            at,
            seq[who],
            np.full(len(at), t),
            position[who],
            velocity[who],
            start=start,
            size=size,
            extra=None if extra is None else extra[who],
        )

    def due(self, t: float) -> Samples | None:
        """What has arrived by `t` [s], in order of arrival."""
        return self._channel.due(t)

    def _sizes(self, stamp: float, rows: Index, said: tuple[Index, Array, Array, Array]) -> Index:
        """(N,) bytes of the payloads of the rows that speak, as they would stand on the wire."""
        found = np.zeros(len(said[0]), dtype=np.intp)
        columns = zip(*(each[rows].tolist() for each in said), strict=True)
        for row, (number, place, moves, turned) in zip(rows.tolist(), columns, strict=True):
            pose = wire.pose(self._names[row % len(self._names)], number, stamp, place, moves, turned)
            found[row] = len(wire.encode(pose, self._encoding))
        return found
