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

from agents.arrays import Array
from agents.clock import SLEW
from agents.network.messages import HostClock, State, Status


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
class ClockOffset:
    """How one host's clock lay to ours over a run."""

    host: str  # its name
    robots: tuple[str, ...]  # that ran there
    first: float  # offset at the beginning [s], which was taken off every stamp where it was made
    last: float  # offset at the end [s]
    uncertainty: float  # the larger of both measurements' [s]
    over: float  # time between them [s]
    # the largest error that was left in stamps when it was measured [s]; as much as `last` less `first` if they had
    # not been corrected during the run
    worst: float = 0.0

    @property
    def drift(self) -> float | None:
        """Seconds per second; None where both measurements are too near each other to tell it from their errors."""
        return (self.last - self.first) / self.over if self.over > 0.0 else None


def taken_off(said: Sequence[HostClock]) -> tuple[Array, Array]:
    """When [s], and what [s], robots of a host took off its reading, to be interpolated: they went from each to the
    next as fast as their clock does."""
    now = said[0].offset if said[0].applied is None else said[0].applied
    points = [(said[0].stamp, now)]
    for each in said[1:]:
        if each.applied is not None and each.applied != now:
            points += [(each.stamp, now), (each.stamp + abs(each.applied - now) / SLEW, each.applied)]
            now = each.applied
    stamps, values = zip(*points, strict=True)
    return np.array(stamps), np.array(values)


class Correction:
    """What drift has added to the stamps of robots on other machines, so that it can be taken off again."""

    def __init__(self, said: Iterable[HostClock]) -> None:
        """`said` is all that was measured in a run, in order of time for each host."""
        self._of: dict[str, tuple[Array, Array, Array, Array]] = {}
        self._lies: dict[str, list[HostClock]] = {}
        for each in said:
            self._lies.setdefault(each.host, []).append(each)
        for measured in self._lies.values():
            stamps = np.array([each.stamp for each in measured])
            offsets = np.array([each.offset for each in measured])
            for robot in measured[-1].robots:
                self._of[robot] = stamps, offsets, *taken_off(measured)

    def __call__(self, robot: str, stamp: float) -> float:
        """A stamp [s] that a robot's process made, on the conductor's clock."""
        if robot not in self._of:
            return stamp
        stamps, offsets, when, what = self._of[robot]
        return stamp - float(np.interp(stamp, stamps, offsets) - np.interp(stamp, when, what))

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

    def lies(self) -> tuple[ClockOffset, ...]:
        """What there is to tell of each host."""
        return tuple(
            ClockOffset(
                host,
                tuple(measured[-1].robots),
                measured[0].offset,
                measured[-1].offset,
                max(each.uncertainty for each in measured),
                measured[-1].stamp - measured[0].stamp,
                _worst(measured),
            )
            for host, measured in self._lies.items()
        )


def _worst(said: Sequence[HostClock]) -> float:
    """The largest difference between a measured offset and what robots took off just then [s]."""
    stamps = np.array([each.stamp for each in said])
    offsets = np.array([each.offset for each in said])
    return float(np.abs(offsets - np.interp(stamps, *taken_off(said))).max())
