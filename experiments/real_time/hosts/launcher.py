"""Starts, watches and ends processes; whatever happens to the launcher, none of them outlives it long.

A process on another machine is an `ssh` here, which hands input, output and exit code through
(`experiments.real_time.hosts.hosts`).

Each process holds its standard input as a lifeline (`agents.runtime.lifeline`): the launcher writes a byte to it now
and then, and closing it is the order to end. A killed launcher closes it too. An emergency stop is written there as
well, also to robots on other machines.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import IO, Final, Self

from agents.body.limits import LOWEST_DESCENT_M_S
from agents.clock import Clock, uptime
from agents.errors import ExplainedError
from agents.network import messages
from agents.network.endpoints import from_here
from agents.runtime.lifeline import BEAT_S, SILENCE_S, stop_line
from agents.ticks import POLL_S
from experiments.real_time.processes import zygote
from experiments.real_time.processes.zygote import Forked, NoZygote

ROUTER: Final = "router"  # the first; others are router2, router3, ...
ZYGOTE: Final = "zygote"
LAND_S: Final = 15.0  # least time for robots to come down after their lifeline was cut
LINGER_S: Final = 15.0  # the router outlives a killed conductor, so that the landing is recorded
READY_S: Final = 15.0  # limit for a process to say that it is ready
TURN_S: Final = 0.2  # time for which an end is awaited at once
STOP_PATIENCE_S: Final = 0.1  # patience for the lock of the list of processes
TAIL: Final = 12  # lines of a dead process's output that are worth showing

Handle = subprocess.Popen[bytes] | Forked


@dataclass
class Process:
    """A started process: its name, its handle, and the file that its output goes to."""

    name: str
    handle: Handle
    lifeline: IO[bytes]  # its standard input
    log: Path  # begins with the output of processes of this name before it
    begins: int  # [bytes] begin of its own output there
    shown: int  # [bytes] end of what `news` has returned
    unsent: bytearray = field(default_factory=bytearray)  # input that its pipe has not taken yet
    robots: Sequence[str] = ()  # robots that it drives
    begun: float = field(default_factory=time.monotonic)  # [s]
    fault: str = ""  # reason why it was killed

    @property
    def alive(self) -> bool:
        return self.handle.poll() is None

    @property
    def killed(self) -> bool:
        return self.handle.poll() in {None, -signal.SIGKILL}

    @property
    def exit(self) -> str:
        code = self.handle.poll()
        if code is None:
            return "still running"
        if self.fault:
            return self.fault
        if code == zygote.UNKNOWN:
            return "exit code unknown"
        return f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"

    @property
    def output(self) -> str:
        return self.log.read_bytes()[self.begins :].decode(errors="replace")

    def news(self) -> list[str]:
        """New whole lines of its output."""
        try:
            with self.log.open("rb") as output:
                output.seek(self.shown)
                lines, ended, _ = output.read().rpartition(b"\n")
        except OSError:
            return []
        self.shown += len(lines) + len(ended)
        return lines.decode(errors="replace").splitlines()

    def says(self, robot: str, phase: str) -> bool:
        """Whether its output reports this phase of a robot."""
        with contextlib.suppress(OSError):
            return re.search(rf"^{robot}: {phase}\b", self.output, re.MULTILINE) is not None
        return False

    def tail(self) -> str:
        try:
            lines = self.output.splitlines()
        except OSError:
            return ""
        return "\n".join(lines[-TAIL:])

    @property
    def because(self) -> str:
        """Last output line with a leading colon, for messages; may be empty."""
        return "".join(f": {line}" for line in self.tail().strip().splitlines()[-1:])

    def await_lines(self, pattern: str, count: int, interrupted: Callable[[], bool]) -> dict[str, str]:
        """Wait until it has printed `count` lines of a form; returns the two groups of each."""
        deadline = time.monotonic() + READY_S
        while True:
            found = dict(re.findall(pattern, self.output, re.MULTILINE))
            if len(found) >= count:
                return found
            if interrupted() or not self.alive or time.monotonic() > deadline:
                what = "was interrupted" if interrupted() else f"did not start ({self.exit})"
                raise StandInError(f"{self.name} {what}: {self.tail() or 'no output'}")
            time.sleep(POLL_S)

    def write(self) -> None:
        """Write as much of the input as fits into the pipe: the reader may be slow."""
        with contextlib.suppress(OSError, ValueError):  # dead, or frozen with a full pipe
            while self.unsent:
                del self.unsent[: os.write(self.lifeline.fileno(), self.unsent)]

    def close(self) -> None:
        """Cut the lifeline."""
        with contextlib.suppress(OSError):
            self.lifeline.close()

    def forget(self) -> None:
        """Close the pipe of its answers, once it is over."""
        if self.handle.stdout is not None:
            self.handle.stdout.close()

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the process while it runs, and to all that it has started."""
        if self.alive:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.handle.pid, number)


