"""Verdict of a soak: whether anything grows, is lost, slows down or dies; with its page."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec

from experiments.report.page import Finding, Mark, Section, Table, date_of, render
from experiments.report.page import Row as Line

PAGE: Final = "soak.html"
WARM_SHARE: Final = 0.1  # of the run that does not count, but not more than
WARM_S: Final = 300.0
WINDOW: Final = 0.1  # share of what counts that is compared at both ends
GROWTH: Final = 0.02  # of the memory
JUDGED_S: Final = 300.0  # memory of a shorter run says nothing: allocators are still filling their pools
SLOWER: Final = 2.0  # times the delay at the beginning
DELAY_S: Final = 0.005  # delays below are the noise of the machine


class Row(msgspec.Struct, frozen=True):
    """A process at one time; fields of robots are None for others."""

    time_s: float  # from the common start [s]
    process: str  # a robot's name, "router", "recorder", "conductor"
    rss_mb: float  # resident memory [MB]
    threads: int
    files: int  # open file descriptors
    cpu_s: float  # CPU time since its begin [s]
    recording_mb: float | None = None  # size of the recording, of the recorder
    lost: int | None = None  # poses of its neighbours that never arrived; None but for robots
    missed: int | None = None  # ticks that it missed, of `ticks`
    ticks: int | None = None
    malformed: int | None = None  # payloads that it refused
    # poses received since the sample before
    heard: int | None = None
    delay_s: float | None = None  # median from sender to receiver [s]
    longest_s: float | None = None  # the largest delay [s]


COLUMNS: Final = tuple(each.name for each in msgspec.structs.fields(Row))


@dataclass(frozen=True)
class Soaked:
    """Samples of a soak."""

    title: str  # of the experiment
    robots: tuple[str, ...]  # by process
    duration_s: float  # planned, from the common start [s]
    rows: Sequence[Row]  # in order of time
    exit: int | None  # of the conductor's process
    died: dict[str, float]  # processes that ended too early, and when [s]
    interrupted: bool = False  # by the user

    def by_process(self) -> dict[str, list[Row]]:
        found: dict[str, list[Row]] = {}
        for row in self.rows:
            found.setdefault(row.process, []).append(row)
        return found

    @property
    def warm_s(self) -> float:
        """From then on it counts [s]."""
        return min(WARM_SHARE * self.duration_s, WARM_S)


@dataclass(frozen=True)
class Ends:
    """Rows of a process after the warm-up: first and last window."""

    first: Sequence[Row]
    last: Sequence[Row]

    def over(self, what: Callable[[Iterable[float]], float], field: str) -> tuple[float, float]:
        """A statistic of a field in both windows."""
        first, last = (what(getattr(row, field) for row in rows) for rows in (self.first, self.last))
        return first, last

    @property
    def growth(self) -> float:
        """Growth of the memory, as a share of the first."""
        first, last = self.over(statistics.median, "rss_mb")
        return last / first - 1.0 if first else 0.0


def ends(soaked: Soaked) -> dict[str, Ends]:
    """Both ends of each process that has enough rows to have them."""
    found = {}
    for process, rows in soaked.by_process().items():
        counted = [row for row in rows if row.time_s >= soaked.warm_s]
        size = max(2, round(WINDOW * len(counted)))
        if len(counted) >= 2 * size:
            found[process] = Ends(counted[:size], counted[-size:])
    return found


def judge(soaked: Soaked) -> list[Finding]:
    """The verdict; bad findings fail it."""
    both, sampled = ends(soaked), soaked.by_process()
    last = {process: rows[-1] for process, rows in sampled.items()}
    found = [*_alive(soaked, sampled), _memory(soaked, both)]

    def add(wrong: str, right: str) -> None:
        found.append(Finding("bad", wrong) if wrong else Finding("good", right))

    for what, field in (("threads", "threads"), ("file descriptors", "files")):
        counts = {process: each.over(max, field) for process, each in both.items()}
        grown = ", ".join(
            f"{process} +{after - before}" for process, (before, after) in counts.items() if after > before
        )
        add(grown and f"{what} grow: {grown}", f"{what} do not grow")
    lost = ", ".join(f"{process} {row.lost}" for process, row in last.items() if row.lost)
    received = sum(row.heard or 0 for row in soaked.rows)
    untested = "" if received else "no pose was received: nothing was tested"
    add(f"lost poses: {lost}" if lost else untested, f"0 of {received} poses were lost")
    if malformed := sum(row.malformed or 0 for row in last.values()):
        found.append(Finding("bad", f"{malformed} payloads were refused as malformed"))
    early = [row.delay_s for each in both.values() for row in each.first if row.delay_s is not None]
    late = [row.delay_s for each in both.values() for row in each.last if row.delay_s is not None]
    if early and late:
        before, after = statistics.median(early), statistics.median(late)
        longest = max(row.longest_s or 0.0 for row in soaked.rows)
        text = f"{1e3 * before:.2f} ms at first, {1e3 * after:.2f} ms at last, {1e3 * longest:.0f} ms at most"
        slow = after > max(SLOWER * before, DELAY_S)
        found.append(Finding("bad" if slow else "good", f"delay of poses: {text}"))
    missed, ticks = (sum(getattr(row, field) or 0 for row in last.values()) for field in ("missed", "ticks"))
    if ticks:
        mark: Mark = "good" if missed < 0.01 * ticks else "fair"
        found.append(Finding(mark, f"{missed} of {ticks} ticks were missed ({100.0 * missed / ticks:.3f} %)"))
    return found


def passed(findings: Sequence[Finding]) -> bool:
    """Whether nothing is bad."""
    return all(finding.mark != "bad" for finding in findings)


def _alive(soaked: Soaked, sampled: Mapping[str, Sequence[Row]]) -> list[Finding]:
    lasted = max((row.time_s for row in soaked.rows), default=0.0)
    bad = [f"{name} ended after {at:.0f} s" for name, at in soaked.died.items()]
    bad += [f"{name} never had a process" for name in soaked.robots if name not in sampled and name not in soaked.died]
    if soaked.exit != 0:
        bad.append(f"the run ended with exit code {soaked.exit}: see logs/")
    if soaked.interrupted:
        bad.append(f"it was interrupted after {lasted:.0f} s of {soaked.duration_s:g} s")
    if bad:
        return [Finding("bad", text) for text in bad]
    return [Finding("good", f"all {len(soaked.robots)} robots lived through {lasted / 60.0:.1f} minutes")]


def _memory(soaked: Soaked, both: Mapping[str, Ends]) -> Finding:
    if not both:
        return Finding("bad", "too few samples to compare beginning and end: let it run longer")
    grown = {process: each.growth for process, each in both.items()}
    most = max(grown, key=lambda process: grown[process])
    text = f"memory: largest growth after {soaked.warm_s:.0f} s is {100 * grown[most]:+.2f} % ({most})"
    if soaked.duration_s < JUDGED_S:
        return Finding("plain", f"{text}; not judged below {JUDGED_S / 60:.0f} minutes")
    if grown[most] <= GROWTH:
        return Finding("good", f"{text}, within {100 * GROWTH:g} %")
    beyond = ", ".join(f"{p} {100 * g:+.2f} %" for p, g in sorted(grown.items()) if g > GROWTH)
    return Finding("bad", f"memory grows beyond {100 * GROWTH:g} %: {beyond}")


# ---------------------------------------------------------------------- the page


def write(folder: Path, soaked: Soaked, findings: Sequence[Finding], command: str) -> Path:
    """Write `soak.html` into a folder."""
    return render(
        folder / PAGE,
        title=f"Soak: {soaked.title}",
        source="",
        facts=[
            ("Date", date_of(time.time())),
            ("Duration", f"{soaked.duration_s / 60.0:g} min"),
            ("Robots", str(len(soaked.robots))),
            ("Warm-up", f"{soaked.warm_s:g} s"),
        ],
        command=command,
        verdict=findings,
        sections=[Section("Processes", tables=(table(soaked),))],
    )


def table(soaked: Soaked) -> Table:
    """Each process after the warm-up and at the end."""
    lines = []
    rows = soaked.by_process()
    for process, each in sorted(ends(soaked).items()):
        last, first = each.last[-1], each.first[0]
        share = 100.0 * (last.cpu_s - first.cpu_s) / max(last.time_s - first.time_s, 1e-9)
        delays = [row.delay_s for row in rows[process] if row.delay_s is not None]
        counts = ("–" if count is None else str(count) for count in (last.lost, last.missed))
        cells = (
            process,
            *(f"{memory:.1f}" for memory in each.over(statistics.median, "rss_mb")),
            f"{100 * each.growth:+.2f} %",
            str(last.threads),
            str(last.files),
            f"{share:.1f} %",
            *counts,
            f"{1e3 * statistics.median(delays):.2f}" if delays else "–",
        )
        lines.append(Line(cells))
    head = ("Process", "MB first", "MB last", "Growth", "Threads", "Files", "CPU", "Lost", "Missed", "Delay [ms]")
    return Table(head, tuple(lines), note="CPU is the share of a core after the warm-up; memory is resident.")
