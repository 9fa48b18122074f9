"""Verdict of a soak: whether anything grows, is lost, slows down or dies; with its page."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec

from experiments.report.page import Finding, Section, Table, date_of, render
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

    first: Sequence[Row]  # of the first window
    last: Sequence[Row]  # of the last window

    def growth(self, what: Callable[[Row], float]) -> float:
        """Growth of the median, as a share of the first."""
        first, last = (statistics.median(map(what, rows)) for rows in (self.first, self.last))
        return last / first - 1.0 if first else 0.0

    def more(self, what: Callable[[Row], int]) -> int:
        """Growth of the maximum."""
        return max(map(what, self.last)) - max(map(what, self.first))


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
    both = ends(soaked)
    return [
        *_alive(soaked),
        *_memory(soaked, both),
        *_handles(both),
        *_losses(soaked),
        *_delays(soaked, both),
        *_punctual(soaked),
    ]


def passed(findings: Sequence[Finding]) -> bool:
    """Whether nothing is bad."""
    return all(finding.mark != "bad" for finding in findings)


def _alive(soaked: Soaked) -> list[Finding]:
    lasted = max((row.time_s for row in soaked.rows), default=0.0)
    sampled = soaked.by_process()
    bad = [f"{name} ended after {at:.0f} s" for name, at in soaked.died.items()]
    bad += [f"{name} never had a process" for name in soaked.robots if name not in sampled and name not in soaked.died]
    if soaked.exit != 0:
        bad.append(f"the run ended with exit code {soaked.exit}: see logs/")
    if soaked.interrupted:
        bad.append(f"it was interrupted after {lasted:.0f} s of {soaked.duration_s:g} s")
    if bad:
        return [Finding("bad", text) for text in bad]
    return [Finding("good", f"all {len(soaked.robots)} robots lived through {lasted / 60.0:.1f} minutes")]


def _memory(soaked: Soaked, both: dict[str, Ends]) -> list[Finding]:
    if not both:
        return [Finding("bad", "too few samples to compare beginning and end: let it run longer")]
    grown = {process: each.growth(lambda row: row.rss_mb) for process, each in both.items()}
    most = max(grown, key=lambda process: grown[process])
    text = f"memory: largest growth after {soaked.warm_s:.0f} s is {100 * grown[most]:+.2f} % ({most})"
    if soaked.duration_s < JUDGED_S:
        return [Finding("plain", f"{text}; not judged below {JUDGED_S / 60:.0f} minutes")]
    if grown[most] <= GROWTH:
        return [Finding("good", f"{text}, within {100 * GROWTH:g} %")]
    beyond = ", ".join(f"{p} {100 * g:+.2f} %" for p, g in sorted(grown.items()) if g > GROWTH)
    return [Finding("bad", f"memory grows beyond {100 * GROWTH:g} %: {beyond}")]


def _handles(both: dict[str, Ends]) -> list[Finding]:
    found = []
    counted: tuple[tuple[str, Callable[[Row], int]], ...] = (
        ("threads", lambda row: row.threads),
        ("file descriptors", lambda row: row.files),
    )
    for what, count in counted:
        more = {process: each.more(count) for process, each in both.items()}
        grown = ", ".join(f"{process} +{extra}" for process, extra in more.items() if extra > 0)
        found.append(Finding("bad", f"{what} grow: {grown}") if grown else Finding("good", f"{what} do not grow"))
    return found


def _losses(soaked: Soaked) -> list[Finding]:
    last = {process: rows[-1] for process, rows in soaked.by_process().items()}
    lost = {process: row.lost for process, row in last.items() if row.lost}
    received = sum(row.heard or 0 for row in soaked.rows)
    malformed = sum(row.malformed or 0 for row in last.values())
    found = []
    if lost:
        found.append(Finding("bad", "lost poses: " + ", ".join(f"{name} {count}" for name, count in lost.items())))
    elif not received:
        found.append(Finding("bad", "no pose was received: nothing was tested"))
    else:
        found.append(Finding("good", f"0 of {received} poses were lost"))
    if malformed:
        found.append(Finding("bad", f"{malformed} payloads were refused as malformed"))
    return found


def _delays(soaked: Soaked, both: dict[str, Ends]) -> list[Finding]:
    first = [row.delay_s for each in both.values() for row in each.first if row.delay_s is not None]
    last = [row.delay_s for each in both.values() for row in each.last if row.delay_s is not None]
    longest = max((row.longest_s or 0.0 for row in soaked.rows), default=0.0)
    if not (first and last):
        return []
    before, after = statistics.median(first), statistics.median(last)
    text = (
        f"delay of poses: {1e3 * before:.2f} ms at first, {1e3 * after:.2f} ms at last, {1e3 * longest:.0f} ms at most"
    )
    return [Finding("bad" if after > max(SLOWER * before, DELAY_S) else "good", text)]


def _punctual(soaked: Soaked) -> list[Finding]:
    last = [rows[-1] for rows in soaked.by_process().values() if rows[-1].ticks]
    ticks, missed = sum(row.ticks or 0 for row in last), sum(row.missed or 0 for row in last)
    if not ticks:
        return []
    share = 100.0 * missed / ticks
    return [Finding("good" if share < 1.0 else "fair", f"{missed} of {ticks} ticks were missed ({share:.3f} %)")]


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
        lasted = last.time_s - first.time_s
        share = 100.0 * (last.cpu_s - first.cpu_s) / lasted if lasted > 0.0 else 0.0
        delays = [row.delay_s for row in rows[process] if row.delay_s is not None]
        memory = [statistics.median(row.rss_mb for row in window) for window in (each.first, each.last)]
        cells = (
            process,
            f"{memory[0]:.1f}",
            f"{memory[1]:.1f}",
            f"{100 * each.growth(lambda row: row.rss_mb):+.2f} %",
            str(last.threads),
            str(last.files),
            f"{share:.1f} %",
            "–" if last.lost is None else str(last.lost),
            "–" if last.missed is None else str(last.missed),
            f"{1e3 * statistics.median(delays):.2f}" if delays else "–",
        )
        lines.append(Line(cells))
    head = ("Process", "MB first", "MB last", "Growth", "Threads", "Files", "CPU", "Lost", "Missed", "Delay [ms]")
    return Table(head, tuple(lines), note="CPU is the share of a core after the warm-up; memory is resident.")