def travel_s(height: float) -> float:
    """Limit [s] for a climb or a landing over a `height` [m], at the speed of the slowest descent."""
    return max(LAND_S, height / LOWEST_DESCENT_M_S)


class Launcher:
    """Processes of one run; a context manager that leaves none behind."""

    def __init__(self, logs: Path) -> None:
        """Output of each process goes to a file in the folder `logs`."""
        self._logs = logs
        self.land_s = LAND_S  # longest landing of its robots [s]
        # the clock of modules that are started here; None: each reads the wall clock itself
        self.clock: Clock | None = None
        self._processes: dict[str, Process] = {}
        self._zygote: Path | None = None  # its socket; None if there is none, or none any more
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._silence_at, self._beat_at = -inf, uptime()
        self._line = b"\n"  # line of each heartbeat
        self._beat = threading.Thread(target=self._beats, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self._logs.mkdir(parents=True, exist_ok=True)
        self._beat_at = uptime()
        self._beat.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end([name for name in self._processes if not is_router(name)], grace_s=self.land_s)
        self.end(list(self._processes), grace_s=0.0)  # all robots are down: no router is needed any more
        self._forget_zygote()
        self._over.set()
        self._beat.join()

    def preload(self) -> None:
        """Start the zygote, which imports what robots need while others are started."""
        with contextlib.suppress(NoZygote):
            path = zygote.address(secrets.token_hex(8))
            with zygote.listen(path) as listener:
                self.spawn(ZYGOTE, zygote.command(listener), inherited=[listener.fileno()])
            self._zygote = path

    def start(self, name: str, module: str, *arguments: str, forked: bool = False) -> Process:
        """Start a module of this project in a process and session of its own; one thread per numeric library.

        `forked` by the zygote, if there is one: it starts at once, and shares what it imports with the others.
        """
        shared = {} if self.clock is None else self.clock.shared()
        if forked and (path := self._zygote) is not None:
            request = zygote.Request(name, module, arguments, shared)
            try:
                return self._begin(name, lambda log: _fork(request, path, log))
            except NoZygote:
                self._forget_zygote()
        return self.spawn(name, [sys.executable, "-m", module, *arguments], environment=shared)

    def spawn(
        self,
        name: str,
        command: Sequence[str],
        *,
        first_input: bytes = b"",
        answers: bool = False,
        environment: Mapping[str, str] | None = None,
        inherited: Sequence[int] = (),
    ) -> Process:
        """Start any command that holds its standard input as a lifeline.

        Args:
            first_input: Read there before the first heartbeat.
            answers: Its standard output is the caller's to read, and only its errors are logged.
            environment: Added to the launcher's own.
            inherited: File descriptors that it keeps, by the same numbers.
        """

        def popen(log: IO[bytes]) -> subprocess.Popen[bytes]:
            return subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if answers else log,
                stderr=log,
                start_new_session=True,  # Ctrl-C is the launcher's: it lands the robots first
                env={**os.environ, **zygote.ONE_THREAD, "PYTHONUNBUFFERED": "1", **(environment or {})},
                pass_fds=inherited,
            )

        return self._begin(name, popen, first_input)

    def _begin(self, name: str, start: Callable[[IO[bytes]], Handle], first_input: bytes = b"") -> Process:
        """Start a process in one of the ways, with its log, and hold its lifeline."""
        log = self._logs / f"{name}.log"
        with log.open("ab") as output:
            begins = os.fstat(output.fileno()).st_size
            handle = start(output)
        assert handle.stdin is not None
        os.set_blocking(handle.stdin.fileno(), False)  # a stopped process must not stop the heartbeat of the others
        process = Process(name, handle, handle.stdin, log, begins, begins, bytearray(first_input))
        with self._lock:
            self._processes[name] = process
            process.write()
        return process

    def tell(self, name: str, line: bytes) -> None:
        """Send a line on the lifeline of a process, behind all that it has not read yet."""
        with self._lock:
            if name in self._processes:
                self._processes[name].unsent += line
                self._processes[name].write()

    def send_line(self, process: Process, line: bytes) -> None:
        """Send a line on the lifeline of a process; it is dropped if the process has not read the last one."""
        with self._lock:
            if not process.unsent:
                process.unsent += line
                process.write()

    def stop(self, stop: messages.Stop) -> None:
        """Write an emergency stop to all processes at once, and instead of each heartbeat from now on.

        So it is read by processes that start later, too. Those that are no robots skip it.
        """
        self._line = stop_line(stop)
        patient = self._lock.acquire(timeout=STOP_PATIENCE_S)  # its holder may wait for a frozen zygote
        try:
            for process in list(self._processes.values()):
                if process.handle.stdout is None:  # else it expects questions
                    process.unsent += self._line
                    process.write()
        finally:
            if patient:
                self._lock.release()

    def stopped(self) -> dict[str, bool]:
        """Robots with a running process, and whether its output says that they are down with motors off."""
        running = [process for process in list(self._processes.values()) if process.robots and process.alive]
        return {robot: process.says(robot, "done") for process in running for robot in process.robots}

    def get(self, name: str) -> Process:
        return self._processes[name]

    def running(self, name: str) -> bool:
        with self._lock:
            return name in self._processes and self._processes[name].alive

    def release(self, name: str) -> None:
        """Cut the lifeline of a process: robots land by themselves, then it ends, which `died` reports."""
        with self._lock:
            if name in self._processes:
                self._processes[name].close()

    def kill(self, name: str, fault: str = "") -> None:
        """End a process that ignores its lifeline, at once; `died` reports its end, with its `fault` if one is said."""
        with self._lock:
            if name in self._processes:
                self._processes[name].fault = fault
                self._processes[name].signal(signal.SIGKILL)

    def age(self, name: str) -> float:
        """Time since the start of a process [s]; 0 if none of this name runs."""
        with self._lock:
            process = self._processes.get(name)
        return time.monotonic() - process.begun if process is not None and process.alive else 0.0

    def died(self) -> list[Process]:
        """Processes that have ended by themselves since the last call; they are forgotten."""
        with self._lock:
            dead = [process for process in self._processes.values() if not process.alive]
            for process in dead:
                del self._processes[process.name]
        for process in dead:
            process.close()
            process.forget()
        return dead

    def end(self, names: Iterable[str], grace_s: float) -> list[Process]:
        """End processes: end of file on the lifeline, after `grace_s` SIGTERM, then SIGKILL; return them."""
        with self._lock:
            ending = [self._processes.pop(name) for name in names if name in self._processes]
        for process in ending:
            process.close()
        self._wait(ending, grace_s)
        for number, wait_s in ((signal.SIGTERM, 2.0), (signal.SIGKILL, 2.0)):
            stubborn = [process for process in ending if process.alive]
            for process in stubborn:
                process.signal(number)
            self._wait(stubborn, wait_s)
        for process in ending:
            process.forget()
        return ending

    def _forget_zygote(self) -> None:
        if self._zygote is not None:
            self._zygote.unlink(missing_ok=True)
            self._zygote = None

    @staticmethod
    def _wait(processes: Sequence[Process], limit_s: float) -> None:
        """Wait for the ends of processes; a suspension of this one, with which they may have stood, is one turn."""
        left_s = limit_s
        for process in processes:
            while left_s > 0.0 and process.alive:
                begun = time.monotonic()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.handle.wait(min(TURN_S, left_s))
                left_s = round(left_s - min(time.monotonic() - begun, TURN_S), 6)

    @property
    def last_silence(self) -> float:
        """Time of the last silence of the heartbeat that made all processes land and end [s, `uptime`]; -inf: none.

        A machine that sleeps is silent, too.
        """
        now = uptime()
        return now if now - self._beat_at > SILENCE_S + BEAT_S else self._silence_at

    def _beats(self) -> None:
        while not self._over.wait(BEAT_S):
            self._silence_at, self._beat_at = self.last_silence, uptime()
            with self._lock:
                for process in self._processes.values():
                    line = self._line if process.handle.stdout is None else b"\n"
                    process.unsent += b"" if process.unsent else line
                    process.write()


