"""Clocks of other machines during a run: measured every second, and corrected in the robots that run there.

A host that drifts by 50 ppm is 0.18 s off after an hour. Each station is asked as before the run. The robots' processes
get their new correction on their lifelines (`agents.clock`), which only the launcher holds; no network of the
experiment is needed. A correction moves only as far as a measurement proves that it is off.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from types import TracebackType
from typing import Final, Self

from agents.clock import STEP_S
from agents.network.messages import HostClock
from experiments.real_time.hosts.hosts import HostError, Station

SAMPLES: Final = 8
PERIOD_S: Final = 1.0  # NTP slews a clock by at most 500 ppm: 0.5 ms


def applied(now: HostClock, before: float) -> float:
    """Correction of stamps from now on [s]: `before`, moved only by the error that the measurement proves."""
    return min(max(before, now.offset - now.uncertainty), now.offset + now.uncertainty)


class Drift:
    """Measures and corrects the clocks of some hosts in a thread of its own, for an answer may take long."""

    def __init__(self, hosts: Iterable[Station], period_s: float = PERIOD_S) -> None:
        """`hosts` were measured once already."""
        self._hosts, self._period_s = list(hosts), period_s
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
        while self._hosts and not self._over.wait(self._period_s):
            for host in list(self._hosts):
                if self._over.is_set():  # the end does not wait for hosts, each of which may be silent
                    return
                try:
                    self._measure(host)
                except HostError as error:
                    self._hosts.remove(host)
                    with self._lock:
                        self._trouble.append(f"{error}; its clock is not corrected any more")

    def _measure(self, host: Station) -> None:
        """Measure one clock and correct its robots."""
        before = host.clock
        assert before is not None
        assert before.applied is not None
        now = host.measure(SAMPLES)
        step, last = (applied(each, before.applied) - before.applied for each in (now, before))
        if abs(step) <= STEP_S:
            now = host.correct(before.applied + step)
        with self._lock:
            self._measured.append(now)
            if abs(last) <= STEP_S < abs(step):
                self._trouble.append(
                    f"{host.name}: its clock jumped by {step:+.3f} s, which is no drift and is not "
                    "corrected: was it suspended? Start the run again"
                )
