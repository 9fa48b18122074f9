"""A whole laboratory in one thread: launcher, conductor, router, recorder, robots, operators and their machine.

The product's code is unmodified. `patch` is the seam: it replaces clocks, threads, signals, pipes, disks and Zenoh by
those of `tests.simulated.kernel` and `tests.simulated.network`. The process that calls it can never go back.
"""

from __future__ import annotations

import ast
import builtins
import contextlib
import functools
import importlib
import io
import math
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from errno import ENOSPC, EROFS
from math import inf, nan
from types import SimpleNamespace
from typing import Any

import zenoh

import agents.clock
import agents.runtime.router as router_process
from agents.body.interface import Body
from agents.network import messages, pubsub
from agents.network import session as network_session
from agents.network.keys import Keys
from agents.plugins import calls
from agents.runtime import command_line, lifeline, loop, telemetry
from agents.vectors import Vector
from experiments.check import kept
from experiments.definition.plan import Plan
from experiments.real_time.conductor import conduct, orders, run_view
from experiments.real_time.conductor import conductor as conducting
from experiments.real_time.hosts import launcher, run_registry
from experiments.real_time.processes import joining, world_population
from experiments.real_time.processes import robot as robot_process
from experiments.recording import version
from tests.simulated import kernel as sim
from tests.simulated import network as net
from tests.simulated.faults import Fault, inject
from tools import progress as shown_progress
from tools.commands import run as run_command
from twins.models.motion import Motion

ENDPOINT = "tcp/127.0.0.1:7447"
LOOK_S = 0.05  # period of samples and rules
LATE_S = 0.0002  # mean lateness of a sleep on an idle machine [s]
CAPTURE_S = 0.01  # period of the motion capture
CAPTURE_SIGMA = 0.0005  # [m] its noise
END_S = 0.05  # after the end of the last process
OUTSIDE = ("operator", "capture", "second ")  # processes that no run has started
REAL = SimpleNamespace(open=io.open, exit=os._exit, getpid=os.getpid, process_time=time.process_time)
MADE = version.provenance("")  # asks git, with a real duration

world: World  # of this process: there is one


