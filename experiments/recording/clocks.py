"""Clock offsets between machines: measurement, drift, and correction of recorded stamps.

A question goes to a host and comes back with its time (D. L. Mills, RFC 5905, section 8): between the two readings of
our clock around it, the host's reading belongs to some moment. The middle is off by half the round trip at most,
so the shortest of many round trips tells most.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from agents.clock import SLEW
from agents.network.messages import HostClock, State, Status
from twins.arrays import Array


@dataclass(frozen=True)
class ClockSample:
    """Question to a host, and the answer."""

    left: float  # [s] our clock, when the question left
    host: float  # [s] the host's clock
    back: float  # [s] our clock, when the answer came back


def host_offset(samples: Sequence[ClockSample]) -> tuple[float, float]:
    """The host's clock less ours [s], and how far off that can be [s], by the sample of the shortest round trip."""
    best = min(samples, key=lambda sample: sample.back - sample.left)
    return best.host - (best.left + best.back) / 2, (best.back - best.left) / 2


@dataclass(frozen=True)
class ClockOffset:
    """Offset of one host's clock from ours over a run."""

    host: str
    robots: tuple[str, ...]  # robots that ran there
    first: float  # [s] offset at the beginning; subtracted from every stamp where it was made
    last: float  # [s] offset at the end
    uncertainty: float  # [s] the larger of both measurements
    over: float  # [s] time between both measurements
    # [s] largest measured error left in stamps; `last` less `first` if they were not corrected during the run
    worst: float = 0.0

    @property
    def drift(self) -> float | None:
        """Seconds per second; None where both measurements are too near each other to tell it from their errors."""
        return (self.last - self.first) / self.over if self.over > 0.0 else None


def correction_series(clocks: Sequence[HostClock]) -> tuple[Array, Array]:
    """Times [s] and corrections [s] that robots of a host subtracted from its clock, to be interpolated: they went from
    each to the next as fast as their clock does."""
    now = clocks[0].offset if clocks[0].applied is None else clocks[0].applied
    points = [(clocks[0].stamp, now)]
    for each in clocks[1:]:
        if each.applied is not None and each.applied != now:
            points += [(each.stamp, now), (each.stamp + abs(each.applied - now) / SLEW, each.applied)]
            now = each.applied
    stamps, values = zip(*points, strict=True)
    return np.array(stamps), np.array(values)


class Correction:
    """Correction of stamps from other machines by the drift of their clocks."""

    def __init__(self, measured: Iterable[HostClock]) -> None:
        """`measured` are all offsets of a run, in order of time for each host."""
        self._series: dict[str, tuple[Array, Array, Array, Array]] = {}  # series by host
        self._measured: dict[str, list[HostClock]] = {}
        for each in measured:
            self._measured.setdefault(each.host, []).append(each)
        for host, own in self._measured.items():
            stamps, offsets = np.array([(each.stamp, each.offset) for each in own]).T
            self._series[host] = stamps, offsets, *correction_series(own)
        self._host = {robot: host for host, own in self._measured.items() for robot in own[-1].robots}

    def __call__(self, robot: str, stamp: float) -> float:
        """A stamp [s] that a robot's process made, on the conductor's clock."""
        if robot not in self._host:
            return stamp
        stamps, offsets, when, what = self._series[self._host[robot]]
        return float(stamp - (np.interp(stamp, stamps, offsets) - np.interp(stamp, when, what)))

    def state(self, state: State) -> State:
        """Telemetry with all stamps corrected: its own, and those of received poses and goals.

        Goals are stamped by the central controller, which runs on the conductor's machine.
        """
        received = [
            replace(each, stamp=self(each.sender, each.stamp), arrived=self(state.robot, each.arrived))
            for each in state.received
        ]
        receipts = [
            replace(each, pose=self(state.robot, each.pose), acted=self(state.robot, each.acted))
            for each in state.goal_receipts
        ]
        return replace(state, stamp=self(state.robot, state.stamp), received=received, goal_receipts=receipts)

    def status(self, status: Status) -> Status:
        """A status with its stamp, its start and its end corrected."""
        stamp, started, ended = (self(status.robot, at) for at in (status.stamp, status.started, status.ended))
        return replace(status, stamp=stamp, started=started, ended=ended)

    def offsets(self) -> tuple[ClockOffset, ...]:
        found = []
        for host, measured in self._measured.items():
            first, last = measured[0], measured[-1]
            stamps, offsets, when, what = self._series[host]
            worst = float(np.abs(offsets - np.interp(stamps, when, what)).max())
            uncertainty = max(each.uncertainty for each in measured)
            places = (tuple(last.robots), first.offset, last.offset)
            found.append(ClockOffset(host, *places, uncertainty, last.stamp - first.stamp, worst))
        return tuple(found)
