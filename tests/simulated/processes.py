"""Processes of the simulated machine as the product sees them: handles, pipes, output, disks, and the list of runs."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from errno import ENOSPC, EROFS
from types import SimpleNamespace
from typing import Any

from agents.network import messages
from agents.runtime.lifeline import BEAT_S
from experiments.real_time.hosts import launcher, run_registry
from tests.simulated import kernel as sim
from tests.simulated.world import current, main, running

REAL = SimpleNamespace(open=io.open, exit=os._exit, getpid=os.getpid, process_time=time.process_time)


class Handle:
    """Popen of a simulated process."""

    stdout = None

    def __init__(self, process: sim.Process) -> None:
        self.process, self.pid = process, process.pid
        self.starter = sim.current().process
        self.ssh_killed = False  # the process goes on without its end here

    @property
    def apart(self) -> bool:
        """Whether a split cuts the lifeline."""
        return self.starter is not None and current().network.cuts_lifeline(self.starter, self.process)

    @property
    def returncode(self) -> int | None:
        return self.poll()

    def poll(self) -> int | None:
        if self.ssh_killed:
            return -signal.SIGKILL
        return self.process.code if self.process.dead and not self.apart else None

    def wait(self, timeout: float | None = None) -> int:
        if self.poll() is None:
            sim.sleep(timeout or 0.0) if self.apart else self.process.ended.wait(timeout)
        if (code := self.poll()) is None:
            raise subprocess.TimeoutExpired(self.process.name, timeout or 0.0)
        return code


class LaunchedProcess(launcher.Process):
    """Process of a launcher behind simulated pipes."""

    lines = 0  # number of texts of its output that came

    @property
    def output(self) -> str:
        texts = self.handle.process.out
        if not self.handle.apart:
            self.lines = len(texts)
        return "".join(texts[: self.lines])

    def news(self) -> list[str]:
        lines = self.output[self.shown :].splitlines(keepends=True)
        whole = [line for line in lines if line.endswith("\n")]
        self.shown += sum(map(len, whole))
        return [line.rstrip("\n") for line in whole]

    def write(self) -> None:
        if not self.handle.apart:
            self.handle.process.give(bytes(self.unsent))
            self.unsent.clear()

    def close(self) -> None:
        if self.handle.apart:
            current().after(BEAT_S, self.close)
        else:
            self.handle.process.give(b"", eof=True)

    def forget(self) -> None:
        return

    def signal(self, number: int) -> None:
        if self.handle.apart:
            self.handle.ssh_killed |= number == signal.SIGKILL
        elif number == signal.SIGKILL:
            self.handle.process.kill()
        else:
            current().signal(self.handle.process, number)


def start(self: launcher.Launcher, name: str, module: str, *arguments: str, forked: bool = False) -> launcher.Process:
    """`Launcher.start`."""
    environment = {} if self.clock is None else self.clock.shared()
    wait_s = (
        current().kernel.rng.choice((0.05, 0.2, 0.2, 1.5)) * current().kernel.rng.random() if current().varied else 0.0
    )

    def begin() -> int:
        if wait_s:
            sim.block(wait_s)
        return main(module, arguments)

    writable(self._logs / f"{name}.log")
    process = sim.Process(name, begin, environment)
    current().started(process, module, arguments)
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

        def result() -> object:
            thread.join()
            return found[0]

        return SimpleNamespace(result=result, done=lambda: not thread.is_alive())


@contextlib.contextmanager
def registered(run: run_registry.RegisteredRun, obey: run_registry.Obey | None = None) -> Iterator[str]:
    """`run_registry.registered`, in the memory of the simulated machine."""
    entry = (run, obey, sim.current().process)
    current().runs.append(entry)
    try:
        yield ""
    finally:
        current().runs.remove(entry)


def tell(run: run_registry.RegisteredRun, stop: messages.Stop) -> run_registry.StopReport | None:
    """`run_registry.tell`: the process of the run obeys in a thread of its own."""
    process, obey = next((process, obey) for each, obey, process in current().runs if each is run)
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
    if process is None or not current().disks:
        return None
    return next((fault for who, fault in current().disks.items() if process is current().process(who)), None)


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
        return int(self._file.write(data))


def open_file(file: Any, mode: str = "r", *given: Any, **more: Any) -> Any:
    """`open`: files that are written to are on the disk of the process."""
    if running() is None or not set(mode) & set("wax+"):
        return REAL.open(file, mode, *given, **more)
    if disk() == "read-only":
        writable(file)
    return DiskFile(REAL.open(file, mode, *given, **more), file)


def temporary_file(*given: Any, **more: Any) -> Any:
    if disk() == "read-only":
        writable("")
    return DiskFile(tempfile.TemporaryFile(*given, **more), "")
