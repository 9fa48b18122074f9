"""A router that is not ours, with the configuration that `./zenpark router --print-config` prints, or with none.

`tests/system/zenohd.py` builds a zenohd; where there is none, these tests are skipped and say why.
"""

import json
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import zenoh

from agents.network import lab
from agents.network.endpoints import free_endpoint
from agents.network.zenoh_config import config, settings
from experiments.definition import access_rights
from experiments.file.document import load
from experiments.run import reopen
from tests.system import zenohd
from tests.system.lab import NEAR_TRIANGLE, TRIANGLE, Flight, assert_held_in_time, typed, until
from tests.system.test_transports import SHORT, found
from tools.commands.processes import of_zenohd

pytestmark = pytest.mark.system
Router = Callable[[Path], AbstractContextManager[None]]


@contextmanager
def ours(file):
    """The library that the wheel brings, from the very file."""
    with zenoh.open(zenoh.Config.from_file(str(file))):
        yield


@contextmanager
def theirs(file):
    """A zenohd, from the same file."""
    with started(json.loads(file.read_text())["listen"]["endpoints"][0], "--config", str(file)):
        yield


@contextmanager
def started(endpoint, *arguments):
    """A zenohd that listens."""
    process = subprocess.Popen([zenohd.folder() / "zenohd", *arguments], stdin=subprocess.DEVNULL)
    try:
        until(lambda: answers(endpoint, process), "zenohd answers")
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        process.wait(30)


def answers(endpoint, process):
    assert process.poll() is None
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) == 0


def missing():
    """Why there is no zenohd; empty if there is one."""
    try:
        zenohd.folder()
    except zenohd.NotBuilt as error:
        return str(error)
    return ""


NEEDED = pytest.mark.skipif(bool(missing()), reason=missing())
WITH = [ours, pytest.param(theirs, marks=NEEDED)]


@pytest.mark.parametrize("start", WITH)
@pytest.mark.parametrize("secure", [False, True])
def test_an_experiment_at_a_router_of_somebody_else(tmp_path, start, secure):
    plain = free_endpoint(0, "tls" if secure else "tcp")
    rights, endpoint = None, plain
    options = ()
    if secure:
        folder = found(tmp_path / "lab")
        rights = access_rights.rights(load("triangle").cases().values())
        (endpoint,) = lab.secured([plain], folder)
        options = ("--lab", str(folder))
    file = tmp_path / "zenohd.json5"
    file.write_text(json.dumps(of_zenohd([endpoint], rights=rights)))
    with start(file):
        flight = Flight(tmp_path / "run", "triangle", *SHORT, *options, f'network.connect=["{plain}"]')
        code, _ = flight.finish()
        assert code == 0, flight.logs()
        if secure:
            stranger = config(settings("client", connect=[endpoint], name="stranger", identity="observer"))
            with zenoh.open(stranger) as session:
                assert not [r for r in session.get("park/KH01/order", payload=b"{}", timeout=0.5) if r.ok]
    assert reopen(flight.folder).metrics["periodic"].lost == 0


@NEEDED
@pytest.mark.parametrize("freezes", [pytest.param(False, marks=pytest.mark.mechanism("zenohd")), True])
def test_plain_zenohd_is_read_by_rest_and_freezes(tmp_path, freezes):
    """No file: a lease of 10 s. What the README says of REST."""
    endpoint, rest = free_endpoint(0), free_endpoint(0).partition("/")[2]

    def read(path, post=None):
        body = None if post is None else json.dumps(post).encode()
        asked = urllib.request.Request(f"http://{rest}/{path}", body, {"content-type": "application/json"})
        with urllib.request.urlopen(asked, timeout=10.0) as answer:
            return json.load(answer)

    with started(endpoint, "-l", endpoint, "--no-multicast-scouting", "--rest-http-port", rest) as process:
        changes = (*NEAR_TRIANGLE, f'network.connect=["{endpoint}"]')
        flight = Flight(tmp_path / "run", "triangle", "--case", "periodic", *changes)
        flight.until_flown()
        (last,) = read("park/CF01/pose")
        assert (last["key"], last["encoding"]) == ("park/CF01/pose", "application/json")
        assert len(last["value"]["position"]) == 3
        for every in ("park/*/pose", "park/**"):  # and no errors
            assert {each["key"] for each in read(every)} == {f"park/{name}/pose" for name in TRIANGLE}
        replies = read("park/*/order", {"order": "get", "name": "clamp"})
        # the conductor has an order key too, and says that this is none of its orders
        told = [each["value"] for each in replies if each["key"] != "ERROR"]
        assert {each["robot"] for each in told if each["ok"]} == set(TRIANGLE)
        if freezes:
            process.send_signal(signal.SIGSTOP)
            stopped = time.time()
            flight.until_said(r"router conductor: no router answers for \d+\.\d s")
            until(lambda: time.time() > stopped + 3.0, "every robot has had the time to hold")
            process.send_signal(signal.SIGCONT)
            flight.until_said(r"router conductor: a router answers again, after \d+\.\d s")
        flight.interrupt()
    if freezes:
        assert_held_in_time(flight, "periodic", stopped)
    for name in TRIANGLE:
        assert typed(flight.folder / "periodic.mcap", f"/{name}/status")[-1].malformed == 0