class World:
    """One laboratory, its script, and what was seen of it."""

    def __init__(
        self, kernel: sim.Kernel, script: Sequence[Fault], *, varied: bool, clocks: Mapping[str, float]
    ) -> None:
        """`varied`: processes start after random times; `clocks`: errors of the clocks of robots' machines [s]."""
        global world  # noqa: PLW0603 - the seam replaces functions that have no other way to their laboratory
        world = self
        self.kernel = kernel
        self.network = net.Network()
        self.script, self.varied, self.clocks = list(script), varied, dict(clocks)
        self.moments: dict[str, float] = {"launch": self.now}  # of the script
        self.bodies: list[WatchedBody] = []
        self.populations: list[tuple[sim.Process, world_population.WorldBodies]] = []
        self.readings: dict[str, Any] = {}  # faults of measurements by robot: word, number, memory
        self.captures: dict[str, Any] = {}
        self.disks: dict[str, Any] = {}  # by the name of a process as in a script
        self.robots: dict[str, sim.Process] = {}  # newest process that the run has started
        self.launched: dict[str, list[str]] = {}  # command lines of robots
        self.runtimes: dict[int, loop.Runtime] = {}  # by process id
        self.runs: list[tuple[run_registry.RegisteredRun, run_registry.Obey, sim.Process]] = []
        self.progress: run_view.Progress | None = None
        self.seen: dict[int, int] = {}  # number of events that were noted, by progress
        self.plan: Plan | None = None
        self.answers: list[tuple[float, str, str, sim.Process]] = []  # time, robot, words of operators
        self.notes: list[tuple[float, str]] = []
        self.events: list[messages.Event] = []
        self.phases: list[tuple[float, str, int, int, str]] = []  # time, robot, process, phase, reason
        self.commands: list[tuple[float, str, int]] = []
        self.poses: list[tuple[float, str, int]] = []
        self.motors: list[tuple[float, str, bool]] = []  # changes
        self.samples: dict[str, list[tuple[float, Vector, Vector, bool]]] = {}  # every `LOOK_S`, true
        self.takeoffs_ordered: list[tuple[float, str]] = []
        self.stops: list[float] = []
        self.drivers: dict[str, tuple[sim.Process, float]] = {}  # newest process that has driven a robot, and when
        self.rising: dict[tuple[int, str], bool] = {}  # by process and robot: it was just told to take off
        self.cases: list[str] = []
        self.ends: dict[int, float] = {}  # by process id
        self._flying: dict[str, bool] = {}
        self._over = inf
        self.disturbed_until = 0.0
        self.watchers: list[Callable[[], None]] = []  # called every `LOOK_S`
        self.on_command: list[Callable[[str, sim.Process], None]] = []
        self.on_pose: list[Callable[[str, sim.Process], None]] = []

    @property
    def processes(self) -> list[sim.Process]:
        return self.kernel.processes

    @property
    def interrupted(self) -> bool:
        """Whether the script has a Ctrl-C."""
        return any(fault.kind in {"interrupt", "term"} for fault in self.script)

    @property
    def now(self) -> float:
        return self.kernel.now

    def after(self, seconds: float, call: Callable[[], object]) -> None:
        self.kernel.after(seconds, call)

    def note(self, text: str) -> None:
        self.notes.append((self.now, text))

    # ------------------------------------------------------------------ the run

    def run(self, words: Sequence[str], limit_s: float) -> None:
        """Run `./zenpark run` with these words, until all processes of the run have ended, or for `limit_s` [s]."""
        self.conductor = sim.Process("conductor", lambda: main("tools.guard", words))
        self._close_pipes_at_exit(self.conductor)
        self._schedule("launch")
        self.after(LOOK_S, self._look)
        self.kernel.run(lambda: self.now > self._over + END_S, self.now + limit_s)

    def note_end(self, process: sim.Process) -> None:
        """Note that a process has ended, maybe the last one of the run."""
        self.ends.setdefault(process.pid, self.now)
        if all(each.dead for each in self.processes if not each.name.startswith(OUTSIDE)):
            self._over = min(self._over, self.now)

    def _close_pipes_at_exit(self, process: sim.Process) -> None:
        leave = process.exit

        def exit_process(code: int) -> None:
            if not process.dead:
                leave(code)
                for each in self.kernel.processes:
                    each.give(b"", eof=True)

        process.exit = exit_process

    def reach(self, moment: str, at: float | None = None) -> None:
        """Note the first time of a moment, at `at` [s], of which the script may depend."""
        if moment not in self.moments:
            self.moments[moment] = self.now if at is None else at
            self._schedule(moment)

    def _schedule(self, moment: str) -> None:
        for fault in self.script:
            if fault.since == moment:
                self.kernel.at(self.moments[moment] + fault.at, lambda fault=fault: inject(self, fault))

    def _look(self) -> None:
        self.after(LOOK_S, self._look)
        for name, _, motion in self.motions():
            self.note_motors(name, motion)
            sample = self.now, motion.position, motion.velocity, motion.flying
            self.samples.setdefault(name, []).append(sample)
        for watch in self.watchers:
            watch()

    def note_motors(self, name: str, motion: Motion) -> None:
        if motion.flying != self._flying.get(name, False):
            self._flying[name] = motion.flying
            self.motors.append((self.now, name, motion.flying))

    # ------------------------------------------------------------------ processes

    def process(self, who: str) -> sim.Process | None:
        """The living process that a script names; None if there is none."""
        found = self.robots.get(who)
        if found is None:
            same = (
                each for each in reversed(self.kernel.processes) if each.name == who or each.name.endswith(f"-{who}")
            )
            found = next((each for each in same if not each.dead), None)
        return None if found is None or found.dead else found

    def sessions(self, who: str) -> list[net.Session]:
        process = self.process(who)
        return [] if process is None else [each for each in process.sessions if isinstance(each, net.Session)]

    def session(self, process: sim.Process) -> net.Session | None:
        """The newest open session of a living process."""
        opened = (each for each in reversed(process.sessions) if isinstance(each, net.Session) and not each.closed)
        return None if process.dead else next(opened, None)

    def signal(self, process: sim.Process, number: int) -> None:
        """Send a signal; what its handler raises is raised in the main thread."""
        if process.dead:
            return
        if process.paused:
            process.deferred.append((self.signal, (process, number)))
            return
        try:
            process.term(int(number))
        except BaseException as error:  # noqa: BLE001 - as the interpreter does
            sim.current().at(self.now, _raise_in, process.main, error)

    def hang(self, process: sim.Process, seconds: float) -> None:
        """Let the next sleep of a loop take so much longer."""
        before, process.late = process.late, seconds
        self.after(0.02, lambda: setattr(process, "late", before))

    def started(self, process: sim.Process, module: str, words: Sequence[str]) -> None:
        """Note a process that the launcher has started."""
        process.late = LATE_S
        if module != robot_process.__name__:
            return
        for name in [word for word in words[1:] if self.plan is not None and word in self.plan.names]:
            self.robots[name] = process
            self.launched[name] = list(words)
            if name in self.clocks:
                process.env, process.wall = {}, self.clocks[name]

    def start_second(self, name: str, wall: float) -> None:
        """Start another process of a robot by hand: without a lifeline."""
        words = [word for word in self.launched.get(name, ()) if word != "--lifeline"]
        if not words:
            return
        process = sim.Process(f"second {name}", lambda: main(robot_process.__name__, [*words, "--once"]), {})
        process.wall = wall

    def operate(self, words: Sequence[str], who: str) -> None:
        """Let an operator type a command."""
        process = sim.Process(f"operator {len(self.answers) + 1}", lambda: main("tools.guard", words))
        self.answers.append((self.now, who, " ".join(words), process))

    # ------------------------------------------------------------------ truth

    def motions(self) -> Iterator[tuple[str, sim.Process, Motion]]:
        """True motions of all robots with a living process that simulates them."""
        for body in self.bodies:
            if not body.process.dead:
                for row, name in enumerate(body.names):
                    if (motion := body.motion(row)) is not None:
                        yield name, body.process, motion
        for process, population in self.populations:
            if not process.dead:
                for name, carried, motion in zip(
                    population.names, population.carried, population.body.engine.motions, strict=True
                ):
                    if carried:
                        yield name, process, motion

    def motion(self, name: str) -> Motion | None:
        """True motion of a robot, of its newest process."""
        return next((motion for other, _, motion in reversed([*self.motions()]) if other == name), None)


