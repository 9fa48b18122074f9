"""`./zenpark test --soak`: an experiment for hours, and whether anything grows, is lost, slows down or dies.

Everything is written down as it comes: the processes that are measured keep no samples.
"""

from __future__ import annotations

import csv
import os
import resource
import secrets
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
import typer

from agents.errors import ExplainedError
from agents.runtime.command_line import interrupts
from agents.safety.hazards import failed
from experiments.definition.plan import Plan
from experiments.file.document import chosen, load
from experiments.real_time.conductor.conduct import RunOptions, Supervision, conduct
from experiments.real_time.conductor.run_view import EventFeed, Progress, RobotView, RunFailed
from experiments.real_time.hosts.launcher import RUN, tagged
from experiments.recording.run_folder import new_folder
from experiments.report.page import NONE, Mark, VerdictLine
from tests.reliability.spoilt_process import CONDUCTOR, OTHER, role_of
from tools.options import AsJson, Bodies, Case, Out, Settings, print_result
from tools.progress import columns

SAMPLE_S: Final = 5.0
SAMPLES: Final = 60  # at least so many, however short it is
PRINT_S: Final = 60.0
PAGE: Final = resource.getpagesize()


class Usage(NamedTuple):
    """Resources of a process."""

    rss_mb: float  # resident memory [MB]
    threads: int
    files: int  # open file descriptors
    cpu_s: float  # CPU time since it began [s]


def usage_of(pid: int) -> Usage | None:
    """Resources of a process; None if it has ended."""
    folder = Path("/proc", str(pid))
    try:
        fields = (folder / "stat").read_bytes().rpartition(b")")[2].split()
        files = sum(1 for _ in (folder / "fd").iterdir())
        cpu_s = time.clock_gettime(~pid << 3 | 2)  # clock_getcpuclockid(3): exact, where /proc counts in 10 ms
    except OSError:
        return None
    # counted from the state, which is field 3 of proc_pid_stat(5): num_threads 20, rss 24
    return Usage(round(int(fields[21]) * PAGE / 1e6, 3), int(fields[17]), files, cpu_s)


class SoakSample(msgspec.Struct, frozen=True):
    """A process at one time; fields of robots are None for others."""

    time_s: float  # from the common start [s]
    process: str  # a robot's name, "router", "recorder", "conductor"
    rss_mb: float  # resident memory [MB]
    threads: int
    files: int  # open file descriptors
    cpu_s: float  # CPU time since its begin [s]
    lost: int | None = None  # poses of its neighbours that never arrived; None but for robots
    missed: int | None = None  # ticks that it missed, of `ticks`
    ticks: int | None = None
    malformed: int | None = None  # payloads that it refused
    # poses received since the sample before
    received: int | None = None
    delay_s: float | None = None  # median from sender to receiver [s]
    longest_s: float | None = None  # the largest delay [s]


@dataclass(frozen=True)
class Soaked:
    """Samples of a soak."""

    robots: tuple[str, ...]  # by process
    duration_s: float  # planned, from the common start [s]
    rows: Sequence[SoakSample]  # in order of time
    failed: Mapping[str, str] = field(default_factory=dict)  # what processes and robots failed in, and when
    interrupted: bool = False  # by the user


