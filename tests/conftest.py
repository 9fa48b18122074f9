"""Fixtures of tests that start processes: a real router, patience, and the proof that nothing is left."""

from __future__ import annotations

import functools
import gc
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import typer.main
import typer.testing
from hypothesis import settings as hypothesis_settings

from agents.network.endpoints import free_endpoint
from tests.waiting import until

for name, most in (("zenpark", 35), ("quick", 5), ("all", 100)):  # profiles of `./zenpark test` and its options
    hypothesis_settings.register_profile(name, deadline=None, max_examples=most)  # the machine may be slow
hypothesis_settings.load_profile("zenpark")
# no test may find the runs of whoever uses this machine, least of all to stop them
os.environ["ZENPARK_RUNTIME_DIR"] = tempfile.mkdtemp(prefix="zenpark-tests-")
os.environ["ZENPARK_CACHE_DIR"] = tempfile.mkdtemp(prefix="zenpark-cache-")

# each call builds all commands anew, 50 ms; a command keeps nothing of a call
typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)

gc.disable()  # until all tests are collected: a quarter of the time that this takes

ROOT = Path(__file__).resolve().parent.parent

# The background of a shell ignores Ctrl-C, and whatever a test starts would inherit that; a handler is not inherited.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """Refuses a path that is not there: the workers of -n collect nothing then, and do not say why."""
    for name in config.args:
        if not Path(name.partition("::")[0]).exists():
            raise pytest.UsageError(f"{name}: there is no such file or folder")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuses two tests for one mechanism: each costs seconds."""
    shown: dict[str, str] = {}
    for item in items:
        if (marker := item.get_closest_marker("mechanism")) is not None:
            if item.get_closest_marker("system") is None:
                raise pytest.UsageError(f"{item.nodeid}: the mark `mechanism` is for tests with the mark `system`")
            for name in marker.args:
                if (other := shown.setdefault(name, item.nodeid)) != item.nodeid:
                    raise pytest.UsageError(f"{item.nodeid}: {other} shows the mechanism {name!r} already")


def pytest_collection_finish() -> None:
    """Keep the garbage collector off what was imported, and let it run less often: a twentieth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)
    gc.enable()


def pytest_runtest_setup() -> None:
    """Let each test fly as the first one of a process: after 20 s of flights whatever comes next would be compiled."""
    if (stretch := sys.modules.get("experiments.virtual_time.stretch")) is not None:
        stretch.WORK[:] = 0.0, 0.0


PATIENT = """
import signal, sys, zenoh
from agents.network.zenoh_config import config, settings
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
endpoint, lease_s = sys.argv[1:]
with zenoh.open(config(settings("router", listen=[endpoint], name="router", lease_s=float(lease_s)))):
    print("router ready on", endpoint, flush=True)
    signal.sigwait([signal.SIGTERM])
"""


class RouterProcess:
    """A router in a process of its own, on a free loopback port that it keeps over restarts.

    With a `lease_s`, its clients wait as long for a sign of life [s]: rmw_zenohd has 60 s.
    """

    def __init__(self, lease_s: float | None = None) -> None:
        self.endpoint = free_endpoint(preferred_port=0)
        own = ["-m", "agents.runtime.router", "--listen", self.endpoint]
        self._command = own if lease_s is None else ["-c", PATIENT, self.endpoint, str(lease_s)]
        self.process: subprocess.Popen[str]
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *self._command], cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == f"router ready on {self.endpoint}\n"

    def kill(self) -> None:
        self.process.kill()
        self._reap()

    @contextmanager
    def frozen(self) -> Iterator[float]:
        """Stops the process with SIGSTOP, from now [s, UTC] until the end of the block."""
        self.process.send_signal(signal.SIGSTOP)
        try:
            yield time.time()
        finally:
            self.process.send_signal(signal.SIGCONT)

    def stop(self) -> int:
        self.process.terminate()
        return self._reap()

    def _reap(self) -> int:
        code = self.process.wait(100.0)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return code


@pytest.fixture
def router() -> Iterator[RouterProcess]:
    """A real router process; its `endpoint` is where clients connect."""
    made = RouterProcess()
    yield made
    assert made.process.returncode is not None or made.stop() == 0
    assert not psutil.pid_exists(made.process.pid)


@pytest.fixture(scope="module")
def hub() -> Iterator[RouterProcess]:
    """Router for all tests of a module that leave it alone."""
    made = RouterProcess()
    yield made
    made.stop()


@pytest.fixture
def patient_router() -> Iterator[RouterProcess]:
    """A router whose clients wait 60 s for a sign of life, as those of rmw_zenohd do."""
    made = RouterProcess(lease_s=60.0)
    yield made
    assert made.process.returncode is not None or made.stop() == 0


@pytest.fixture
def runtime_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of this test for what runs and devices keep while they are up; it does not exist yet.

    A socket has at most 107 letters, and `tmp_path` of a worker nearly as many.
    """
    with tempfile.TemporaryDirectory(prefix="zp-") as short:
        monkeypatch.setenv("ZENPARK_RUNTIME_DIR", f"{short}/runs")
        yield Path(short) / "runs"


@pytest.fixture
def eventually() -> Callable[[Callable[[], object]], None]:
    """Waits until something is true."""
    return until


@pytest.fixture
def unflown(monkeypatch: pytest.MonkeyPatch) -> None:
    """`check` flies one second only: enough for findings that take no flight."""
    monkeypatch.setattr("experiments.check.ideal_run.flown_ticks", lambda *_: 0.0)


@pytest.fixture(autouse=True)
def no_orphans(request: pytest.FixtureRequest) -> Iterator[None]:
    """After a system test no process and no thread that it started is left."""
    if request.node.get_closest_marker("system") is None:
        yield
        return
    threads = set(threading.enumerate())
    processes = set(psutil.Process().children(recursive=True))
    yield
    _, left = psutil.wait_procs(set(psutil.Process().children(recursive=True)) - processes, timeout=60.0)
    what = [f"{process.pid}: {' '.join(process.cmdline())}" for process in left]
    for process in left:
        process.kill()
    assert not what, f"processes left behind: {what}"
    for thread in set(threading.enumerate()) - threads:
        if thread.name == "Shared Radio":
            continue  # cflib keeps one for each dongle as long as the process lives
        thread.join(60.0)
        assert not thread.is_alive(), f"thread left behind: {thread.name}"