# ---------------------------------------------------------------------- processes and their launcher


def running() -> sim.Process | None:
    """The simulated process that runs; None outside of all."""
    return None if sim._kernel is None else sim._kernel.process


def _raise_in(task: sim.Task, error: BaseException) -> None:
    """Raise an exception in a thread that waits."""
    kernel = sim.current()
    task._ticket += 1
    kernel.task, kernel.process = task, task.process
    try:
        task.greenlet.throw(error)
    finally:
        kernel.task = kernel.process = None


def main(module: str, words: Sequence[str]) -> int:
    """`python -m MODULE WORDS`: what the module does when it is the main one."""
    sys.argv = [module, *words]
    exec(_block(module), vars(importlib.import_module(module)))
    return 0


@functools.cache
def _block(module: str) -> Any:
    file = importlib.import_module(module).__file__
    assert file is not None
    with REAL.open(file, encoding="utf-8") as source:
        tree = ast.parse(source.read())
    last = tree.body[-1]
    assert isinstance(last, ast.If), f"{module} does nothing when it is the main module"
    return compile(ast.Module(last.body, []), file, "exec")


class Handle:
    """Popen of a simulated process."""

    stdout = None

    def __init__(self, process: sim.Process) -> None:
        self.process, self.pid = process, process.pid

    @property
    def returncode(self) -> int | None:
        return self.process.code if self.process.dead else None

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        if not self.process.dead:
            self.process.ended.wait(timeout)
        if not self.process.dead:
            raise subprocess.TimeoutExpired(self.process.name, timeout or 0.0)
        return self.process.code


class LaunchedProcess(launcher.Process):
    """Process of a launcher behind simulated pipes."""

    @property
    def output(self) -> str:
        return "".join(self.handle.process.out)

    def news(self) -> list[str]:
        lines = self.output[self.shown :].splitlines(keepends=True)
        whole = [line for line in lines if line.endswith("\n")]
        self.shown += sum(map(len, whole))
        return [line.rstrip("\n") for line in whole]

    def write(self) -> None:
        self.handle.process.give(bytes(self.unsent))
        self.unsent.clear()

    def close(self) -> None:
        self.handle.process.give(b"", eof=True)

    def forget(self) -> None:
        return

    def signal(self, number: int) -> None:
        if number == signal.SIGKILL:
            self.handle.process.kill()
        else:
            world.signal(self.handle.process, number)


