"""The station of a host: what it answers, and that nobody of its run stays behind."""

import os
import signal
import subprocess
import sys
import time

import msgspec
import psutil
import pytest

from experiments.real_time.hosts.launcher import RUN
from experiments.real_time.hosts.station import Answer, Question, answer, devices
from experiments.real_time.processes import zygote
from experiments.recording import version
from tests.system.lab import ENVIRONMENT, ROOT
from tests.waiting import until


def test_it_says_who_it_is():
    said = answer(Question("hello"), 12.0)
    assert (said.zenpark, said.clock) == (version.digest(), 12.0)
    assert said.python == ".".join(map(str, sys.version_info[:3]))
    assert len(said.zenpark) == 64


def test_a_digest_is_that_of_names_and_contents(tmp_path):
    (tmp_path / "agents").mkdir()
    file = tmp_path / "agents" / "a.py"
    file.write_text("x = 1\n")
    first = version.digest(tmp_path)
    (tmp_path / "agents" / "notes.txt").write_text("not code")
    version.digest.cache_clear()
    assert version.digest(tmp_path) == first
    file.rename(tmp_path / "agents" / "b.py")
    version.digest.cache_clear()
    assert version.digest(tmp_path) != first


@pytest.mark.slow
def test_absent_router_is_not_reached():
    (found,) = answer(Question("reach", endpoints=["tcp/127.0.0.1:9"]), 0.0).found
    assert not found.well
    assert "no router answers" in found.text


def test_serial_ports_are_looked_at():
    (found,) = devices(["kteam:///dev/no-such-port", "twin"])
    assert (found.what, found.well) == ("/dev/no-such-port", False)
    assert "plugged in" in found.text
    assert list(devices(["twin", "world"])) == []


class Started:
    """A station process of a run, and a pipe to it."""

    def __init__(self, run):
        self.process = subprocess.Popen(
            [sys.executable, "-c", "from experiments.real_time.hosts.station import serve; serve(patience_s=0.5)"],
            cwd=ROOT,
            env={**ENVIRONMENT, RUN: run},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def ask(self, question):
        self.process.stdin.write(b"\n" + msgspec.json.encode(question) + b"\n")
        self.process.stdin.flush()
        return msgspec.json.decode(self.process.stdout.readline(), type=Answer)

    def leave(self):
        self.process.stdin.close()
        code = self.process.wait(30)
        self.process.stdout.close()
        return code


def sleeper(run):
    return subprocess.Popen([sys.executable, "-c", "input()"], env={**os.environ, RUN: run}, stdin=subprocess.PIPE)


@pytest.mark.system
def test_it_answers_until_its_lifeline_ends():
    started = Started("a")
    before = time.time()
    said = started.ask(Question("clock"))
    assert before - 1e-3 <= said.clock <= time.time() + 1e-3
    started.process.stdin.write(b"nonsense\n")
    assert started.ask(Question("clock")).clock > said.clock
    assert started.leave() == 0


@pytest.mark.system
def test_it_sweeps_up_its_own_run_only():
    started, mine, other = Started("run.lab1"), sleeper("run.lab1"), sleeper("run.lab2")
    try:
        found = []  # a process has its environment only after its exec
        until(lambda: found.extend(started.ask(Question("sweep")).found) or found, "it is found")
        assert [each.what for each in found] == [str(mine.pid)]
        assert mine.wait(30) == -9
        assert other.poll() is None
        assert started.leave() == 0
        assert psutil.pid_exists(other.pid)
    finally:
        for process in (mine, other):
            process.stdin.close()
            process.wait(30)


@pytest.mark.mechanism("station: way out on a host")
@pytest.mark.system
def test_station_awaits_landing_robots_and_kills_frozen_ones():
    started, frozen = Started("run.lab1"), sleeper("run.lab1")
    try:
        started.ask(Question("clock"))
        frozen.send_signal(signal.SIGSTOP)
        assert started.leave() == 0
        assert frozen.wait(30) == -signal.SIGKILL
    finally:
        frozen.stdin.close()


@pytest.mark.system
@pytest.mark.parametrize("number", [None, signal.SIGKILL, signal.SIGTERM])
def test_a_preloaded_station_forks_its_robots(number):
    started = Started("run.lab3")
    started.ask(Question("preload"))
    robot = subprocess.Popen(
        [sys.executable, "-m", "tools.guard", "agent", "-", "KH01", "--lifeline"],
        cwd=ROOT,
        env={**ENVIRONMENT, RUN: "run.lab3"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    pid = int(robot.stdout.readline().rpartition(" ")[2])
    forked = psutil.Process(pid)
    assert pid != robot.pid
    assert zygote.MODULE in forked.parent().cmdline()
    assert [word for word in forked.cmdline() if word][2:] == [zygote.ROBOT, "-", "KH01", "--lifeline"]
    if number is signal.SIGKILL:
        forked.kill()
    elif number is not None:
        robot.send_signal(number)
    out, errors = robot.communicate(timeout=30)
    assert robot.returncode == (2 if number is None else -number)
    assert (out, "no experiment came" in errors) == ("", number is None)
    assert started.ask(Question("sweep")).found == []
    assert started.leave() == 0
