"""The list of runs: what is up is found, what died is cleaned away, and what is none of ours harms nobody."""

import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import psutil
import pytest

from agents.network.endpoints import free_endpoint
from experiments.real_time.hosts import run_registry
from experiments.real_time.hosts.run_registry import born, own_entry, registered, runs
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


def test_dead_run_is_listed_while_its_router_answers(runtime_folder):
    run = dead()
    with registered(run):
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
        resolved.wait(60.0)
        raise OSError

    monkeypatch.setattr(run_registry.socket, "create_connection", resolve)
    with registered(dead()), registered(dead()), registered(dead()), registered(run):
        began = time.monotonic()
        assert run in runs()
        assert time.monotonic() - began < 5.0
    resolved.set()


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


def test_without_runtime_folder_the_users_is_used(tmp_path, monkeypatch):
    monkeypatch.delenv("ZENPARK_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    with registered(entry()) as why:
        assert why == ""
        assert [path.name for path in tmp_path.iterdir()] == [f"zenpark-{os.getuid()}"]
    (tmp_path / "session").mkdir(0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "session"))
    with registered(entry()):
        assert len(list((tmp_path / "session" / "zenpark").iterdir())) == 1
