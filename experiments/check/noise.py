"""Flights with the noise of the experiment beside the ideal run: what noise prevents, and what it makes possible."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from experiments.check.analysis import Analysis
from experiments.check.findings import DELAYED, FORGIVEN, Finding
from experiments.check.ideal_run import fly, has_noise, repetitions
from experiments.check.theory import strength
from experiments.metrics.signals import WINDOW_S

SOFT: Final = 3.0  # time constants of a mode that must fit into the run: 5 % of its error are left then
LATER: Final = 2.0  # multiple of the time without noise above which a formation is acquired late
NARROW: Final = 0.6  # share of the tolerance: noise may move a link that is farther off out of it
WITHOUT: Final = {  # findings that noise may refute: what robots do without it
    "acquired-late": "are late",
    "wheels-stop": "on wheels stop short of their goals",
    "local-minimum": "balance in another shape",
    "lags": "lag behind their leader",
    "not-acquired": "stop short of their places",
}


@dataclass(frozen=True)
class Flights:
    """Flights with noise, of several seeds."""

    flown: list[Analysis]  # the case with these motions
    seeds: str  # all seeds, in words
    count: int

    @classmethod
    def of(cls, analysis: Analysis) -> Flights:
        bare = analysis.prediction.bare
        count = repetitions(bare)
        first, beside = bare.experiment.seed, analysis.prediction.noisy
        flown = [] if beside is None else [beside]
        flown += [fly(bare, seed) for seed in range(first + len(flown), first + count)]
        seeds = f"seed {first}" if count == 1 else f"seeds {first} to {first + count - 1}"
        return cls([Analysis(analysis.plan, each) for each in flown if not each.stuck], seeds, count)

    @property
    def acquired(self) -> list[float]:
        """Times of acquisition [s] of the flights that acquire the formation, and again by the end."""
        return [at for each in self.flown if (at := each.acquired_for_good) is not None]

    def enough(self, number: int) -> bool:
        """Whether `number` failed flights are more than chance.

        One of five may be: of such experiments one in four was lost with other seeds.
        """
        return number >= min(2, self.count)


def span_of(times: list[float]) -> str:
    """Range of times [s] in words."""
    low, high = f"{min(times):.1f}", f"{max(times):.1f}"
    return f"{low} s" if low == high else f"{low} to {high} s"


def with_noise(analysis: Analysis, finding: Finding) -> Finding:
    """Finding of a formation that is not acquired, after flights with noise; the good news if all acquire it.

    A trigger or the wheels leave robots with small errors alone. Noise moves them on.
    """
    if finding.code not in WITHOUT or not has_noise(analysis.plan):
        return finding
    flights = Flights.of(analysis)
    times, count = flights.acquired, flights.count
    if times and len(times) == count:
        message = (
            f"the formation is acquired after {span_of(times)} with the noise of [disturbance], in {count} of {count} "
            f"flights ({flights.seeds}); without noise it is not, because robots {WITHOUT[finding.code]}"
        )
        return Finding("note", "acquired", message)
    noisy = f"with the noise of [disturbance], in {len(times)} of {count} flights ({flights.seeds})"
    if not times:
        return replace(finding, message=f"{finding.message}; nor is it {noisy.replace(', in 0 of', ', in any of')}")
    return replace(finding, message=f"{finding.message}; but it is {noisy}, after {span_of(times)}")


def acquired_note(analysis: Analysis, formed: float, left: str) -> Finding:
    """The note on an acquired formation; with the noise of the file's seed, if that takes longer."""
    delayed = None if analysis.noisy is None else analysis.noisy.acquired_for_good
    noisy = ""
    if delayed is not None and delayed > max(DELAYED * formed, formed + WINDOW_S):
        noisy = f" without noise, {delayed:.1f} s with that of seed {analysis.plan.experiment.seed}"
    return Finding("note", "acquired", f"the formation is acquired after {formed:.1f} s{noisy}; at the end {left}")


def softness(analysis: Analysis) -> Iterator[Finding]:
    """Check that a formation that is acquired without noise is also acquired, and in time, with that of its file.

    Experiments with a late flight with noise, and soft ones, are flown with more seeds.
    """
    experiment = analysis.plan.experiment
    loop, formed = analysis.modes, analysis.acquired_for_good
    if analysis.met_shape is None or formed is None:
        return
    if analysis.prediction.stuck or not has_noise(analysis.plan):
        return
    soft = loop is not None and (bool(loop.free) or SOFT * loop.slowest_s > experiment.duration_s)
    late = max(LATER * formed, formed + WINDOW_S)
    if not (soft or _doubtful(analysis, formed, late)):
        return
    flights = Flights.of(analysis)
    count, times = flights.count, flights.acquired
    most = experiment.tolerance + FORGIVEN
    spans = [(analysis.acquired(until) or 0.0, until) for until in analysis.spans_end]
    largest = [_largest_error(each, spans) for each in flights.flown]
    lost = sum(error > most for error, _ in largest)
    delayed = len(flights.flown) - sum(at <= late for at in times)
    if flights.enough(lost):
        _, where = max(largest)
        how = f"outside the tolerance of {1e3 * experiment.tolerance:g} mm later, in {lost} of {count} flights"
        how = f"{how} ({flights.seeds}): {where}"
    elif flights.enough(delayed):
        how = (
            f"after {span_of(times)}, in {len(times)} of {count} flights" if times else f"not at all in {count} flights"
        )
        how = f"{how} ({flights.seeds})"
    else:
        return
    modes = "soft formation"
    if loop is not None:
        slower = f"{loop.free} mode{'s' * (loop.free > 1)} slower than the run"
        modes += f", {slower if loop.free else f'slowest mode {loop.slowest_s:.1f} s'}"
    message = f"{modes}: acquired after {formed:.1f} s without noise, but with the noise of [disturbance]"
    remedy = f"raise {strength(analysis)[0]}, add links that stiffen the formation, or allow a larger tolerance"
    yield Finding("warning", "soft", f"{message} {how}", remedy, ("formation", "links"))


def _largest_error(flight: Analysis, spans: list[tuple[float, float]]) -> tuple[float, str]:
    """Largest mean error of a link in the second half of one of the spans [s], in metres and in words."""
    time = flight.prediction.time
    due = np.any([(time > (begin + until) / 2.0) & (time <= until + 1e-9) for begin, until in spans], axis=0)
    off = flight.mean_error[due]
    if not off.size:
        return 0.0, ""
    at, link = np.unravel_index(off.argmax(), off.shape)
    worst = float(off[at, link])
    return worst, f"{flight.link(link)} is {1e3 * worst:.0f} mm off at {time[due][at]:.1f} s"


def _doubtful(analysis: Analysis, formed: float, late: float) -> bool:
    """Whether the flight with noise beside the ideal one is late; without one, whether the ideal one is near it."""
    if analysis.noisy is not None:
        found = analysis.noisy.acquired_for_good
        return found is None or found > late
    time = analysis.prediction.time
    settled = analysis.mean_error[(time >= formed) & (time <= analysis.spans_end[0] + 1e-9)]
    return float(settled[len(settled) // 2 :].max(initial=0.0)) > NARROW * analysis.plan.experiment.tolerance