class Sampler(ExitStack):
    """Follows a run: writes a row for each of its processes every few seconds, and prints a line a minute."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        super().__init__()
        self._experiment = experiment = plan.experiment
        self._table = folder / "soak.csv"
        self._delays: dict[str, list[float]] = {name: [] for name in experiment.robots}  # since the last sample [s]
        self._failed: dict[str, str] = {}
        self._news = EventFeed()
        self._every = min(SAMPLE_S, experiment.duration_s / SAMPLES)
        self._due, self._print_due = self._every, PRINT_S
        os.environ[RUN] = self._tag = secrets.token_hex(8)  # processes of the run inherit it
        self._file = self.enter_context(self._table.open("w", newline="", encoding="utf-8"))
        self._writer = csv.writer(self._file)
        self._writer.writerow(SoakSample.__struct_fields__)

    def __call__(self, progress: Progress) -> None:
        """Take in the last update of the run, and sample its processes if it is time."""
        t = progress.elapsed
        for event in self._news.new_events(progress):
            if event.kind == "lost" or (event.kind == "hazard" and failed(event.text)):
                what = "ended" if event.kind == "lost" else f"did not do its part ({event.text})"
                self._failed.setdefault(event.source, f"{what} after {t or 0.0:.0f} s")
        for state in progress.states:
            if state.phase == "running":
                self._delays[state.robot] += [pose.arrived - pose.stamp for pose in state.received]
        if t is None or not self._due <= t <= self._experiment.duration_s or progress.phase in ("landing", "stopped"):
            return
        self._due += self._every
        rows = list(self._rows(round(t, 2), progress.robots))
        self._writer.writerows(map(msgspec.structs.astuple, rows))
        self._file.flush()
        if t > self._print_due:
            self._print_due += PRINT_S
            lost, memory = sum(row.lost or 0 for row in rows), sum(row.rss_mb for row in rows)
            minutes = f"{t / 60.0:6.1f} of {self._experiment.duration_s / 60.0:g} min"
            print(f"{minutes}: {len(rows)} processes, {memory:.0f} MB, {lost} poses lost", file=sys.stderr)

    def end_early(self, error: Exception) -> None:
        """Count an error that ended the run as its failure; raise it if there is no sample yet: the run never began."""
        if self._due == self._every:
            raise error
        self._failed["the run"] = f"ended early: {error}"

    def result(self, *, interrupted: bool) -> Soaked:
        """The samples, after the run."""
        with self._table.open(newline="", encoding="utf-8") as file:
            known = [{name: text for name, text in row.items() if text} for row in csv.DictReader(file)]
        return Soaked(
            tuple(map("+".join, self._experiment.processes.values())),
            self._experiment.duration_s,
            msgspec.convert(known, list[SoakSample], strict=False),
            self._failed,
            interrupted,
        )

    def _rows(self, t: float, robots: Mapping[str, RobotView]) -> Iterator[SoakSample]:
        """A row for each process of the run."""
        roles = {pid: role_of(words) for pid, words in tagged(f"{RUN}={self._tag}")}
        for pid, process in {**roles, os.getpid(): CONDUCTOR}.items():
            if process == OTHER or (usage := usage_of(pid)) is None:
                continue
            row = SoakSample(t, process, *usage)
            names = [name for name in process.split("+") if name in robots]
            statuses = [status for name in names if (status := robots[name].status) is not None]
            if statuses:
                delays = sorted(delay for name in names for delay in self._delays[name])
                self._delays |= {name: [] for name in names}
                row = msgspec.structs.replace(
                    row,
                    lost=sum(sum(status.lost.values()) for status in statuses),
                    missed=statuses[0].missed,  # the process counts these, not the robot
                    ticks=statuses[0].ticks,
                    malformed=statuses[0].malformed,
                    received=len(delays),
                    delay_s=round(delays[len(delays) // 2], 6) if delays else None,
                    longest_s=round(delays[-1], 6) if delays else None,
                )
            yield row


WARM_SHARE: Final = 0.5  # of the run that does not count (a recorder fills its pools for 150 s), but not more than
WARM_S: Final = 300.0
WINDOW: Final = 0.1  # share of what counts that is compared at both ends
GROWTH: Final = 0.02  # of the memory
JUDGED_S: Final = 300.0  # memory of a shorter run says nothing: allocators are still filling their pools
SLOWER: Final = 2.0  # times the delay at the beginning
DELAY_S: Final = 0.005  # delays below are the noise of the machine
MISSED: Final = 0.01  # share of the ticks


def soak(
    file: Annotated[str, typer.Argument(metavar="[FILE]", help="Experiment file.")] = "endurance",
    *,
    minutes: Annotated[float, typer.Option(min=0.1, max=1440.0, help="How long.")] = 60.0,
    case: Case = None,
    out: Out = None,
    settings: Settings = None,
    bodies: Bodies = None,
    as_json: AsJson = False,
) -> int:
    """Run an experiment for long and say whether anything grows, is lost, slows down or dies."""
    read = load(file, *(settings or []), f"duration_s={60.0 * minutes!r}")
    name = case or next(iter(read.cases()))
    folder = new_folder(read, out)
    sampler = Sampler(chosen(read, [name])[name], folder)
    with interrupts() as interrupted:
        user = Supervision(sampler, interrupted)
        try:
            ended = conduct(read, folder, RunOptions([name], bodies, here=True), user)
            if ended.failures and not interrupted():
                sampler.end_early(RunFailed("; ".join(ended.failures)))
        except ExplainedError as error:
            sampler.end_early(error)
        soaked = sampler.result(interrupted=interrupted() or bool(user.emergency))
    findings = judge(soaked)
    failed = any(finding.mark == "bad" for finding in findings)
    shown = {"run": folder, "passed": not failed, "findings": findings}
    print_result(shown, *columns(table(soaked)), *map(str, findings), f"results: {folder}", as_json=as_json)
    return 130 if soaked.interrupted else int(failed)


class Ends(NamedTuple):
    """Rows of a process after the warm-up: first and last window."""

    first: Sequence[SoakSample]
    last: Sequence[SoakSample]

    def over(self, what: Callable[[Iterable[float]], float], name: str) -> tuple[float, float]:
        """A statistic of a field in both windows."""
        first, last = (what(getattr(row, name) for row in rows) for rows in self)
        return first, last

    @property
    def growth(self) -> float:
        """Growth of the memory, as a share of the first."""
        first, last = self.over(statistics.median, "rss_mb")
        return last / first - 1.0 if first else 0.0


def warm_s(soaked: Soaked) -> float:
    """From then on it counts [s]."""
    return min(WARM_SHARE * soaked.duration_s, WARM_S)


def ends(soaked: Soaked) -> dict[str, Ends]:
    """Both ends of each process that has enough rows to have them, by name."""
    found = {}
    for process in sorted({row.process for row in soaked.rows}):
        counted = [row for row in soaked.rows if row.process == process and row.time_s >= warm_s(soaked)]
        size = max(2, round(WINDOW * len(counted)))
        if len(counted) >= 2 * size:
            found[process] = Ends(counted[:size], counted[-size:])
    return found


def judge(soaked: Soaked) -> list[VerdictLine]:
    """The verdict; bad findings fail it."""
    both, last = ends(soaked), {row.process: row for row in soaked.rows}
    found = [*_alive(soaked), _memory(soaked, both)]

    def add(wrong: str, right: str, mark: Mark = "bad") -> None:
        found.append(VerdictLine(mark, wrong) if wrong else VerdictLine("good", right))

    def total(counted: str) -> int:
        return sum(getattr(row, counted) or 0 for row in last.values())

    for what, counted in (("threads", "threads"), ("file descriptors", "files")):
        counts = {process: each.over(max, counted) for process, each in both.items()}
        grown = ", ".join(f"{process} +{after - first}" for process, (first, after) in counts.items() if after > first)
        add(grown and f"{what} grow: {grown}", f"{what} do not grow")
    lost = ", ".join(f"{process} {row.lost}" for process, row in last.items() if row.lost)
    received = sum(row.received or 0 for row in soaked.rows)
    untested = "" if received else "no pose was received: nothing was tested"
    add(f"lost poses: {lost}" if lost else untested, f"0 of {received} poses were lost")
    malformed = total("malformed")
    add(f"{malformed} payloads were refused as malformed" if malformed else "", "no payload was refused")
    windows = [
        [row.delay_s for each in both.values() for row in each[end] if row.delay_s is not None] for end in (0, 1)
    ]
    if all(windows):
        before, after = map(statistics.median, windows)
        longest = max(row.longest_s or 0.0 for row in soaked.rows)
        text = (
            f"delay of poses: {1e3 * before:.2f} ms at first, {1e3 * after:.2f} ms at last, {1e3 * longest:.0f} at most"
        )
        add(text if after > max(SLOWER * before, DELAY_S) else "", text)
    if ticks := total("ticks"):
        share = total("missed") / ticks
        text = f"{total('missed')} of {ticks} ticks were missed ({100.0 * share:.3f} %)"
        add(text if share >= MISSED else "", text, "fair")
    return found


def _alive(soaked: Soaked) -> list[VerdictLine]:
    lasted, sampled = max((row.time_s for row in soaked.rows), default=0.0), {row.process for row in soaked.rows}
    bad = [f"{name} {what}" for name, what in soaked.failed.items()]
    bad += [f"{name} never had a process" for name in soaked.robots if name not in sampled | soaked.failed.keys()]
    if soaked.interrupted:
        bad.append(f"it was interrupted after {lasted:.0f} s of {soaked.duration_s:g} s")
    good = f"all {len(soaked.robots)} robots lived through {lasted / 60.0:.1f} minutes"
    return [VerdictLine("bad", text) for text in bad] or [VerdictLine("good", good)]


def _memory(soaked: Soaked, both: Mapping[str, Ends]) -> VerdictLine:
    if not both:
        return VerdictLine("bad", "too few samples to compare beginning and end: let it run longer")
    grown = {process: each.growth for process, each in both.items()}
    most = max(grown, key=lambda process: grown[process])
    text = f"memory: largest growth after {warm_s(soaked):.0f} s is {100 * grown[most]:+.2f} % ({most})"
    if soaked.duration_s < JUDGED_S:
        return VerdictLine("plain", f"{text}; not judged below {JUDGED_S / 60:.0f} minutes")
    return VerdictLine("bad" if grown[most] > GROWTH else "good", f"{text}, limit {100 * GROWTH:g} %")


def table(soaked: Soaked) -> list[tuple[str, ...]]:
    """A head and a row for each process: resident memory after the warm-up and at the end, CPU as share of a core."""
    head = ("process", "MB first", "MB last", "growth", "threads", "files", "CPU", "lost", "missed", "delay [ms]")
    rows: list[tuple[str, ...]] = [head]
    for process, each in ends(soaked).items():
        last, first = each.last[-1], each.first[0]
        share = 100.0 * (last.cpu_s - first.cpu_s) / max(last.time_s - first.time_s, 1e-9)
        delays = [row.delay_s for row in soaked.rows if row.process == process and row.delay_s is not None]
        memory = (f"{size:.1f}" for size in each.over(statistics.median, "rss_mb"))
        counts = (NONE if count is None else str(count) for count in (last.lost, last.missed))
        delay = f"{1e3 * statistics.median(delays):.2f}" if delays else NONE
        sizes = f"{100 * each.growth:+.2f} %", str(last.threads), str(last.files), f"{share:.1f} %"
        rows.append((process, *memory, *sizes, *counts, delay))
    return rows
