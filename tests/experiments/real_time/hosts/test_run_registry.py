"""The list of runs: what is up is found, what died is cleaned away, and what is none of ours harms nobody."""

import os
import shutil
import socket
import subprocess
import sys
import threading
from pathlib import Path

import msgspec
import psutil
import pytest

from agents.body.device_address import DeviceAddress
from agents.body.device_locks import Claims
from agents.body.interface import BodyError
from agents.network.endpoints import free_endpoint
from agents.network.messages import Stop
from experiments.real_time.hosts import run_registry
from experiments.real_time.hosts.run_registry import StopReport, born, own_entry, registered, runs, tell
from tests.small import changed

pytestmark = pytest.mark.usefixtures("runtime_folder")


def entry(what="run", title="two", **more):
    """A run of this process, with a router that is not up."""
    return own_entry(what, title, [free_endpoint(preferred_port=0)], **more)


def dead():
    """A run whose process has ended."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        return changed(entry(), pid=process.pid, born=born(process.pid))


def test_run_is_listed_while_it_is_up(runtime_folder):
    run = entry(folder=Path("here"), realm="hall", robots={"CF01": "radio://0", "KH01": ""})
    assert runs() == []
    with registered(run) as why:
        assert (why, runs(), run.alive) == ("", [run], True)
        assert not changed(run, born="1").alive, "another process of its number"
        since_boot_s = psutil.Process().create_time() - psutil.boot_time()
        assert int(run.born) / os.sysconf("SC_CLK_TCK") == pytest.approx(since_boot_s, abs=2.0)
        with registered(entry("router", "a router by hand")):
            assert [each.what for each in runs()] == ["run", "router"]
        assert run.words == f"two, {Path('here').absolute()}, at {run.endpoints[0]}"
    assert runs() == list(runtime_folder.iterdir()) == []
    assert runtime_folder.stat().st_mode & 0o777 == 0o700


def test_run_of_another_container_stays_listed(runtime_folder):
    run = dead()  # the number of its process belongs to another namespace
    with registered(run, lambda _: StopReport([], [])):
        assert [each.since for each in runs()] == [run.since]
        assert len(list(runtime_folder.iterdir())) == 2, "file and socket"


def test_dead_run_is_listed_while_its_router_answers(runtime_folder):
    run = dead()
    with socket.socket() as deaf:  # it keeps the port from others, and refuses
        deaf.bind(("127.0.0.1", 0))
        with registered(changed(run, endpoints=[f"tcp/127.0.0.1:{deaf.getsockname()[1]}"])):
            assert runs() == []
            assert list(runtime_folder.iterdir()) == [], "cleaned"
    with socket.create_server(("127.0.0.1", 0)) as router:
        left = changed(run, endpoints=[f"tcp/127.0.0.1:{router.getsockname()[1]}"])
        with registered(left):
            assert runs() == [left], "its robots may still come down"
            assert not left.alive


ENTRY = b'{"what":"run","pid":%d,"born":"","since":0,"title":"","folder":"","endpoints":%b}'
GARBAGE = [
    b"", b"\xff\x00", b"[" * 100_000, b"{}", b" " * (run_registry.MAX_ENTRY_BYTES + 1),
    ENTRY % (-1, b'["tcp/127.0.0.1:1"]'), ENTRY % (1, b'["nonsense"]'), ENTRY % (1, b"[]"),
]  # fmt: skip


def test_garbage_is_left_alone_and_hides_nobody(runtime_folder):
    run = entry()
    with registered(run):
        (runtime_folder / "folder.json").mkdir()
        (runtime_folder / "endless.json").symlink_to("/dev/zero")
        for number, text in enumerate(GARBAGE):
            (runtime_folder / f"{number}.json").write_bytes(text)
            assert runs() == [run], text[:80]
        assert len(list(runtime_folder.iterdir())) == 3 + len(GARBAGE)


def test_silent_names_delay_no_emergency_stop(monkeypatch):
    run, resolved = entry(), threading.Event()
    with registered(changed(dead(), endpoints=[f"tcp/{'a' * 70}:7447"])), registered(run):
        assert runs() == [run], "a name that cannot be asked for hides nobody"

    def resolve(*_):
        resolved.wait()
        raise OSError

    monkeypatch.setattr(run_registry.socket, "create_connection", resolve)
    with registered(dead()), registered(dead()), registered(dead()), registered(run):
        assert run in runs(), "although no name is ever resolved"
    resolved.set()


def test_stop_reaches_a_run_without_routers(runtime_folder):
    stops, report = [], StopReport(["A", "B"], ["B"])

    def obey(stop):
        stops.append(stop)
        return report

    with registered(entry(), obey) as why:
        assert why == ""
        (run,) = runs()
        for _ in range(3):
            assert tell(run, Stop("operator", "a test")) == report
        with socket.socket(socket.AF_UNIX) as curious:
            curious.connect(run.socket)  # says nothing
        assert tell(run, Stop("operator", "again")) == report
    assert stops == [Stop("operator", "a test")] * 3 + [Stop("operator", "again")]
    assert list(runtime_folder.iterdir()) == []
    assert tell(run, Stop("operator", "late")) is None


def test_frozen_run_delays_a_stop_no_longer(monkeypatch, runtime_folder):
    monkeypatch.setattr(run_registry, "TELL_S", 0.05)
    with registered(entry()), socket.socket(socket.AF_UNIX) as frozen:
        (file,) = runtime_folder.glob("*.json")
        frozen.bind(str(file.with_suffix(run_registry.SOCKET)))
        frozen.listen(1)
        (found,) = runs()
        assert found.socket
        assert tell(found, Stop("operator", "a test")) is None


def test_folder_writable_by_others_is_refused(runtime_folder):
    runtime_folder.mkdir(0o700)
    (runtime_folder / "0.json").write_bytes(msgspec.json.encode(entry()))
    assert len(runs()) == 1
    runtime_folder.chmod(0o770)
    assert runs() == []
    with registered(entry()) as why:
        assert "no folder of yours alone" in why
    runtime_folder.rename(runtime_folder.with_name("elsewhere"))
    runtime_folder.symlink_to(runtime_folder.with_name("elsewhere"))
    assert runs() == []


@pytest.fixture
def shells(tmp_path, monkeypatch):
    """Environments of one user, by what XDG_RUNTIME_DIR names, if anything: nothing is found but below `tmp_path`."""
    monkeypatch.delenv("ZENPARK_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr("agents.user_folder.SESSIONS", tmp_path / "sessions")
    monkeypatch.setattr("agents.user_folder.TEMPORARY", tmp_path / "tmp")
    for each in ("tmp", "session", f"sessions/{os.getuid()}"):
        (tmp_path / each).mkdir(0o700, parents=True)

    def enter(session=None):
        if session is None:
            monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
        else:
            monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / session))

    return enter


def test_shells_of_one_user_list_same_runs(shells, tmp_path):
    run = entry()
    for begun in ("session", "missing", None):
        shells(begun)
        with registered(run) as why:
            assert why == ""
            for other in (None, "session", "missing"):
                shells(other)
                assert runs() == [run], (begun, other)
            shutil.rmtree(tmp_path / "sessions" / str(os.getuid()) / "zenpark")  # as at the end of the last session
            assert runs() == [run]
        assert runs() == []


def test_shells_of_one_user_share_locks(shells):
    shells("session")
    driver = Claims([("A", DeviceAddress("radio 80", parts=("80",)))])
    driver.take()
    shells()
    with pytest.raises(BodyError, match="radio 80 is in use"):
        Claims([("B", DeviceAddress("radio 80", parts=("80",)))]).take()
    driver.release()
    Claims([("B", DeviceAddress("radio 80", parts=("80",)))]).take()


@pytest.mark.skipif(os.getuid() != 0, reason="looks into the folders of others as root")
def test_root_lists_runs_of_all_users(shells, tmp_path):
    shells()
    theirs = tmp_path / "sessions" / "1234" / "zenpark"
    theirs.mkdir(0o700, parents=True)
    file = theirs / "0.json"
    with socket.create_server(("127.0.0.1", 0)) as router:
        left = changed(entry(), endpoints=[f"tcp/127.0.0.1:{router.getsockname()[1]}"])
        file.write_bytes(msgspec.json.encode(left))
        for each in (theirs, file):
            os.chown(each, 1234, 1234)
        (found,) = runs()
        assert (found.user, found.endpoints) == (1234, left.endpoints)
        assert not found.alive, "its process is another user's: root does not end it"
        theirs.chmod(0o777)
        assert runs() == []