def _fork(request: zygote.Request, path: Path, log: IO[bytes]) -> Forked:
    """Have a zygote fork a process that holds a pipe from here as its lifeline; raises NoZygote."""
    end, stdin = os.pipe()
    held = os.fdopen(stdin, "wb", buffering=0)
    try:
        return zygote.fork(path, request, [end, log.fileno(), log.fileno()], held)
    except NoZygote:
        held.close()
        raise
    finally:
        os.close(end)


class StandInError(ExplainedError):
    """A process that did not start, with its output."""


class RouterEnded(StandInError):
    """A router that ended instead of listening: its port was taken, or its lab cannot be used."""


@dataclass(frozen=True)
class Router:
    name: str  # name of its process
    listen: Sequence[str]  # places where it listens
    # routers before it, which it connects to for as long as it lives, so that any two are linked once
    link: Sequence[str] = ()

    def start(self, launcher: Launcher, rights: Path | None = None, *, forked: bool = False) -> Process:
        """Start the router; it outlives a killed launcher until robots have landed. In a lab it enforces `rights`.

        `forked` as of `Launcher.start`: for robots that wait.
        """
        listen = [part for endpoint in self.listen for part in ("--listen", endpoint)]
        link = [part for endpoint in self.link for part in ("--connect", endpoint)]
        enforced = [] if rights is None else ["--rights", str(rights)]
        linger = ["--lifeline", "--linger", str(LINGER_S)]
        return launcher.start(self.name, "agents.runtime.router", *listen, *link, *enforced, *linger, forked=forked)