def _start(self: launcher.Launcher, name: str, module: str, *arguments: str, forked: bool = False) -> launcher.Process:
    """`Launcher.start`."""
    environment = {} if self.clock is None else self.clock.shared()
    wait_s = world.kernel.rng.choice((0.05, 0.2, 0.2, 1.5)) * world.kernel.rng.random() if world.varied else 0.0

    def begin() -> int:
        if wait_s:
            sim.block(wait_s)
        return main(module, arguments)

    writable(self._logs / f"{name}.log")
    process = sim.Process(name, begin, environment)
    world.started(process, module, arguments)
    made = LaunchedProcess(name, Handle(process), None, self._logs / name, 0, 0, begun=sim.monotonic())
    with self._lock:
        self._processes[name] = made
    return made


class Pool:
    """`ThreadPoolExecutor` of simulated threads."""

    def __init__(self, _: int) -> None:
        pass

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def submit(self, call: Callable[..., object], *given: object) -> Any:
        found: list[object] = []
        thread = sim.Thread(target=lambda: found.append(call(*given)))
        thread.start()
        return SimpleNamespace(result=lambda: (thread.join(), found[0])[1])


@contextlib.contextmanager
def _registered(run: run_registry.RegisteredRun, obey: run_registry.Obey | None = None) -> Iterator[str]:
    """`run_registry.registered`, in the memory of the simulated machine."""
    entry = (run, obey, sim.current().process)
    world.runs.append(entry)
    try:
        yield ""
    finally:
        world.runs.remove(entry)


def _tell(run: run_registry.RegisteredRun, stop: messages.Stop) -> run_registry.StopReport | None:
    """`run_registry.tell`: the process of the run obeys in a thread of its own."""
    process, obey = next((process, obey) for each, obey, process in world.runs if each is run)
    reports: list[run_registry.StopReport] = []
    if obey is None or process.dead:
        return None
    sim.Task(process, lambda: reports.append(obey(stop)), "stop")
    deadline = sim.monotonic() + run_registry.TELL_S
    while not reports and sim.monotonic() < deadline:
        sim.sleep(0.01)
    return reports[0] if reports else None


class Output(io.TextIOBase):
    """Standard output and error: of the simulated process that runs."""

    def write(self, text: str) -> int:
        process = running()
        if process is None:
            os.write(2, text.encode())
        else:
            process.out.append(text)
        return len(text)

    def flush(self) -> None:
        return


# ---------------------------------------------------------------------- disks


def disk() -> Any:
    """Fault of the disk of the running process: its word or delay; None: there is none."""
    process = running()
    if process is None or not world.disks:
        return None
    return next((fault for who, fault in world.disks.items() if process is world.process(who)), None)


def writable(file: object) -> None:
    """Raise what the disk of the running process raises for a write now, or wait for a slow one."""
    fault = disk()
    if fault in {"full", "read-only"}:
        number = ENOSPC if fault == "full" else EROFS
        raise OSError(number, os.strerror(number), str(file))
    if fault is not None and sim.current().task is not None:
        sim.block(fault)


class DiskFile:
    """File of a disk that may refuse to take more."""

    def __init__(self, file: Any, name: object) -> None:
        self._file, self._name = file, name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> DiskFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[Any]:
        return iter(self._file)

    def write(self, data: Any) -> int:
        writable(self._name)
        return self._file.write(data)


def _open(file: Any, mode: str = "r", *given: Any, **more: Any) -> Any:
    """`open`: files that are written to are on the disk of the process."""
    if running() is None or not set(mode) & set("wax+"):
        return REAL.open(file, mode, *given, **more)
    if disk() == "read-only":
        writable(file)
    return DiskFile(REAL.open(file, mode, *given, **more), file)


def _temporary_file(*given: Any, **more: Any) -> Any:
    if disk() == "read-only":
        writable("")
    return DiskFile(tempfile.TemporaryFile(*given, **more), "")


# ---------------------------------------------------------------------- bodies


def _finite(value: Vector) -> bool:
    return all(map(math.isfinite, value))


def _stuck(state: Any, sigma: float, memory: dict[str, Any]) -> None:
    x, y, z = memory.setdefault("position", state.position)
    rng = sim.current().rng
    state.position = (
        (x + rng.gauss(0.0, sigma), y + rng.gauss(0.0, sigma), z + rng.gauss(0.0, sigma)) if sigma else (x, y, z)
    )
    state.velocity = (0.0, 0.0, 0.0)


def _unknown(state: Any, _: float, __: dict[str, Any]) -> None:
    state.position = (nan, nan, nan)


