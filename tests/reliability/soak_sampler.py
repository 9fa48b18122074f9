"""Samples of a soak: what the processes of a run take, and what its robots receive, as a table that grows on disk."""

from __future__ import annotations

import csv
import os
import resource
import secrets
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from agents.safety.hazards import failed
from experiments.definition.plan import Plan
from experiments.real_time.conductor.run_view import EventFeed, Progress, RobotView
from experiments.real_time.hosts.launcher import RUN, tagged
from tests.reliability.spoilt_process import CONDUCTOR, OTHER, role_of

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
