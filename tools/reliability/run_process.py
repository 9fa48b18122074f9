"""A run in a process of its own, to be watched from outside: `python -m tools.reliability.run_process REQUEST`.

The request is a struct as JSON. Each event of the conductor is a line of JSON on standard output. Standard input is the
lifeline: when it is lost, all robots land.
"""

from __future__ import annotations

import resource
import secrets
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from agents.errors import ExplainedError
from agents.network import messages
from agents.runtime.command_line import on_termination
from agents.runtime.lifeline import Lifeline
from experiments.file.document import load
from experiments.real_time.conductor.conduct import RunOptions, Supervision, conduct
from experiments.real_time.conductor.run_view import Progress
from experiments.real_time.hosts.launcher import RUN, Launcher, Process, tagged
from tools.progress import Lines
from tools.reliability import spoilt_process
from tools.reliability.spoilt_process import ROBOT, role_of

PAGE: Final = resource.getpagesize()
PROC: Final = Path("/proc")
NAME: Final = "conductor"
END_S: Final = 45.0  # landing, recording and router of an interrupted run


class Request(msgspec.Struct):
    """A run in real time."""

    file: str  # experiment file, or a name of the catalogue
    folder: str  # for recordings and logs; it exists
    case: str
    changes: list[str] = []  # as behind `--set`
    bodies: str | None = None  # as behind `--bodies`
    cables: dict[str, dict[str, str]] = {}  # for each process of robots, its endpoint in place of each router's
    switches: str | None = None  # folder, with which `tools.reliability.spoilt_process` spoils processes


class CabledLauncher(Launcher):
    """Starts robots that find their routers at the ends of cables of their own, and processes that can be spoiled."""

    def __init__(self, cables: Mapping[str, Mapping[str, str]], switches: str | None, logs: Path) -> None:
        super().__init__(logs)
        self._cables, self._switches = cables, switches

    def start(self, name: str, module: str, *arguments: str) -> Process:
        own = next((ends for process, ends in self._cables.items() if name.endswith(f"-{process}")), {})
        if module == ROBOT:
            arguments = tuple(own.get(word, word) for word in arguments)
        if self._switches is not None:
            module, arguments = spoilt_process.MODULE, (self._switches, module, *arguments)
        return super().start(name, module, *arguments)


class EventLines(Lines):
    """Prints each event once, as a line of JSON."""

    def __call__(self, progress: Progress) -> None:
        if events := self._news.new_events(progress):
            sys.stdout.buffer.write(b"".join(messages.encode(event) + b"\n" for event in events))
            sys.stdout.buffer.flush()


def main() -> int:
    """Run the request of the command line."""
    request = msgspec.json.decode(sys.argv[1], type=Request)
    over = threading.Event()
    Lifeline(over).start()
    try:
        with on_termination(over.set):
            conduct(
                load(request.file, *request.changes),
                Path(request.folder),
                RunOptions(cases=[request.case], bodies=request.bodies, here=True),
                Supervision(
                    EventLines(), over.is_set, launching=partial(CabledLauncher, request.cables, request.switches)
                ),
            )
    except ExplainedError as error:
        print(f"zenpark: {error}", file=sys.stderr)
        return 2
    return 0


class WatchedRun:
    """A run in a process of its own, and its events."""

    def __init__(self, launcher: Launcher, request: Request) -> None:
        """Start it; `launcher` holds its lifeline."""
        self._launcher = launcher
        self.tag = f"{RUN}={secrets.token_hex(8)}"  # in the environment of all its processes
        spoilt = [] if request.switches is None else [spoilt_process.MODULE, request.switches]
        words = [sys.executable, "-m", *spoilt, "tools.reliability.run_process", msgspec.json.encode(request).decode()]
        self.process: Process = launcher.spawn(NAME, ["env", self.tag, *words])
        self.output: list[str] = []  # lines that were no events

    def news(self) -> Iterator[messages.Event]:
        """Events since the last call."""
        for line in self.process.news():
            try:
                yield messages.decode(line.encode(), messages.JSON, messages.Event)
            except messages.Malformed:
                self.output.append(line)

    def processes(self) -> dict[int, str]:
        return {pid: role_of(words) for pid, words in tagged(self.tag)}

    def close(self) -> None:
        """Cut the lifeline, as the death of its holder does, and do not wait."""
        assert self.process.handle.stdin is not None
        self.process.handle.stdin.close()

    def end(self) -> None:
        """Land the robots and end all processes."""
        self._launcher.end([NAME], grace_s=END_S)


class Usage(NamedTuple):
    """Resources of a process."""

    rss_mb: float  # resident memory [MB]
    threads: int
    files: int  # open file descriptors
    cpu_s: float  # CPU time since it began [s]


def usage_of(pid: int) -> Usage | None:
    """Resources of a process; None if it has ended."""
    folder = PROC / str(pid)
    try:
        fields = (folder / "stat").read_bytes().rpartition(b")")[2].split()
        files = sum(1 for _ in (folder / "fd").iterdir())
        cpu_s = time.clock_gettime(~pid << 3 | 2)  # clock_getcpuclockid(3): exact, where /proc counts in 10 ms
    except OSError:
        return None
    # counted from the state, which is field 3 of proc_pid_stat(5): num_threads 20, rss 24
    return Usage(round(int(fields[21]) * PAGE / 1e6, 3), int(fields[17]), files, cpu_s)


if __name__ == "__main__":
    sys.exit(main())