def _jump(state: Any, size: float, _: dict[str, Any]) -> None:
    x, y, z = state.position
    state.position = (x + size, y, z)


def _old(state: Any, age: float, memory: dict[str, Any]) -> None:
    """The state as it was `age` [s] before."""
    kept = memory.setdefault("kept", deque())
    kept.append((state.time, state.position, state.velocity, state.yaw))
    while len(kept) > 1 and kept[1][0] <= state.time - age:
        kept.popleft()
    state.time, state.position, state.velocity, state.yaw = kept[0]


def _silent(state: Any, _: float, memory: dict[str, Any]) -> None:
    state.time = memory.setdefault("time", state.time)


def _charge(state: Any, charge: float, _: dict[str, Any]) -> None:
    state.battery = charge


def _still(state: Any, _: float, __: dict[str, Any]) -> None:
    state.flying = False


READINGS: dict[str, Callable[[Any, float, dict[str, Any]], None]] = {
    "nan": _unknown,
    "jump": _jump,
    "stuck": _stuck,
    "late": _old,
    "silent": _silent,
    "battery": _charge,
    "motors": _still,
}


class WatchedBody(Body):
    """A body of the product, with faults of its readings, and a record of the process that drives it."""

    def __init__(self, body: Body, names: Sequence[str], rate_hz: float) -> None:
        self.body, self.names, self.process, self._period_s = body, names, sim.current().process, 1.0 / rate_hz
        world.bodies.append(self)

    def motion(self, row: int) -> Motion | None:
        twins = getattr(self.body, "twins", None)
        return None if twins is None else twins[row].motion

    def open(self) -> None:
        self.body.open()

    def read(self, t: float) -> Any:
        for row, name in enumerate(self.names):
            self._carry(row, *world.readings.get(name, ("", 0.0, {})))
        states = self.body.read(t)
        self._note_motors()
        if world.readings and self.process is world.robots.get(self.names[0], self.process):
            for name, state in zip(self.names, states, strict=True):
                word, number, memory = world.readings.get(name, ("", 0.0, {}))
                if word in READINGS:
                    READINGS[word](state, number, memory)
        return states

    def _carry(self, row: int, word: str, speed: float, _: object) -> None:
        """Let wind, or somebody, carry a robot aside [m/s]."""
        motion = self.motion(row) if word == "adrift" else None
        if motion is not None:
            for place in {"held", "position"} & {*dir(motion)}:
                x, y, z = getattr(motion, place)
                setattr(motion, place, (x + speed * self._period_s, y, z))

    def command(self, setpoints: Any) -> None:
        self._note(self.names)
        self.body.command(setpoints)

    def takeoff(self, rows: Sequence[int], heights: Sequence[float]) -> None:
        world.rising.update(((self.process.pid, self.names[row]), True) for row in rows)
        self._note([self.names[row] for row in rows])
        self.body.takeoff(rows, heights)

    def land(self, rows: Sequence[int]) -> None:
        self._note([self.names[row] for row in rows])
        self.body.land(rows)

    def stop(self, rows: Sequence[int]) -> None:
        self.body.stop(rows)
        self._note_motors()

    def _note_motors(self) -> None:
        for row, name in enumerate(self.names):
            if (motion := self.motion(row)) is not None:
                world.note_motors(name, motion)

    def locate(self, row: int, t: float, position: Vector, yaw: float) -> None:
        self.body.locate(row, t, position, yaw)

    def close(self) -> None:
        self.body.close()

    def inspect(self, row: int) -> Any:
        return self.body.inspect(row)

    def _note(self, names: Sequence[str]) -> None:
        for name in names:
            world.commands.append((world.now, name, self.process.pid))
            for watch in world.on_command:
                watch(name, self.process)


# ---------------------------------------------------------------------- motion capture


