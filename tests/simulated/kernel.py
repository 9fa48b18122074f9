"""Simulated time, threads and processes: everything runs in one real thread, in an order that a seed decides.

A simulated thread is a greenlet. It runs until it blocks (`sleep`, `Event.wait`, `Lock.acquire`, `Thread.join`,
`LifelineEnd.wait`), so unmodified blocking code works. No time passes while it runs.
"""

from __future__ import annotations

import itertools
import os
import random
import secrets
import signal
import subprocess
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from heapq import heappop, heappush
from math import inf
from typing import Any, Final, Self
from unittest import mock

from greenlet import GreenletExit, getcurrent, greenlet

BEGIN: Final = 1000.0  # monotonic time at which every flight begins [s]
EPOCH: Final = 1.79e9 - BEGIN  # UTC at the monotonic time 0 [s]
LATE_S: Final = 0.0002  # mean lateness of a thread that has slept [s]
BUSY_S: Final = 0.001  # mean lateness from which every wait ends late [s]
PREEMPTED_S: Final = 0.002  # longest time for which a thread loses the processor in mid-work [s]
STEPS: Final = 100_000  # switches, readings of a clock and polls within one instant that no honest process needs
KILLED: Final = -int(signal.SIGKILL)

_kernel: Kernel | None = None  # the running one


class FlightError(BaseException):
    """The end of a flight at once, whatever the code that caused it catches."""


def current() -> Kernel:
    """The running kernel."""
    assert _kernel is not None, "no kernel runs"
    return _kernel


class Kernel:
    """Events of one flight, in order of time; a context manager in which it is the running one.

    Attributes:
        now: Monotonic time [s].
        task: The thread that runs; None in a callback.
        process: The process that runs; None in an event of the world outside.
        crashes: Time [s], process, thread and traceback of each exception that ended a thread.
        log: Time since the beginning [s], process and text of what was said.
        steps: Number of steps at this instant; what is asked most often counts them without `step`.
    """

    def __init__(self, seed: int, preempt: float = 0.0) -> None:
        """A kernel in which a thread loses the processor at a lock or a message with probability `preempt`."""
        self.now, self.rng, self.preempt = BEGIN, random.Random(seed), preempt
        self.stopped = False
        self.hub, self.thread = getcurrent(), threading.get_ident()
        self.task: Task | None = None
        self.process: Process | None = None
        self.processes: list[Process] = []
        self.tasks: list[Task] = []
        self.crashes: list[tuple[float, str, str, str]] = []
        self.log: list[tuple[float, str, str]] = []
        self.switches = self.steps = 0
        self.pids, self.numbers = itertools.count(1001), itertools.count(1)
        self._events: list[tuple[float, int, Callable[..., object], tuple[Any, ...]]] = []
        self._count = itertools.count()
        self._failure: FlightError | None = None
        self._trace = 0

    def __enter__(self) -> Self:
        global _kernel  # noqa: PLW0603 - the one name that simulated threads find their kernel by
        assert _kernel is None, "one kernel runs already"
        _kernel = self
        return self

    def __exit__(self, *_: object) -> None:
        global _kernel  # noqa: PLW0603
        self.end()
        _kernel = None

    @property
    def digest(self) -> str:
        """Digest of all switches: equal for equal histories."""
        return f"{self._trace & 0xFFFF_FFFF_FFFF_FFFF:016x}"

    def at(self, t: float, call: Callable[..., object], *args: Any) -> None:
        """Call a function at a time [s], at once if that is past."""
        heappush(self._events, (t if t > self.now else self.now, next(self._count), call, args))

    def after(self, seconds: float, call: Callable[..., object], *args: Any) -> None:
        self.at(self.now + seconds, call, *args)

    def run(self, limit: float = inf) -> None:
        """Run until `stop`, until nothing is left, or until the time `limit` [s]; raises FlightError at once."""
        events = self._events
        while events and events[0][0] <= limit and not self.stopped:
            t, _, call, args = heappop(events)
            if t > self.now:
                self.now, self.steps = t, 0
            call(*args)
            if self._failure is not None:
                raise self._failure
        if limit < inf and not self.stopped:
            self.now = max(self.now, limit)

    def stop(self) -> None:
        """Let `run` return after the present event."""
        self.stopped = True

    def say(self, text: str) -> None:
        self.log.append((round(self.now - BEGIN, 4), self.process.name if self.process else "-", text))

    def step(self) -> None:
        """Count a step; a process that takes too many within one instant spins without waiting, which is an error."""
        self.steps += 1
        if self.steps > STEPS:
            raise self.spins()

    def spins(self) -> FlightError:
        self.steps = 0
        return self.fail(f"spins without waiting, at {self.now - BEGIN:.4f} s")

    def fail(self, what: str) -> FlightError:
        """The error, to be raised, with which the flight ends at once."""
        who = f"{self.process.name if self.process else 'the world'}/{self.task.name if self.task else 'callback'}"
        self._failure = FlightError(f"{who} {what}")
        return self._failure

    def trace(self, task: Task) -> None:
        """Note that a wait of a thread is over."""
        self.switches += 1
        self._trace = hash((self._trace, self.now, task.process.pid, task.number, task.woken))  # has no random salt

    def switch_to(self, task: Task) -> None:
        """Let a thread run until it blocks."""
        self.task, self.process = task, task.process
        self.trace(task)
        try:
            self.step()
            task.greenlet.switch()
        finally:
            self.task = self.process = None

    def end(self) -> None:
        """End all threads."""
        for process in self.processes:
            process.dead = True
        for task in self.tasks:
            if task.greenlet and not task.greenlet.dead:
                self.task, self.process = task, task.process
                task.greenlet.throw(GreenletExit)
        self.task = self.process = None
        self.tasks.clear()
        self._events.clear()


