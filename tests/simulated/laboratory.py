"""Flights of a whole laboratory on simulated time: `fly` runs one and returns what was seen as plain data.

A flight is the command `./zenpark run` with all processes that it starts, in one process of the operating system, which
is forked for it from a clean one. It takes half a second; the same arguments give the same flight to the last bit.
"""

from __future__ import annotations

import os
import pickle
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import IO, Any

from tests.simulated.faults import Fault

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 400.0  # simulated time of the longest flight
CPU_S = 60  # limit of processor time
SHARED = Path("/dev/shm")

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Mutant:
    """A defect put into the product for one flight: `new` in the place of `old` in the functions of a file."""

    file: str  # "agents/runtime/loop.py"
    old: str  # text that is there exactly once
    new: str


@dataclass(frozen=True)
class Request:
    """All that a flight depends on, beside the product."""

    experiment: str
    script: tuple[Fault, ...] = ()
    seed: int = 1
    case: str | None = None
    settings: tuple[str, ...] = ()
    mutant: Mutant | None = None
    preempt: float = 0.0
    varied: bool = False
    forgets: float = 0.0
    clocks: Mapping[str, float] = field(default_factory=dict)
    limit_s: float = LIMIT_S
    words: tuple[str, ...] = ()
    folder: str | None = None
    drawn: int | None = None  # seed of a random script
    kinds: tuple[str, ...] = ()  # kinds of its faults; empty: all
    sites: int = 0  # routers that run already, each on a machine of its own


@dataclass(frozen=True)
class Event:
    """Event of the run, as its conductor knows it."""

    t: float
    kind: str
    source: str
    text: str


@dataclass(frozen=True)
class Phase:
    """Begin of a phase in the life of a robot, in a process."""

    t: float
    phase: str  # idle, ready, airborne, running, landing, done
    reason: str
    pid: int


@dataclass(frozen=True)
class Sample:
    """True state of a robot."""

    t: float
    position: Vector  # [m]
    velocity: Vector  # [m/s]
    flying: bool  # motors on


@dataclass(frozen=True)
class Answer:
    """Command of an operator, and its end."""

    t: float
    who: str
    words: str
    code: int | None  # None: it has not ended
    output: str


@dataclass(frozen=True)
class Ended:
    """A process, and its end."""

    name: str
    pid: int
    begun: float
    ended: float  # infinity: it is still there
    code: int | None
    output: str


@dataclass(frozen=True)
class Violation:
    """A sentence of the safety rules that does not hold."""

    rule: str
    t: float
    text: str


@dataclass
class Track:
    """History of a robot, in all of its processes."""

    phases: list[Phase] = field(default_factory=list)
    hazards: list[tuple[float, str]] = field(default_factory=list)  # begins, changes and ends
    missing: list[tuple[float, tuple[str, ...]]] = field(default_factory=list)  # neighbours, as the conductor learns it
    motors: list[tuple[float, bool]] = field(default_factory=list)  # times of changes
    samples: list[Sample] = field(default_factory=list)  # every 50 ms
    commands: list[tuple[float, int]] = field(default_factory=list)  # commands to the body: time, and process
    poses: list[tuple[float, int]] = field(default_factory=list)  # sent: time, and process

    def entered(self, phase: str) -> list[float]:
        """Times at which it came into a phase."""
        return [each.t for each in self.phases if each.phase == phase]

    def off(self, after: float = -inf) -> float:
        """First time, `after` or later, at which its motors are off after they were on; infinity if there is none."""
        before = [(t, on) for t, on in self.motors if t <= after]
        changes = before[-1:] + self.motors[len(before) :]
        return next((max(t, after) for t, on in changes if not on), inf)

    def at(self, t: float) -> Sample:
        """The last sample until then."""
        return max((sample for sample in self.samples if sample.t <= t), key=lambda sample: sample.t)


@dataclass
class Flight:
    """History of a flight. All times are in seconds after the common start; of one without, after the command began."""

    code: int | None  # exit code of `./zenpark run`; None: it did not end in time
    output: str  # its standard output and error
    started: float | None  # time from the begin of the command to the common start [s]; None: there was none
    ended: float  # end of the command
    seed: int
    script: list[Fault]
    robots: dict[str, Track]
    events: list[Event]
    answers: list[Answer]
    processes: list[Ended]
    violations: list[Violation]
    crashes: list[tuple[float, str, str]]  # time, process and traceback of exceptions that nothing caught
    notes: list[tuple[float, str]]  # injected faults
    metrics: list[dict[str, Any]] | None  # metrics.json, by case
    files: list[str]  # names in the folder of the run
    trace: str  # digest of all switches between threads
    cpu_s: float = 0.0
    robot_s: float = 0.0  # simulated seconds, summed over robots
    simulated_s: float = 0.0

    def happened(self, kind: str, source: str = "", text: str = "") -> list[Event]:
        """Events of a kind, of a source if one is named, with a text in them."""
        same = [event for event in self.events if event.kind == kind and source in ("", event.source)]
        return [event for event in same if text in event.text]

    def of(self, name: str) -> list[Ended]:
        """Processes of a name: "case-KH01", "router", or its last word."""
        return [each for each in self.processes if each.name == name or each.name.endswith(f"-{name}")]

    def describe(self) -> str:
        """All of it as text, for people."""
        lines = [f"exit code {self.code}, common start after {self.started}, end at {self.ended:.2f} s"]
        lines += [f"  {t:8.3f} {text}" for t, text in self.notes]
        lines += [f"  {each.t:8.3f} event {each.kind} {each.source}: {each.text}" for each in self.events]
        lines += [
            f"  {each.t:8.3f} {name} ({each.pid}): {each.phase} {each.reason}"
            for name, track in self.robots.items()
            for each in track.phases
        ]
        lines += [f"  {each.t:8.3f} `{each.words}`: {each.code} {each.output.strip()}" for each in self.answers]
        lines += [
            f"  {each.name} ({each.pid}) {each.begun:.2f}-{each.ended:.2f}: {each.code}" for each in self.processes
        ]
        lines += [f"VIOLATION {each.rule} at {each.t:.3f}: {each.text}" for each in self.violations]
        return "\n".join([*lines, self.output])