def capture(names: Sequence[str], realm: str) -> int:
    """Process of a motion capture: it publishes true positions with noise and its faults, until the run is over."""
    session = network_session.open_session([ENDPOINT], name="capture")
    clock, keys, rng = agents.clock.Clock(), Keys(realm), sim.current().rng
    ends = {name: pubsub.NumberedPublisher(session, keys.position(name), messages.JSON) for name in names}
    late: dict[str, deque[tuple[float, bytes]]] = {name: deque() for name in names}
    while not world.conductor.dead:
        time.sleep(CAPTURE_S)
        for name, end in ends.items():
            motion = world.motion(name)
            if motion is None:
                continue
            word, number, memory = world.captures.get(name, ("", 0.0, {}))
            if word == "gone":
                continue
            if word == "swap":
                motion = world.motion(names[(names.index(name) + 1) % len(names)]) or motion
            x, y, z = motion.position
            if word == "stuck":
                x, y, z = memory.setdefault("position", motion.position)
            if word == "jump":
                x += number
            if word != "stuck" or number:
                x, y, z = (value + rng.gauss(0.0, number if word == "stuck" else CAPTURE_SIGMA) for value in (x, y, z))
            yaw = motion.yaw + {"flip": math.pi, "turned": number}.get(word, 0.0) + rng.gauss(0.0, 0.002)
            stamp = clock.utc() + (number if word == "stamp" else 0.0)
            message = messages.Position(name, stamp, (x, y, z), messages.heading(yaw))
            waiting = late[name]
            waiting.append((world.now + (number if word == "late" else 0.0), messages.encode(message)))
            while waiting and waiting[0][0] <= world.now:
                end.put(waiting.popleft()[1])
    return 0


# ---------------------------------------------------------------------- the seam


def patch() -> None:
    """Replace clocks, threads, signals, disks, pipes and the network of this process by simulated ones, for good."""
    os.environ.pop("ZENPARK_CLOCK", None)
    _patch_clocks_and_threads()
    _patch_processes()
    _patch_network()
    _watch_product()


def _patch_clocks_and_threads() -> None:
    version.provenance = lambda *_: MADE
    version.load = lambda: None
    secrets.token_hex = lambda count: sim.current().rng.randbytes(count).hex()
    time.monotonic = time.perf_counter = sim.monotonic
    time.time, time.sleep = sim.wall, sim.sleep
    time.monotonic_ns = lambda: int(1e9 * sim.monotonic())
    time.clock_gettime = lambda _: sim.monotonic()
    time.process_time = lambda: 0.0
    telemetry.resident_mb = lambda: 0.0
    threading.Event, threading.Lock, threading.Thread = sim.Event, sim.Lock, sim.Thread
    threading.enumerate = lambda: []
    lifeline.LifelineEnd = sim.LifelineEnd
    command_line.spare_imports = lambda: None
    calls.signal = SimpleNamespace()  # without `setitimer` plug-ins are not supervised
    orders.ThreadPoolExecutor = Pool


def _patch_processes() -> None:
    def die(code: int) -> None:
        sim.current().process.leave(code)

    def handle(number: int, handler: Any) -> Any:
        before = sim.current().process.handlers.get(int(number), signal.SIG_DFL)
        sim.current().process.handlers[int(number)] = handler
        return before

    def environment(key: str, default: str | None = None) -> str | None:
        return sim.current().process.env.get(key, default) if sim.current().process is not None else default

    def kill(pid: int, number: int) -> None:
        world.signal(next(each for each in sim.current().processes if each.pid == pid), number)

    agents.clock.os = SimpleNamespace(environ=SimpleNamespace(get=environment))
    os._exit, os.kill = die, kill
    os.getpid = lambda: REAL.getpid() if (process := running()) is None else process.pid
    signal.signal = handle
    signal.getsignal = lambda number: sim.current().process.handlers.get(int(number), signal.SIG_DFL)
    signal.pthread_sigmask = lambda *_: set()
    sys.stdout = sys.stderr = Output()
    command_line.detach = joining.detach = lambda: None
    launcher.Launcher.preload, launcher.Launcher.start = lambda _: None, _start
    conduct.free_endpoints = lambda count, protocol: [f"{protocol}/127.0.0.1:{7447 + k}" for k in range(count)]
    run_registry.registered, run_registry.tell = _registered, _tell
    run_registry.look = lambda: run_registry.Listing(
        [run for run, _, process in world.runs if not process.dead], [], []
    )
    run_registry.born = lambda pid: (
        "" if any(each.pid == pid and not each.dead for each in sim.current().processes) else None
    )
    run_registry.RegisteredRun._is_of_user = lambda _: True
    kept.KeptVerdict = lambda *_: None
    run_command.sound = lambda *_, **__: True  # the check flies ideal runs, which the scripts do not need
    builtins.open = io.open = _open
    from experiments.recording import writer  # noqa: PLC0415

    writer.TemporaryFile = _temporary_file