class Task:
    """A thread of a process; it begins by itself."""

    def __init__(self, process: Process, call: Callable[[], object], name: str) -> None:
        kernel = self.kernel = process.kernel
        self.process, self.name, self.done, self.woken = process, name, False, False
        self.number = next(kernel.numbers)
        self._call, self._ticket = call, 0  # a ticket is good for one wait
        self.late = False  # True if the wait ends late, as a sleep does
        self.joiners = Waiters()
        self.greenlet = greenlet(self._main, parent=kernel.hub)
        kernel.tasks.append(self)
        kernel.at(kernel.now, self._resume, 0, True)

    def _main(self, *_: object) -> None:
        try:
            self._call()
        except (GreenletExit, FlightError):
            pass
        except BaseException as error:  # noqa: BLE001 - as the interpreter does in a thread
            self.process.note_crash(error, self.name)
        self.done = True
        self.joiners.wake()

    def waiter(self) -> tuple[Callable[[int, bool], None], int]:
        """Function that ends the next wait of this thread, and no later one, with its first argument."""
        return self._resume, self._ticket

    def _resume(self, ticket: int, woken: bool) -> None:
        if ticket != self._ticket or self.done or self.process.dead:
            return
        if self.process.paused:
            self.process.deferred.append((self._resume, (ticket, woken)))
            return
        self._ticket, self.woken = self._ticket + 1, woken
        kernel = self.kernel
        if self.late:
            self.late = False
            kernel.trace(self)
            kernel.at(kernel.now + kernel.rng.expovariate(1.0 / self.process.late), self._resume, self._ticket, False)
        else:
            kernel.switch_to(self)

    def block(self, timeout: float | None, *, late: bool = False) -> bool:
        kernel = self.kernel
        if self.process.dead:  # its `finally` blocks run at the end of a flight
            raise GreenletExit
        self.late = late
        if timeout is not None:
            kernel.at(kernel.now + (timeout if timeout > 0.0 else 0.0), self._resume, self._ticket, False)
        kernel.hub.switch()
        if self.process.dead:
            raise GreenletExit
        return self.woken


def block(timeout: float | None = None) -> bool:
    """Stop the running thread until it is woken or the time [s] is over; returns whether it was woken."""
    task = current().task
    if task is None:
        raise current().fail("waits in a callback, which holds up all that it receives")
    return task.block(timeout)


def preempt() -> None:
    """Maybe take the processor from the running thread."""
    kernel = _kernel
    if kernel is not None and kernel.preempt and kernel.task is not None and kernel.rng.random() < kernel.preempt:
        block(kernel.rng.random() * PREEMPTED_S)


def _wait(timeout: float | None, *, late: bool = False) -> None:
    """As `block`, by the clock of the process, on a processor that others use as well."""
    kernel = current()
    process, task = kernel.process, kernel.task
    if process is None:
        raise kernel.fail("waits outside of a process")
    if timeout is not None:
        timeout = timeout / (1.0 + process.drift)
    if late and task is not None:
        task.block(timeout, late=True)
        return
    wait = block if task is None else task.block
    wait(timeout)
    if late or process.late > BUSY_S:
        wait(kernel.rng.expovariate(1.0 / process.late))