class SimulatorError(Exception):
    """A flight that gave no result: a defect of the simulator, or a process that spins."""


def fly(
    experiment: str,
    *faults: Fault,
    seed: int = 1,
    mutant: Mutant | None = None,
    case: str | None = None,
    settings: Sequence[str] = (),
    clocks: Mapping[str, float] | None = None,
    preempt: float = 0.0,
    varied: bool = False,
    forgets: float = 0.0,
    words: Sequence[str] = (),
    folder: Path | None = None,
    limit_s: float = LIMIT_S,
    sites: int = 0,
) -> Flight:
    """Fly an experiment with a script of faults: `./zenpark run` and all that it starts, on simulated time.

    The exit code and the output are the product's own. Times are in seconds after the common start, exact to a tick
    (20 ms) of the robots; faults and orders can begin at -0.5 s, or count from another moment (`Fault.since`).

        flight = fly("triangle", Fault(2.0, "estop"), case="event", settings=["duration_s=8"])
        assert flight.code == 1
        assert flight.robots["CF01"].off(after=2.0) < 2.3

    Args:
        experiment: Text of a small TOML file, or the name of one of the catalogue.
        faults: The script; see `Fault`.
        seed: Of all that is random: delays of messages, lateness of threads, noise of the motion capture. (The noise
            of twins has the seed of the experiment.)
        mutant: A defect that is put into the product first.
        case: One of the cases; else all are flown, one after the other, and times count from the first start.
        settings: As `--set`: "duration_s=8".
        clocks: Errors of wall clocks by robot [s]. Such a robot is on a machine of its own.
        preempt: Probability with which a thread loses the processor at a lock or a message.
        varied: Whether processes start after random times.
        forgets: See `tests.simulated.network.Network`.
        words: More words of the command, such as "--tag".
        folder: Where the run's folder is made and stays. Left out: nothing stays.
        limit_s: Of simulated time; what still runs then breaks the rule "hang".
        sites: Number of routers that run already, linked with each other, instead of those of the run.

    Raises SimulatorError for a flight that gave no result.
    """
    request = Request(
        experiment, faults, seed, case, tuple(settings), mutant, preempt, varied, forgets, dict(clocks or {}), limit_s,
        tuple(words), None if folder is None else str(folder), sites=sites,
    )  # fmt: skip
    return run(request)


def run(request: Request) -> Flight:
    """Run a request in a child of the clean process."""
    return nursery().run(request)


def nursery() -> Nursery:
    """The clean process of this one, which is started at the first call."""
    global _nursery  # noqa: PLW0603
    if _nursery is None:
        _nursery = Nursery()
    return _nursery


def close() -> None:
    """End the clean process."""
    global _nursery  # noqa: PLW0603
    if _nursery is not None:
        _nursery.close()
    _nursery = None


class Nursery:
    """A clean process that has imported everything, and forks a child for each flight."""

    def __init__(self) -> None:
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")  # others spin, and die in the fork
        environment = {**os.environ, "PYTHONPATH": str(ROOT), **threads}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.simulated.laboratory"], cwd=ROOT, env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def run(self, request: Request) -> Flight:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        _send(self._process.stdin, request)
        found = _receive(self._process.stdout)
        if not isinstance(found, Flight):
            raise SimulatorError(f"seed {request.seed}: {found}")
        return found

    def close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        self._process.wait(100.0)


_nursery: Nursery | None = None


def _send(pipe: IO[bytes], what: object) -> None:
    data = pickle.dumps(what)
    pipe.write(struct.pack("<Q", len(data)) + data)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> Any:
    head = pipe.read(8)
    return pickle.loads(pipe.read(struct.unpack("<Q", head)[0])) if len(head) == 8 else None  # noqa: S301 - our own


def serve() -> None:
    """Fly requests from standard input until it ends, each in a child."""
    from tests.simulated import flight  # noqa: PLC0415 - what it imports is for the children

    flight.warm_up()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while (request := _receive(sys.stdin.buffer)) is not None:
        reader, writer = os.pipe()
        child = os.fork()
        if not child:
            os.close(reader)
            resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
            with os.fdopen(writer, "wb") as pipe:
                try:
                    _send(pipe, flight.fly(request))
                except BaseException:  # noqa: BLE001 - the parent reports it
                    _send(pipe, traceback.format_exc())
            flight.leave()
        os.close(writer)
        with os.fdopen(reader, "rb") as pipe:
            found = _receive(pipe)
        _, status = os.waitpid(child, 0)
        _send(answers, found if found is not None else f"the process of the flight ended with status {status}")


def scratch() -> Path:
    """A new folder for one flight."""
    place = SHARED if SHARED.is_dir() and os.access(SHARED, os.W_OK) else None
    return Path(tempfile.mkdtemp(prefix="zenpark-flight-", dir=place))


def forget(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    from tests.simulated.laboratory import serve as serve_importable  # its classes have that name in pickles

    serve_importable()
