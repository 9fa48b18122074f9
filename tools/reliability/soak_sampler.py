"""Samples of a soak: a process beside the run counts what its processes take and what its robots receive."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import msgspec
import zenoh

from agents.clock import Clock
from agents.network import messages, pubsub
from agents.network import session as network
from agents.network.endpoints import free_endpoint
from agents.network.keys import Keys
from experiments.definition.experiment import Experiment
from experiments.real_time.conductor.run_view import RunFailed
from experiments.real_time.hosts.launcher import Launcher
from tools.reliability.run_process import Request, WatchedRun, usage_of
from tools.reliability.soak_verdict import COLUMNS, Row, Soaked
from tools.reliability.spoilt_process import OTHER

SAMPLE_S: Final = 5.0
SAMPLES: Final = 60  # at least so many, however short it is
POLL_S: Final = 0.1
START_S: Final = 120.0  # 20 robots on a small machine take their time
ROUTER_S: Final = 30.0
OVER_S: Final = 90.0  # landing, and the end of the recording
TABLE: Final = "soak.csv"
PRINT_S: Final = 60.0


class Receiver:
    """The last status of each robot, and the delays [s] of the poses that it received since the last sample."""

    def __init__(self, session: zenoh.Session, keys: Keys, robots: Sequence[str]) -> None:
        self.status: dict[str, messages.Status] = {}
        self.delays: dict[str, list[float]] = {name: [] for name in robots}
        statuses = pubsub.pose_subscriber(session, keys.status("*"), 4096)
        self._statuses = pubsub.Inbox(statuses, messages.Status, keys=keys, robots=self.delays)
        states = pubsub.subscriber(session, keys.state("*"), 16384)
        self._states = pubsub.Inbox(states, messages.State, keys=keys, robots=self.delays)

    def read(self) -> None:
        """Take in what has been received since the last call."""
        self.status |= {status.robot: status for status in self._statuses.read()}
        for state in self._states.read():
            if state.phase == "running":
                self.delays[state.robot] += [pose.arrived - pose.stamp for pose in state.received]

    def sampled(self, row: Row) -> Row:
        """The row of a process with the counters of its robots, whose delays begin anew; others stay as they are."""
        members = [name for name in row.process.split("+") if name in self.status]
        if not members:
            return row
        delays = sorted(delay for name in members for delay in self.delays[name])
        for name in members:
            self.delays[name].clear()
        first = self.status[members[0]]
        return msgspec.structs.replace(
            row,
            lost=sum(sum(self.status[name].lost.values()) for name in members),
            missed=first.missed,  # the process counts these, not the robot
            ticks=first.ticks,
            malformed=first.malformed,
            heard=len(delays),
            delay_s=round(delays[len(delays) // 2], 6) if delays else None,
            longest_s=round(delays[-1], 6) if delays else None,
        )


def rows(found: Mapping[int, str], receiver: Receiver, t: float, recording: Path) -> Iterator[Row]:
    """A row for each process, by its id and role, `t` [s] after the common start."""
    for pid, name in found.items():
        usage = usage_of(pid)
        if usage is None or name == OTHER:
            continue
        row = Row(round(t, 2), name, round(usage.rss_mb, 3), usage.threads, usage.files, usage.cpu_s)
        if name == "recorder" and recording.exists():
            row = msgspec.structs.replace(row, recording_mb=round(recording.stat().st_size / 1e6, 3))
        yield receiver.sampled(row)


def sample(experiment: Experiment, request: Request, interrupted: Callable[[], bool]) -> Soaked:  # noqa: PLR0915
    """Run a case and sample it until it is over; print a line a minute on standard error.

    Raises:
        RunFailed: If it does not begin.
    """
    folder, duration = Path(request.folder), experiment.duration_s
    groups: dict[str, list[str]] = {}
    for name, robot in experiment.robots.items():
        groups.setdefault(robot.process or name, []).append(name)
    recording, every = folder / f"{request.case}.mcap", min(SAMPLE_S, duration / SAMPLES)
    endpoint = free_endpoint(preferred_port=0)
    request.changes.append(f"network.listen=['{endpoint}']")
    sampled: list[Row] = []
    died: dict[str, float] = {}
    start: float | None = None
    began = printed = time.monotonic()
    with ExitStack() as stack:
        launcher = stack.enter_context(Launcher(folder / "logs"))
        watched = WatchedRun(launcher, request)
        session = stack.enter_context(network.open_session([endpoint], name="soak", wait_s=ROUTER_S))
        receiver = Receiver(session, Keys(experiment.network.realm), list(experiment.robots))
        table = stack.enter_context((folder / TABLE).open("w", newline="", encoding="utf-8"))
        written = csv.writer(table)
        written.writerow(COLUMNS)
        due, over, clock = 0.0, False, Clock()
        while watched.process.alive and not interrupted():
            time.sleep(POLL_S)
            receiver.read()
            now = clock.utc()
            for event in watched.news():
                if event.kind == "start":
                    start = event.stamp
                    due = start + every
                elif event.kind == "lost" and start is not None and now < start + duration:
                    died[event.source] = round(now - start, 1)
                over |= event.kind == "phase" and event.text.startswith("landing")
            if start is None:
                if time.monotonic() > began + START_S:
                    raise RunFailed(f"no common start within {START_S:g} s: see {folder / 'logs'}")
                continue
            if over or now < due or now > start + duration:
                if now > start + duration + OVER_S:
                    raise RunFailed(f"it does not end {OVER_S:g} s after its time: see {folder / 'logs'}")
                continue
            due += every
            fresh = list(rows(watched.processes(), receiver, now - start, recording))
            sampled += fresh
            written.writerows(msgspec.structs.astuple(row) for row in fresh)
            table.flush()
            if time.monotonic() > printed + PRINT_S:
                printed = time.monotonic()
                lost, memory = sum(row.lost or 0 for row in fresh), sum(row.rss_mb for row in fresh)
                minutes = f"{(now - start) / 60.0:6.1f} of {duration / 60.0:g} min"
                print(f"{minutes}: {len(fresh)} processes, {memory:.0f} MB, {lost} poses lost", file=sys.stderr)
        asked = interrupted()
        watched.end()
        code = watched.process.handle.poll()
    if start is None and not asked:
        raise RunFailed(f"it never began: {watched.process.tail()}")
    return Soaked(experiment.title, tuple(map("+".join, groups.values())), duration, sampled, code, died, asked)