class Waiters:
    """Threads that wait for one thing."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Callable[[int, bool], None], int]] = []

    def wait(self, timeout: float | None = None) -> None:
        task = current().task
        if task is not None:
            self._waiting.append(task.waiter())
        _wait(timeout)

    def wake(self) -> None:
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            kernel = current()
            for resume, ticket in waiting:
                kernel.at(kernel.now, resume, ticket, True)


class Process:
    """A process: it may be paused, killed and signalled, and has clocks, an environment, and standard streams.

    Attributes:
        code: Exit code; None while it runs.
        out: What it has printed.
        sessions: Its ends of the network, which have `die`, `suspend` and `resume`.
        deferred: Calls that wait while it is paused.
        handlers: Handlers of signals, by number.
        wall: Error of its wall clock [s].
        drift: Error of the rate of its clocks [s/s].
        late: Mean lateness of its threads [s].
        stall: By which its next sleep lasts longer [s].
        started, paused_at, resumed_at: Times of the last such event [s].
    """

    def __init__(self, name: str, main: Callable[[], object], env: Mapping[str, str] | None = None) -> None:
        kernel = self.kernel = current()
        self.name, self.env, self.pid = name, dict(env or {}), next(kernel.pids)
        self.dead = self.paused = False
        self.code: int | None = None
        self.deferred: list[tuple[Callable[..., object], tuple[Any, ...]]] = []
        self.out: list[str] = []
        self.sessions: list[Any] = []
        self.ended = Waiters()
        self.handlers: dict[int, Any] = {signal.SIGINT: signal.default_int_handler}
        self.wall, self.drift, self.late, self.stall = 0.0, 0.0, LATE_S, 0.0
        self.stdin, self.eof, self.readers = bytearray(), False, Waiters()
        self.started, self.paused_at, self.resumed_at = kernel.now, -inf, -inf
        kernel.processes.append(self)
        self.main = Task(self, lambda: self._run(main), "main")

    def _run(self, main: Callable[[], Any]) -> None:
        try:
            code = main() or 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except (GreenletExit, FlightError):
            raise
        except BaseException as error:  # noqa: BLE001 - as the interpreter does
            self.note_crash(error, "main")
            code = 1
        self.exit(code)

    def note_crash(self, error: BaseException, thread: str) -> None:
        if not self.dead:
            text = "".join(traceback.format_exception(error))
            self.out.append(text)
            current().crashes.append((round(current().now - BEGIN, 3), self.name, thread, text))

    def exit(self, code: int) -> None:
        """End the process at once; a thread of its own must not go on after that, see `leave`."""
        if not self.dead:
            current().say(f"{self.name} ends: {code}")
            self.code, self.dead = code, True
            for session in list(self.sessions):
                session.die()
            self.ended.wake()

    def leave(self, code: int) -> None:
        """End the process from one of its own threads."""
        self.exit(code)
        raise GreenletExit

    def kill(self) -> None:
        self.exit(KILLED)

    def term(self, number: int = signal.SIGTERM) -> None:
        """Send a signal: its handler is called, or the process ends."""
        handler = self.handlers.get(number)
        if callable(handler):
            self.call(handler, number, None)
        else:
            self.exit(-number)

    def pause(self) -> None:
        if not self.dead and not self.paused:
            self.paused, self.paused_at = True, current().now
            for session in self.sessions:
                session.suspend()

    def resume(self) -> None:
        if self.paused:
            self.paused, self.resumed_at = False, current().now
            deferred, self.deferred = self.deferred, []
            for call, args in deferred:
                current().at(current().now, self.call, call, *args)
            for session in self.sessions:
                session.resume()

    def call(self, call: Callable[..., object], *args: Any) -> None:
        """Call a function as the receiving thread of the process, which must not block."""
        if self.dead:
            return
        if self.paused:
            self.deferred.append((call, args))
            return
        kernel = self.kernel
        before = kernel.task, kernel.process
        kernel.task, kernel.process = None, self
        try:
            call(*args)
        finally:
            kernel.task, kernel.process = before

    def give(self, data: bytes, *, eof: bool = False) -> None:
        """Write to its standard input, or close it."""
        self.stdin += data
        self.eof |= eof
        self.readers.wake()


# ---------------------------------------------------------------------- time, threading, select and os


def monotonic(_clock: int = 0) -> float:
    """Monotonic clock of the process [s]."""
    kernel = _kernel
    assert kernel is not None
    kernel.steps += 1
    if kernel.steps > STEPS:
        raise kernel.spins()
    process = kernel.process
    drifts = process is not None and process.drift
    return BEGIN + (kernel.now - BEGIN) * (1.0 + process.drift) if drifts else kernel.now


def wall() -> float:
    """Wall clock of the process, UTC [s]."""
    process = current().process
    return monotonic() + EPOCH + (process.wall if process else 0.0)


def sleep(seconds: float) -> None:
    _wait(seconds, late=True)
    process = current().process
    if process is not None and process.stall:
        stall, process.stall = process.stall, 0.0
        block(stall)


class Event:
    """As `threading.Event`."""

    def __init__(self) -> None:
        self._flag, self._waiters = False, Waiters()

    def is_set(self) -> bool:
        current().step()
        return self._flag

    def set(self) -> None:
        self._flag = True
        self._waiters.wake()

    def clear(self) -> None:
        self._flag = False

    def wait(self, timeout: float | None = None) -> bool:
        if not self._flag:
            self._waiters.wait(timeout)
        return self.is_set()


class Lock:
    """As `threading.Lock`."""

    def __init__(self) -> None:
        self._locked, self._waiters = False, Waiters()

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        if blocking:
            preempt()
        kernel = current()
        limit = kernel.now + timeout if timeout >= 0 else inf
        while self._locked:
            kernel.step()
            if not blocking or kernel.now >= limit:
                return False
            self._waiters.wait(None if limit == inf else limit - kernel.now)
        self._locked = True
        return True

    def release(self) -> None:
        if not self._locked:
            raise RuntimeError("release unlocked lock")
        self._locked = False
        self._waiters.wake()

    def locked(self) -> bool:
        return self._locked

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


class Thread:
    """As `threading.Thread`; every one is a daemon."""

    def __init__(
        self,
        group: None = None,
        target: Callable[..., object] = lambda: None,
        name: str = "",
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
        *,
        daemon: bool | None = None,
    ) -> None:
        self.name, self._call, self._args, self._kwargs = name, target, args, dict(kwargs or {})
        self._task: Task | None = None

    def start(self) -> None:
        process = current().process
        assert process is not None
        self._task = Task(process, lambda: self._call(*self._args, **self._kwargs), self.name)
        preempt()

    def is_alive(self) -> bool:
        return self._task is not None and not self._task.done

    def join(self, timeout: float | None = None) -> None:
        if self._task is not None and not self._task.done:
            self._task.joiners.wait(timeout)


class LifelineEnd:
    """As `agents.runtime.lifeline.LifelineEnd`, of the standard input."""

    def __init__(self, _descriptor: int = 0) -> None:
        process = current().process
        assert process is not None
        self._process = process

    def wait(self, timeout_s: float) -> bool:
        if not self._process.stdin and not self._process.eof:
            self._process.readers.wait(timeout_s)
        return bool(self._process.stdin) or self._process.eof

    def read(self) -> bytes:
        data = bytes(self._process.stdin)
        self._process.stdin.clear()
        return data


# ---------------------------------------------------------------------- the real world

_REAL: Final = (
    (time, "time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "clock_gettime", "sleep"),
    (os, "urandom", "getrandom", "fork"),
    (secrets, "randbits", "token_bytes", "token_hex", "choice"),
    (random, "random", "randrange", "randint", "uniform", "choice", "gauss", "shuffle", "seed"),
    (subprocess, "Popen", "run"),
    (threading.Event, "wait"),
    (threading.Thread, "start"),
)


@contextmanager
def guard() -> Iterator[None]:
    """Inside, a simulated process that asks the real world for time, chance or another process ends its flight.

    Enter it first: names that the simulation replaces afterwards are its own.
    """

    def watched(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            kernel = _kernel
            own = kernel is not None and kernel.thread == threading.get_ident()  # other real threads are of no flight
            if kernel is not None and own and kernel.process is not None:
                raise kernel.fail(f"asks the real world: {name}")
            return real(*args, **kwargs)

        return call

    patches = [
        mock.patch.object(module, name, watched(f"{module.__name__}.{name}", getattr(module, name)))
        for module, *names in _REAL
        for name in names
        if hasattr(module, name)
    ]
    for each in patches:
        each.start()
    try:
        yield
    finally:
        for each in reversed(patches):
            each.stop()