def make_routers(endpoints: Sequence[str], count: int) -> list[Router]:
    """`count` routers, with these endpoints in turn."""
    made: list[Router] = []
    for number in range(count):
        link = [from_here(before.listen[0]) for before in made]
        made.append(Router(f"{ROUTER}{number + 1}" if number else ROUTER, list(endpoints[number::count]), link))
    return made


def is_router(process: str) -> bool:
    return process == ROUTER or process.removeprefix(ROUTER).isdecimal()


def start_routers(launcher: Launcher, routers: Sequence[Router], rights: Path | None) -> None:
    """Start routers, and wait until they listen.

    Without that, robots would join a stranger's router where another run took the port at the same moment. Raises
    RouterEnded if one ends instead, StandInError if one does not listen in time.
    """
    for process in [router.start(launcher, rights) for router in routers]:
        try:
            process.await_lines(r"^(router) (ready)\b", 1, lambda: False)
        except StandInError as error:
            raise (error if process.alive else RouterEnded(str(error))) from None


RUN: Final = "ZENPARK_RUN"  # variable of every process of a run, here or on a host, by which they are found


def tagged(tag: str) -> Iterator[tuple[int, list[str]]]:
    """Ids and command lines of running processes with a tag NAME=VALUE in their environment; zombies have none."""
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # another user's, or ended meanwhile
            if tag.encode() in (folder / "environ").read_bytes().split(b"\0"):
                words = (folder / "cmdline").read_bytes().rstrip(b"\0")  # a forked process has many at the end
                yield int(folder.name), words.decode(errors="replace").split("\0")
