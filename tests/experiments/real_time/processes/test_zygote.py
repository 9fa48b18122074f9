"""A zygote: what it forks is as good as spawned, and lives without it."""

import os
import signal
import textwrap
from pathlib import Path

import psutil
import pytest

from experiments.real_time.hosts.launcher import ZYGOTE, Launcher
from experiments.real_time.processes import zygote
from tests.waiting import until

pytestmark = pytest.mark.system

FORKED = """
    import os, random, sys, threading
    import numpy.random
    print(os.getsid(0), os.getpgrp(), threading.active_count(), os.environ.get("OPENBLAS_NUM_THREADS"), flush=True)
    print(random.getrandbits(64), numpy.random.bytes(8).hex(), sys.argv[1:], __name__, flush=True)
    print(sorted(os.listdir("/proc/self/fd")), "begun", flush=True)
    end = sys.argv[1]
    while os.read(0, 4096):
        if end == "raise":
            raise ValueError("a crash")
        if end.isdecimal():
            sys.exit(int(end))
    sys.exit(5)
"""


@pytest.fixture
def launcher(tmp_path, monkeypatch):
    """A launcher with a zygote, to which the module `forked` is known."""
    code = tmp_path / "code"
    code.mkdir()
    (code / "forked.py").write_text(textwrap.dedent(FORKED))
    monkeypatch.setenv("PYTHONPATH", f"{code}{os.pathsep}{Path.cwd()}")
    with Launcher(tmp_path / "logs") as made:
        made.preload()
        yield made


def begin(launcher, name, *arguments):
    process = launcher.start(name, "forked", *arguments, forked=True)
    until(lambda: "begun" in process.output or not process.alive, f"{name} has begun")
    return process


@pytest.mark.parametrize(("end", "words"), [("0", "exit code 0"), ("3", "exit code 3"), ("raise", "exit code 1")])
def test_exit_codes_are_passed_on(launcher, end, words):
    process = begin(launcher, "a", end)
    assert isinstance(process.handle, zygote.Forked)
    assert process.handle.wait(100.0) == process.handle.poll()
    assert (process.exit, process.because == ": ValueError: a crash") == (words, end == "raise")
    assert launcher.died() == [process]


@pytest.mark.mechanism("zygote")
def test_a_forked_process_shares_nothing_open_with_others(launcher):
    processes = [begin(launcher, name, "stay", name) for name in ("case-KH01", "case-CF01", "case-CF02")]
    launcher.release("case-CF01")
    assert processes[1].handle.wait(100.0) == 5, "no other process holds its lifeline"
    for generator in (0, 1):
        assert len({process.output.splitlines()[1].split()[generator] for process in processes}) == 3
    for process in processes:
        pid = process.handle.pid
        first, second, third = process.output.splitlines()
        assert first.split() == [str(pid), str(pid), "1", "1"]
        assert second.endswith(f"['stay', '{process.name}'] __main__")
        assert third == "['0', '1', '2', '3'] begun", "the last is that of the list itself"
    for process in (processes[0], processes[2]):
        seen = psutil.Process(process.handle.pid)
        assert [word for word in seen.cmdline() if word][1:] == ["-m", "forked", "stay", process.name]
        assert seen.name() == process.name
        assert Path(f"/proc/{seen.pid}/fd/1").resolve() == process.log


def test_a_killed_process_is_seen(launcher):
    killed, ended = begin(launcher, "a", "stay"), begin(launcher, "b", "stay")
    launcher.kill("a")
    until(lambda: launcher.died() == [killed], "its end is seen")
    assert killed.exit == "killed by SIGKILL"
    os.kill(ended.handle.pid, signal.SIGSTOP)
    assert launcher.end(["b"], grace_s=0.1) == [ended]
    assert ended.exit == "killed by SIGKILL"


@pytest.mark.parametrize("end", [Launcher.kill, Launcher.release])
def test_an_ended_zygote_takes_no_process_along(launcher, end):
    process = begin(launcher, "a", "stay")
    end(launcher, ZYGOTE)
    until(lambda: [each.name for each in launcher.died()] == [ZYGOTE], "its end is seen")
    assert process.alive
    later = begin(launcher, "b", "7")
    assert not isinstance(later.handle, zygote.Forked)
    assert later.handle.wait(100.0) == 7
    assert process.alive
    launcher.release("a")
    until(lambda: not process.alive, "it ends with its lifeline")
    assert process.exit == "exit code unknown"


def test_a_zygote_that_stands_still_is_done_without(launcher):
    process = begin(launcher, "a", "3")
    os.kill(launcher.get(ZYGOTE).handle.pid, signal.SIGSTOP)
    assert not isinstance(begin(launcher, "b", "stay").handle, zygote.Forked)
    until(lambda: not process.alive, "it ends")
    os.kill(launcher.get(ZYGOTE).handle.pid, signal.SIGCONT)
    until(lambda: not psutil.Process(launcher.get(ZYGOTE).handle.pid).children(), "what is late ends at once")


def test_a_zygote_with_two_threads_forks_nothing(launcher, tmp_path):
    threaded = "import threading; threading.Thread(target=threading.Event().wait, daemon=True).start()"
    (tmp_path / "code" / "sitecustomize.py").write_text(threaded)
    launcher.end([ZYGOTE], 1.0)
    launcher.preload()
    assert not isinstance(begin(launcher, "a", "stay").handle, zygote.Forked)
    assert "nothing was forked: 2 threads" in launcher.get(ZYGOTE).output


def test_without_a_zygote_all_are_spawned(tmp_path, monkeypatch):
    monkeypatch.setenv(zygote.SWITCH, "0")
    with Launcher(tmp_path / "logs") as launcher:
        launcher.preload()
        assert not launcher.running(ZYGOTE)
        process = launcher.start("a", "this", forked=True)
        assert process.handle.wait(100.0) == 0
