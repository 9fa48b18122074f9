"""The other machines of an experiment, reached through the system's `ssh` with the user's own configuration and keys.

Each host has one connection to a `./zenpark station`, which tells its version and its clock, and carries the hosts' way
to a router that listens on loopback only. Each robot's process has a connection of its own: what it prints, its exit
code and its lifeline are those of the `ssh` here.

Clocks are measured before a run and every second in it: a host that drifts by 50 ppm is 0.18 s off after an hour. The
robots' processes get their new correction on their lifelines (`agents.clock`), which only the launcher holds; no
network of the experiment is needed. A correction moves only as far as a measurement proves that it is off.
"""

from __future__ import annotations

import os
import secrets
import select
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Final, Self

import msgspec

from agents import clock
from agents.clock import STEP_S, Clock, wait_until
from agents.errors import ExplainedError
from agents.network import lab, messages
from agents.network.endpoints import Endpoint
from agents.network.messages import HostClock
from agents.runtime.lifeline import stop_in
from experiments.definition.experiment import Host
from experiments.definition.plan import Plan
from experiments.real_time.hosts import certificates, ssh
from experiments.real_time.hosts.launcher import RUN, Launcher, Process
from experiments.real_time.hosts.run_registry import own_entry
from experiments.real_time.hosts.station import Answer, Question
from experiments.recording import clocks, version

HELLO_S: Final = 60.0  # the first start of a zenpark that was changed brings its packages up to date
ANSWER_S: Final = 5.0
SAMPLES: Final = 24  # readings of a clock before a run
DRIFT_SAMPLES: Final = 8  # readings of a clock in a run, with this period
DRIFT_S: Final = 1.0  # NTP slews a clock by at most 500 ppm: 0.5 ms
HANDSHAKES: Final = 6  # connections at once with one machine: sshd refuses some of more than ten (MaxStartups)
STATION: Final = "host@"  # prefix of the process of the connection to a host: no name of a case has this sign


class HostError(ExplainedError):
    """Hosts that cannot take part, with reason and remedy."""


