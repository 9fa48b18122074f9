"""A router that is not ours, with the configuration that `zenpark router --print-config` prints."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import zenoh

from agents import lab
from agents.endpoint import free_endpoint
from agents.settings import config, settings
from experiments import access
from experiments.run import load, reopen
from tests.system.lab import Flight, until
from tests.system.test_transports import SHORT, found
from tools import router

pytestmark = pytest.mark.system
Router = Callable[[Path], AbstractContextManager[None]]


@contextmanager
def ours(file: Path) -> Iterator[None]:
    """The library that the wheel brings, from the very file."""
    with zenoh.open(zenoh.Config.from_file(str(file))):
        yield


@contextmanager
def theirs(file: Path) -> Iterator[None]:
    """A zenohd on PATH."""
    process = subprocess.Popen(["zenohd", "--config", str(file)], stdin=subprocess.DEVNULL)
    try:
        endpoint = json.loads(file.read_text())["listen"]["endpoints"]
        until(lambda: answers(endpoint, process), "zenohd answers", 10.0)
        yield
    finally:
        process.terminate()
        process.wait(10)


def answers(endpoints: list[str], process: subprocess.Popen[bytes]) -> bool:
    assert process.poll() is None
    host, _, port = endpoints[0].partition("/")[2].rpartition(":")
    probe = subprocess.run(["bash", "-c", f"exec 3<>/dev/tcp/{host}/{port}"], capture_output=True, check=False)
    return probe.returncode == 0


WITH = [
    ours,
    pytest.param(theirs, marks=pytest.mark.skipif(shutil.which("zenohd") is None, reason="no zenohd on PATH")),
]


@pytest.mark.parametrize("start", WITH)
@pytest.mark.parametrize("secure", [False, True])
def test_an_experiment_at_a_router_of_somebody_else(tmp_path: Path, start: Router, secure: bool) -> None:
    plain = free_endpoint(0, "tls" if secure else "tcp")
    rights, endpoint = None, plain
    options: tuple[str, ...] = ()
    if secure:
        folder = found(tmp_path / "lab")
        rights = access.rights(load("triangle").cases().values())
        (endpoint,) = lab.secured([plain], folder)
        options = ("--lab", str(folder))
    file = tmp_path / "zenohd.json5"
    file.write_text(json.dumps(router.of_zenohd([endpoint], rights=rights)))
    with start(file):
        flight = Flight(tmp_path / "run", "triangle", *SHORT, *options, "--set", f'network.connect=["{plain}"]')
        code, _ = flight.finish()
        assert code == 0, flight.logs()
        if secure:
            stranger = config(settings("client", connect=[endpoint], name="stranger", identity="observer"))
            with zenoh.open(stranger) as session:
                assert not [r for r in session.get("park/KH01/order", payload=b"{}", timeout=0.5) if r.ok]
    assert reopen(flight.folder).metrics["periodic"].lost == 0
