"""Clocks of other machines during a run: measured again and again, and corrected in the robots that run there.

A host that drifts by 50 ppm is 0.18 s off after an hour. Every so often each station is asked as before the run, and
the robots' processes get their new correction on their lifelines (`agents.clock`): only the launcher holds these, and
no network of the experiment is needed. A correction moves only as far as a measurement proves that it is off.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Final, Protocol, Self

from agents.clock import STEP_S
from agents.network.messages import HostClock
from experiments.real_time.hosts.hosts import HostError

SAMPLES: Final = 8
SOONEST_S: Final = 1.0
LATEST_S: Final = 10.0
ALLOWED_S: Final = 1e-3  # of drift from one measurement to the next


class MeasuredHost(Protocol):
    """A host whose clock is measured and corrected (`experiments.real_time.hosts.hosts.Station`)."""

    name: str
    clock: HostClock | None

    def measure(self, robots: Sequence[str], samples: int) -> HostClock:
        """Measure its clock."""

    def correct(self, applied: float) -> HostClock:
        """Send its robots the correction of their stamps [s]."""


def due(before: HostClock, now: HostClock) -> float:
    """Time to the next measurement [s], by the drift of the clock since the last one."""
    proved = abs(now.offset - before.offset) - now.uncertainty - before.uncertainty
    if proved <= 0.0:
        return LATEST_S
    return min(max(ALLOWED_S * (now.stamp - before.stamp) / proved, SOONEST_S), LATEST_S)


def applied(now: HostClock, before: float) -> float:
    """Correction of stamps from now on [s]: `before`, moved only by the error that the measurement proves."""
    return min(max(before, now.offset - now.uncertainty), now.offset + now.uncertainty)


class Drift:
    """Measures and corrects the clocks of some hosts in a thread of its own, for an answer may take long."""

    def __init__(self, hosts: Iterable[tuple[MeasuredHost, list[str]]]) -> None:
        """`hosts` with the robots that run on each; measured once already."""
        self._hosts = list(hosts)
        self._over = threading.Event()
        self._measured: list[HostClock] = []
        self._trouble: list[str] = []
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="drift", daemon=True)

    def __enter__(self) -> Self:
        if self._hosts:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End it; a second call does nothing."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def news(self) -> tuple[list[HostClock], list[str]]:
        """Measurements since the last call, and the reasons of those that failed or were not applied."""
        with self._lock:
            found = self._measured, self._trouble
            self._measured, self._trouble = [], []
        return found

    def _run(self) -> None:
        times = dict.fromkeys(range(len(self._hosts)), time.monotonic() + SOONEST_S)
        while times and not self._over.wait(max(0.0, min(times.values()) - time.monotonic())):
            number = min(times, key=lambda each: times[each])
            host, robots = self._hosts[number]
            try:
                times[number] = time.monotonic() + self._measure(host, robots)
            except HostError as error:
                del times[number]
                with self._lock:
                    self._trouble.append(f"{error}; its clock is not corrected any more")

    def _measure(self, host: MeasuredHost, robots: list[str]) -> float:
        """Measure one clock and correct its robots; return the time to the next measurement [s]."""
        before = host.clock
        assert before is not None
        assert before.applied is not None
        now = host.measure(robots, SAMPLES)
        wanted = applied(now, before.applied)
        jumped = abs(wanted - before.applied) > STEP_S
        if not jumped:
            now = host.correct(wanted)
        with self._lock:
            self._measured.append(now)
            if jumped:
                self._trouble.append(
                    f"{host.name}: its clock jumped by {wanted - before.applied:+.3f} s, which is no drift and is not "
                    "corrected: was it suspended? Start the run again"
                )
        return LATEST_S if jumped else due(before, now)
