"""Clocks of several machines: how they lie to each other, how they drift apart, and stamps set right by that.

A question goes to a host and comes back with its time (D. L. Mills, RFC 5905, section 8): between the two readings of
our clock around it, the host's reading belongs to some moment. The middle is off by half the round trip at most,
so the shortest of many round trips tells most.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from agents.rows import Array
from agents.wire import HostClock, State, Status


@dataclass(frozen=True)
class Sample:
    """One question: when it left [s], what the host's clock said [s], when the answer was here [s]."""

    left: float
    there: float
    back: float


def offset(samples: Sequence[Sample]) -> tuple[float, float]:
    """The host's clock less ours [s], and how far off that can be [s], by the sample of the shortest round trip."""
    best = min(samples, key=lambda sample: sample.back - sample.left)
    return best.there - (best.left + best.back) / 2, (best.back - best.left) / 2


@dataclass(frozen=True)
class Lie:
    """How one host's clock lay to ours over a run.

    Attributes:
        host: Its name.
        robots: That ran there.
        first: Offset at the beginning [s], which was taken off every stamp where it was made.
        last: Offset at the end [s].
        uncertainty: The larger of both measurements' [s].
        over: Time between them [s].
    """

    host: str
    robots: tuple[str, ...]
    first: float
    last: float
    uncertainty: float
    over: float

    @property
    def drift(self) -> float | None:
        """Seconds per second; None where both measurements are too near each other to tell it from their errors."""
        return (self.last - self.first) / self.over if self.over > 0.0 else None


class Correction:
    """What drift has added to the stamps of robots on other machines, so that it can be taken off again."""

    def __init__(self, said: Iterable[HostClock]) -> None:
        """`said` is all that was measured in a run, in order of time for each host."""
        self._of: dict[str, tuple[Array, Array]] = {}
        self._lies: dict[str, list[HostClock]] = {}
        for each in said:
            self._lies.setdefault(each.host, []).append(each)
        for measured in self._lies.values():
            stamps = np.array([each.stamp for each in measured])
            added = np.array([each.offset for each in measured]) - measured[0].offset
            for robot in measured[-1].robots:
                self._of[robot] = stamps, added

    def __call__(self, robot: str, stamp: float) -> float:
        """A stamp [s] that a robot's process made, on the conductor's clock."""
        if robot not in self._of:
            return stamp
        stamps, added = self._of[robot]
        return stamp - float(np.interp(stamp, stamps, added))

    def state(self, said: State) -> State:
        """Telemetry with every stamp set right: its own, and those of poses and goals that were heard.

        When goals were sent is stamped by the centre, which runs where the conductor does.
        """
        heard = [
            replace(each, stamp=self(each.speaker, each.stamp), arrived=self(said.robot, each.arrived))
            for each in said.heard
        ]
        followed = [
            replace(each, pose=self(said.robot, each.pose), acted=self(said.robot, each.acted))
            for each in said.followed
        ]
        return replace(said, stamp=self(said.robot, said.stamp), heard=heard, followed=followed)

    def status(self, said: Status) -> Status:
        """A status with its stamp and its start set right."""
        return replace(said, stamp=self(said.robot, said.stamp), started=self(said.robot, said.started))

    def lies(self) -> tuple[Lie, ...]:
        """What there is to tell of each host."""
        return tuple(
            Lie(
                host,
                tuple(measured[-1].robots),
                measured[0].offset,
                measured[-1].offset,
                max(each.uncertainty for each in measured),
                measured[-1].stamp - measured[0].stamp,
            )
            for host, measured in self._lies.items()
        )