def _patch_network() -> None:
    pubsub.RingChannel = network_session.RingChannel = pubsub.FifoChannel = net.Ring
    pubsub.pose_publisher = lambda session, key, mime, kept=1: net.AdvancedPublisher(session, key, mime, kept)
    pubsub.advanced_subscriber = net.AdvancedSubscriber
    pubsub.Callback = lambda function, indirect: function
    zenoh.SourceInfo = net.source_info
    network_session.open_with = lambda chosen: world.network.open(chosen)  # noqa: PLW0108 - of the world that comes
    network_session.forbid_lingering = router_process.forbid_lingering = lambda: 0
    network_session.hang_up = lambda session: session.hang_up()


def _watch_product() -> None:
    """Let the laboratory see what the product does."""
    _wrap(sim.Process, "exit", after=lambda process, _: world.note_end(process))
    shadowed = robot_process.shadowed
    robot_process.shadowed = lambda body, request, periods: WatchedBody(
        shadowed(body, request, periods), request.names, request.rate_hz
    )
    _wrap(loop.Runtime, "__init__", after=_note_runtime)
    _wrap(loop.Runtime, "tick", after=_note_phases)
    _wrap(loop.Runtime, "_send_pose", before=_note_pose)
    _wrap(world_population.WorldBodies, "__init__", after=_note_population)
    _wrap(conducting.CaseRun, "__init__", after=_note_case)
    _wrap(run_view.NetworkView, "report", after=_note_event)
    lines = shown_progress.Lines.__call__

    def show(self: Any, progress: run_view.Progress) -> None:
        lines(self, progress)
        world.progress = progress
        known = world.seen.get(id(progress), 0)
        world.seen[id(progress)] = len(progress.events)
        world.events += progress.events[known:]

    shown_progress.Lines.__call__ = show
    send = orders.send_order

    def send_order(session: Any, keys: Any, robots: Sequence[str], order: messages.Order, *more: Any) -> Any:
        if order.order == "takeoff":
            world.takeoffs_ordered.extend((world.now, robot) for robot in robots)
        return send(session, keys, robots, order, *more)

    orders.send_order = send_order
    _wrap(orders.Emergency, "receive", before=lambda *_, **__: world.stops.append(world.now))


def _wrap(
    kind: type, name: str, *, before: Callable[..., object] | None = None, after: Callable[..., object] | None = None
) -> None:
    """Call something with the arguments of a method before or after it."""
    method = getattr(kind, name)

    def wrapped(*given: Any, **more: Any) -> Any:
        if before is not None:
            before(*given, **more)
        result = method(*given, **more)
        if after is not None:
            after(*given, **more)
        return result

    setattr(kind, name, wrapped)


def _note_runtime(runtime: loop.Runtime, *_: object, **__: object) -> None:
    world.runtimes[sim.current().process.pid] = runtime


def _note_population(population: world_population.WorldBodies, *_: object, **__: object) -> None:
    world.populations.append((sim.current().process, population))


def _note_phases(runtime: loop.Runtime, *_: object, **__: object) -> None:
    known = runtime.__dict__.setdefault("_noted", [-1] * len(runtime.robots))
    for row, robot in enumerate(runtime.robots):
        if (phase := robot.lifecycle.phase) != known[row]:
            known[row] = phase
            name, pid, reason = runtime._names[row], sim.current().process.pid, robot.lifecycle.reason
            world.phases.append((world.now, name, pid, phase, reason))


def _note_pose(runtime: loop.Runtime, row: int, *_: object, **__: object) -> None:
    name, process = runtime._names[row], sim.current().process
    world.poses.append((world.now, name, process.pid))
    for watch in world.on_pose:
        watch(name, process)


def _note_case(_: conducting.CaseRun, context: Any, *_a: object, **__: object) -> None:
    world.plan = context.plan
    world.cases.append(context.case)
    measured = [name for name, robot in context.plan.experiment.robots.items() if robot.position == "external"]
    outside = [name for name in measured if context.plan.experiment.robots[name].body != "world"]
    if outside and context.plan.experiment.positioning is None:
        sim.Process("capture", lambda: capture(outside, context.plan.experiment.network.realm))


def _note_event(view: run_view.NetworkView, kind: str, _: str, text: str, stamp: float | None = None) -> None:
    if kind == "ready":
        world.reach("ready")
    elif kind == "phase" and text.startswith("landing"):
        world.reach("landing")
    elif kind == "start" and stamp is not None:
        world.reach("start", world.now + stamp - view.clock.utc())