def run_script(
    name: str, host: Host, script: Sequence[object], given: bytes, *, limit_s: float, late: str, failed: str = ""
) -> str:
    """Run a script in the plain shell of a host; return its output.

    Args:
        host: Has an address.
        script: Its text, and its words from $0 on.
        given: What it finds on its standard input.
        late: Message if it is not.
        failed: Before the reason if it fails.
    """
    assert host.address is not None
    try:
        command = ssh.command(host.address, ["sh", "-c", *map(str, script)])
        done = subprocess.run(command, input=given, capture_output=True, check=False, timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise HostError(f"{name}: {late}") from None
    errors = done.stderr.decode(errors="replace").strip()
    if done.returncode == ssh.BROKEN:
        raise HostError(f"{name}: {ssh.explained(host.address, host.zenpark, errors)}")
    if done.returncode:
        raise HostError(f"{name}: {failed}{errors or 'without a message'}")
    return done.stdout.decode(errors="replace")


class Station:
    """The connection to a host's station."""

    def __init__(
        self,
        name: str,
        host: Host,
        *,
        launcher: Launcher,
        routers: Sequence[str],
        run: str,
        obey: Callable[[messages.Stop], object] = lambda _: None,
    ) -> None:
        """Begin to connect; `greet` waits for the station.

        Args:
            host: Has an address.
            launcher: Starts the ssh, and keeps its lifeline.
            routers: As this machine reaches them; those on loopback go through this connection. Of a lab, if any is.
            run: By which the station finds the run's processes.
            obey: Gets the emergency stops that were ordered on the host.
        """
        assert host.address is not None
        self.name, self.host = name, host
        self.address = host.address
        self.clock: HostClock | None = None  # the last measurement
        self.lab = lab.lab_of(routers)  # folder on this machine
        self._routers = [Endpoint.parse(router) for router in lab.bare(routers)]
        self._run = f"{run}.{name}"  # two hosts may be one machine
        try:
            carried = [("-R", ssh.forwarded(router)) for router in self._routers if router.is_loopback]
        except ValueError as error:
            raise HostError(f"{name}: {error}") from None
        if shutil.which("ssh") is None:
            raise HostError(f"{name}: there is no ssh here; install it (Debian, Ubuntu: apt install openssh-client)")
        words = self.command("station")
        options = [part for pair in carried for part in pair]
        self.process = launcher.spawn(f"{STATION}{name}", ssh.command(self.address, words, options), answers=True)
        stdin, stdout = self.process.handle.stdin, self.process.handle.stdout
        assert stdin is not None
        assert stdout is not None
        self._out, self._in = stdin, stdout
        self._poll = select.poll()
        self._poll.register(stdout.fileno(), select.POLLIN)
        self._rest = b""
        self._starting: list[Process] = []
        self._robots: list[Process] = []
        self._launcher, self._obey = launcher, obey
        self._silent = ""  # reason; empty while it answers
        self.reset_clock()

    def reset_clock(self) -> None:
        """Take the wall clock as it is now: a step of it in mid-run is no drift of the host's."""
        self._clock = Clock()
        # applied: correction of that clock by its robots [s]
        self.applied, self._robots = 0.0, []

    def command(self, *arguments: str) -> list[str]:
        """A zenpark command as it is spelled there, of this run."""
        return ["env", f"{RUN}={self._run}", self.host.zenpark.removeprefix("~/"), *arguments]

    def greet(self, address: str | None = None) -> None:
        """Wait until the station answers; `address` is how hosts know this machine, by default as ssh came from."""
        self.hello, _, _ = self.ask(Question("hello"), HELLO_S)
        ports = iter(ssh.allocated(self.process.output))
        here = address or self.hello.seen_from or "127.0.0.1"
        try:
            # routers as the host reaches them
            self.endpoints = [str(self._reachable_endpoint(router, ports, here)) for router in self._routers]
        except StopIteration:
            raise HostError(f"{self.name}: ssh does not say which port it forwards; use listen in [network]") from None

    @staticmethod
    def _reachable_endpoint(router: Endpoint, ports: Iterator[int], here: str) -> Endpoint:
        if router.is_loopback:
            through = router if router.port else Endpoint("tcp", "", 0, router.rest)
            return through.at("127.0.0.1", next(ports))
        return router.at(here) if router.is_wildcard else router

    def ask(self, question: Question, limit_s: float = ANSWER_S) -> tuple[Answer, float, float]:
        """The answer, when the question left, and when the answer was here, UTC [s]."""
        if self._silent or self._out.closed or self._in.closed:
            raise HostError(self._silent or self._broken())  # its end was noticed before
        deadline = time.monotonic() + limit_s
        text = msgspec.json.encode(question) + b"\n"
        left = self._clock.utc()
        # the output of ssh tells the reason; where the pipe is full, the station is silent
        with suppress(BrokenPipeError, BlockingIOError):
            os.write(self._out.fileno(), text)
        while self._poll.poll(max(0.0, deadline - time.monotonic()) * 1e3):
            data = os.read(self._in.fileno(), 65536)
            back = self._clock.utc()
            if not data:
                raise HostError(self._broken())
            *lines, self._rest = (self._rest + data).split(b"\n")
            found = None
            for line in lines:
                if (stop := stop_in(line)) is not None:
                    self._obey(stop)
                with suppress(msgspec.MsgspecError):  # a greeting of the shell
                    found = msgspec.json.decode(line, type=Answer)
            if found is not None:
                return found, left, back
        # no further question: a late answer would be taken for that to the next one
        self._silent = f"{self.name}: its station says nothing for {limit_s:g} s; is that machine overloaded?"
        raise HostError(self._silent)

    def _broken(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self.process.handle.wait(ANSWER_S)
        output = self.process.output
        return f"{self.name}: {ssh.explained(self.address, self.host.zenpark, output)}"

    @property
    def same_version(self) -> bool:
        return self.hello.zenpark == version.digest()

    def measure(self, samples: int = SAMPLES) -> HostClock:
        """Measure the host's clock, by some round trips."""
        trips = []
        for _ in range(samples):
            answer, left, back = self.ask(Question("clock"))
            trips.append(clocks.ClockSample(left, answer.clock, back))
        offset, uncertainty = clocks.host_offset(trips)
        self.clock = HostClock(self.name, trips[-1].back, offset, uncertainty, self.host.robots, self.applied)
        return self.clock

    def correct(self, applied: float) -> HostClock:
        """Set the correction of the host's clock for its robots [s], those that are started later too."""
        assert self.clock is not None
        self.applied = applied
        for process in self._robots:
            self._launcher.send_line(process, clock.correction_line(-applied))
        self.clock = msgspec.structs.replace(self.clock, applied=applied)
        return self.clock

    def folder_content(self, names: Sequence[str]) -> certificates.FolderContent:
        return self.ask(Question("certificates", lab=self.folder, names=list(names)))[0].content

    def distrusted(self, names: Sequence[str]) -> list[str]:
        """Reasons why its robots and a router would refuse each other, in a lab, each with its remedy."""
        if self.lab is None:
            return []
        answer = self.ask(Question("certificates", lab=self.folder, names=list(names)))[0]
        faults = certificates.faults(answer.content, self.lab, answer.clock)
        return [f"{self.name}: {fault}" for fault in (*faults, *certificates.unnamed(self.endpoints, self.lab))]

    @property
    def folder(self) -> str:
        """Folder of certificates on the host."""
        return self.host.lab.removeprefix("~/")

    def list_run(self, plan: Plan) -> None:
        """Have the run listed on the host, with its robots on all machines, for an `estop` that is typed there."""
        experiment, robots = plan.experiment, dict.fromkeys(plan.names, "")
        realm = experiment.network.realm
        run = own_entry("run", experiment.title or "a run over hosts", self.endpoints, realm=realm, robots=robots)
        self.ask(Question("register", lab=None if self.lab is None else self.folder, run=run))

    def start(self, name: str, robots: Sequence[str], document: bytes) -> Process:
        wait_until(lambda: self._connecting() < HANDSHAKES, HELLO_S)
        connect = [part for endpoint in self.endpoints for part in ("--connect", endpoint)]
        connect += [] if self.lab is None else ["--lab", self.folder]
        correction = f"{-self.applied:.6f}"
        words = self.command("agent", "-", *robots, *connect, f"--clock-correction={correction}", "--lifeline")
        process = self._launcher.spawn(name, ssh.command(self.address, words), first_input=document + b"\n")
        process.robots = tuple(robots)
        self._starting.append(process)
        self._robots.append(process)
        return process

    def _connecting(self) -> int:
        """Number of processes with an ssh that has not connected yet: the other end prints a line at once."""
        self._starting = [each for each in self._starting if each.alive and not each.output]
        return len(self._starting)


class Hosts:
    """The hosts of one run."""

    def __init__(self, launcher: Launcher, routers: Sequence[str]) -> None:
        """Connect no host yet; `routers` as this machine reaches them, or as they listen if that is everywhere."""
        self._launcher, self.routers = launcher, list(routers)
        self.obey: Callable[[messages.Stop], object] = launcher.stop  # gets emergency stops that came from a host
        self._run = secrets.token_hex(8)
        self._stations: dict[str, Station] = {}
        self.by_robot: dict[str, Station] = {}  # stations of the case

    def join(self, plan: Plan) -> list[HostClock]:
        """Connect the hosts of a case with robots and an address; return their clocks. Errors name all obstacles."""
        hosts = plan.experiment.hosts
        wanted = {name: host for name, host in hosts.items() if host.address is not None and host.robots}
        fresh = []
        for name, host in wanted.items():
            known = self._stations.get(name)
            if known is None or (known.address, known.host.zenpark) != (host.address, host.zenpark):
                self._launcher.end([f"{STATION}{name}"], grace_s=0.0)
                self._stations[name] = Station(
                    name, host, launcher=self._launcher, routers=self.routers, run=self._run, obey=self.obey
                )
                fresh.append(self._stations[name])
        trouble = []
        for station in fresh:
            try:
                station.greet(plan.experiment.network.address)
                if not station.same_version:
                    digits = version.DIGEST_CHARACTERS
                    codes = f"{station.hello.zenpark[:digits]}, here {version.digest()[:digits]}"
                    remedy = "`./zenpark hosts install FILE` puts this one there"
                    trouble.append(f"{station.name}: another zenpark is there ({codes}); {remedy}")
                else:
                    trouble += station.distrusted(station.host.robots)
                    if len(station.host.robots) > 1:
                        station.ask(Question("preload"))
                    station.list_run(plan)
            except HostError as error:
                trouble.append(str(error))
        if trouble:
            for station in fresh:
                del self._stations[station.name]
            raise HostError("\n".join(trouble))
        self.by_robot = {robot: self._stations[name] for name, host in wanted.items() for robot in host.robots}
        measured = []
        for station in self.in_use():
            station.host = wanted[station.name]
            station.reset_clock()
            measured.append(station.correct(station.measure().offset))
        return measured

    def in_use(self) -> list[Station]:
        return list(dict.fromkeys(self.by_robot.values()))

    def sweep(self) -> list[str]:
        """Kill remaining processes of the run on every host, and name them; of a silent host the reason."""
        left = []
        for station in self._stations.values():
            try:
                found = station.ask(Question("sweep"))[0].found
                left += [f"{station.name}: process {each.what} {each.text}" for each in found]
            except HostError as error:  # its station does that by itself as soon as the lifeline is lost
                left.append(f"{error}; whether processes are left there is unknown")
                self._launcher.end([station.process.name], grace_s=0.0)
        return left


def applied(now: HostClock, before: float) -> float:
    """Correction of stamps from now on [s]: `before`, moved only by the error that the measurement proves."""
    return min(max(before, now.offset - now.uncertainty), now.offset + now.uncertainty)


class Drift:
    """Measures and corrects the clocks of some hosts in a thread of its own, for an answer may take long."""

    def __init__(self, hosts: Iterable[Station], period_s: float = DRIFT_S) -> None:
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

    def __exit__(self, *_: object) -> None:
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
                except (HostError, OSError, ValueError) as error:  # the pipes of a host that ends now may be closed
                    self._hosts.remove(host)
                    with self._lock:
                        self._trouble.append(f"{error}; its clock is not corrected any more")

    def _measure(self, host: Station) -> None:
        """Measure one clock and correct its robots."""
        before = host.clock
        assert before is not None
        assert before.applied is not None
        now = host.measure(DRIFT_SAMPLES)
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
